"""Swarms that fly by commitments while peers are cut off, frozen or out of reach for seconds."""

from __future__ import annotations

import math
from collections.abc import Set
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.events import Freeze, ScenarioEvent, Split
from sitl.studies.campaign.conditions.scenarios import layout_of
from sitl.studies.campaign.flight import TrialFlight, drawn
from sitl.studies.campaign.trials import Trial
from swarmctl.agent.planning import commitment_publisher, coordination
from swarmctl.agent.planning.coordination import Coordination
from swarmctl.agent.planning.separation_policy import Guaranteed
from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.links import _BadPeriods
from swarmctl.config import load
from swarmctl.core.types import Phase
from tests.benches.guaranteed_trials import COMMITTED_M, GUARANTEED_SWAP, TOUCH_M, events, flown, fly_until
from tests.closed_loop.conftest import COARSE, mission_t_s

COARSE_SWAP = replace(GUARANTEED_SWAP, sets="agent.rate_hz=25")  # see `COARSE`; trials have its physics as it is


def committed_in_the_dark(sees: type[Coordination] = Coordination) -> int:
    """How many trajectories are committed from 1.6 s to 2 s after the bus has fallen apart."""
    flight = TrialFlight(
        Trial(
            GUARANTEED_SWAP,
            1,
        ),
        layout_of("swap", 1, 4),
    )
    step, counts = flight.lockstep.step, []
    began_us: list[int] = []

    def watched() -> None:
        step()
        if flight._tracking() and not began_us:
            began_us.append(flight.lockstep.clock.now_us())
            flight.lockstep.hub.fail()
        policies = [agent._separation for agent in flight._agents if agent is not None]
        counts.append(sum(p._coordination.counts.committed for p in policies if isinstance(p, Guaranteed)))

    while not began_us or flight.lockstep.clock.now_us() < began_us[0] + 2_000_000:
        watched()
    return counts[-1] - counts[-21]


def only_seen(self: Coordination) -> Set[int]:
    """Return peers whose token is seen, as if the others had died."""
    return frozenset(agent for agent in self._peers if agent_name(agent) in self._bus.alive())


def test_an_agent_off_the_bus_commits_nothing() -> None:
    assert committed_in_the_dark() == 0


def test_negative_control_taking_stale_peers_for_lost_commits_against_alive_peers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Coordination, "_required_peers", only_seen)
    assert committed_in_the_dark() > 4


def disturbed(event: ScenarioEvent, lost: Set[int] = frozenset(), limit_s: float = 12.0) -> TrialFlight:
    """Four agents that swap; those in `lost` need not arrive, and nobody has to stay in the mission."""
    cell = replace(COARSE_SWAP, delay_ms=50.0)
    return flown(cell, events=(event,), limit_s=limit_s, lost=frozenset(lost))


CUT_AT_S, CUT_S, RESTED_S = 0.5, 6.0, 0.5


def halves(for_s: float = math.inf) -> Split:
    """Half a second after the mission has begun, two and two no longer hear each other."""
    return Split([frozenset({0, 1}), frozenset({2, 3})], CUT_AT_S, for_s)


def test_two_halves_that_are_cut_off_from_each_other_come_to_rest_and_go_on_when_they_hear_each_other_again() -> None:
    cell = replace(COARSE_SWAP, delay_ms=50.0)
    layout = replace(layout_of("swap", 1, 4), events=(halves(CUT_S),), limit_s=20.0)
    speeds_m_s: list[float] = []

    def watch(now: TrialFlight) -> bool:
        if CUT_AT_S + CUT_S - RESTED_S <= mission_t_s(now.lockstep) < CUT_AT_S + CUT_S:
            speeds_m_s.append(float(np.linalg.norm(now.lockstep.world.plant.vel_ned_m_s, axis=0).max()))
        return False

    flight = fly_until(TrialFlight(Trial(cell, 1), layout), watch)
    assert len(speeds_m_s) >= 12 and max(speeds_m_s) < 0.1, "all stand before it is over"
    told = [e for e in events(flight, "membership") if e["suspected"]]
    assert len(told) == 4 and all(len(e["suspected"]) == 2 for e in told)  # type: ignore[arg-type]
    assert not any(e["excluded"] for e in events(flight, "membership")), "no half is a majority"
    row = flight.row(None)
    assert row["outcome"] == "arrived"
    assert row["min_separation_m"] >= COMMITTED_M


def test_negative_control_halves_that_take_missing_tokens_for_deaths_collide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Coordination, "_required_peers", only_seen)
    assert disturbed(halves()).monitor.collided


def two_of_six_cut_off(evasions_shown: float = math.inf) -> TrialFlight:
    """A host with two agents is cut off from two other hosts in the middle of a swap, for 7 s.

    The flight ends with that, or when there have been more evasions.
    """
    cell = replace(COARSE_SWAP, agents=6, delay_ms=20.0)
    event = Split([frozenset({0, 1, 2, 3}), frozenset({4, 5})], 2.5, 7.0)
    layout = replace(layout_of("swap", 1, 6), events=(event,), limit_s=9.5, lost=frozenset({4, 5}))
    return fly_until(TrialFlight(Trial(cell, 1), layout), lambda flight: evasions(flight) > evasions_shown)


def evasions(flight: TrialFlight) -> int:
    policies = [agent._separation for agent in flight._agents if agent is not None]
    return sum(policy._coordination.counts.evasive for policy in policies if isinstance(policy, Guaranteed))


def test_nobody_leaves_a_commitment_for_a_conflict_before_peers_that_are_merely_cut_off() -> None:
    """They fly as they have committed to, but might be frozen: one evades where their autopilots would have flown."""
    flight = two_of_six_cut_off()
    assert flight.monitor.min_separation_m >= COMMITTED_M
    assert evasions(flight) <= 1
    assert events(flight, "conflicting_commitment") == []
    excluded = [e for e in events(flight, "membership") if e["excluded"]]
    assert {str(e["source"]) for e in excluded} == {agent_name(i) for i in range(4)}
    assert all(e["excluded"] == [4, 5] for e in excluded)


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_agents_that_doubt_silent_peers_evade(monkeypatch: pytest.MonkeyPatch) -> None:
    relied_on = Coordination._relied_on

    def only_heard(self: Coordination, utc_us: int, *messages: Any) -> Set[int]:
        heard = relied_on(self, utc_us, *messages) - self._absent() - self._membership.excluded
        self.committed_peers = {agent: self.committed_peers[agent] for agent in heard}
        return heard

    monkeypatch.setattr(Coordination, "_relied_on", only_heard)
    assert evasions(two_of_six_cut_off(4)) > 4


def test_the_others_go_on_without_a_frozen_agent_once_they_agree() -> None:
    """Its process is stopped: its token stays on the bus, and its autopilot lands the vehicle."""
    flight = disturbed(Freeze(3, 1.5, math.inf), lost={3}, limit_s=25.0)
    assert flight.row(None)["outcome"] == "arrived"
    assert flight.monitor.min_separation_m >= TOUCH_M
    excluded = [e for e in events(flight, "membership") if e["excluded"]]
    assert {e["source"] for e in excluded} == {agent_name(i) for i in range(3)}
    assert all(e["excluded"] == [3] for e in excluded)


@pytest.mark.parametrize("landed", [True, False], ids=["", "control: nobody lands its vehicle"])
def test_the_others_arrive_once_the_vehicle_of_a_frozen_agent_has_landed(landed: bool) -> None:
    """Its host's supervisor has another process land it, which tells where it is.

    Of ten draws all arrive with it, and four without it.
    """
    cell = replace(GUARANTEED_SWAP, disturbance="freeze")
    layout = drawn(cell, 10)
    frozen, recovery = layout.events
    flight = TrialFlight(Trial(cell, 10), replace(layout, events=(frozen, recovery)[: 1 + landed], limit_s=15.5))
    flight.run()
    assert flight.monitor.min_separation_m >= TOUCH_M
    assert flight.row(None)["arrived"] is landed


@pytest.mark.parametrize("relayed", [True, False], ids=["", "control: nobody relays"])
def test_all_arrive_although_links_fail_for_seconds(relayed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each direction between two agents delivers nothing for two fifths of the mission, 2 s at once.

    From four draws all arrive after 8 to 10 s, and nobody within 12 s without relays.
    """
    if not relayed:
        monkeypatch.setattr(commitment_publisher, "missed_by_peers", lambda *_, **__: [])
    cell = replace(COARSE_SWAP, disturbance="bursts:0.4")
    flight, is_bad = TrialFlight(Trial(cell, 2), replace(drawn(cell, 2), limit_s=11.0)), _BadPeriods.include

    def once_begun(periods: _BadPeriods, now_us: int) -> bool:
        return is_bad(periods, now_us) and mission_t_s(flight.lockstep) >= 0.0

    monkeypatch.setattr(_BadPeriods, "include", once_begun)
    flight.run()
    assert flight.monitor.min_separation_m >= 0.8
    assert flight.row(None)["arrived"] is relayed


def cut_off_on_the_ground() -> tuple[bool, list[dict[str, Any]]]:
    """Return whether four agents take off that do not hear the last of them for 7 s before, and who is excluded."""
    sets = (*COARSE, "swarm.agents=4", "separation.mode=guaranteed", "mission.kind=swap")
    lockstep = Lockstep(load(None, sets))
    alone, others = agent_name(3), frozenset(map(agent_name, range(3)))

    def begun() -> bool:
        return all(log.rows and log.rows[-1]["phase"][0] == Phase.TRACK for log in lockstep.logs)

    while not begun() and lockstep.clock.now_us() < 24_000_000:
        lockstep.step()
        if lockstep.clock.now_us() == 2_400_000:  # all have seen their vehicles, and heard each other
            lockstep.hub.split([frozenset({alone}), others])
        if lockstep.clock.now_us() == 9_400_000:
            lockstep.hub.heal()
    return begun(), [e for log in lockstep.logs for e in log.events if e["event"] == "membership" and e["excluded"]]


def test_nobody_is_excluded_for_silence_before_anybody_flies() -> None:
    assert cut_off_on_the_ground() == (True, [])


def test_negative_control_who_is_excluded_on_the_ground_is_waited_for_in_vain(monkeypatch: pytest.MonkeyPatch) -> None:
    def by_silence(self: Coordination, utc_us: int) -> set[int]:
        return {
            i
            for i in self._peers - self._ended
            if self._peer_trajectories.silence_us(i, utc_us) > coordination._SUSPECT_US
        }

    monkeypatch.setattr(Coordination, "_suspected", by_silence)
    begun, excluded = cut_off_on_the_ground()
    assert not begun
    assert excluded
