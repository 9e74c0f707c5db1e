"""Guaranteed separation in flight: late and lost messages, a bus that falls apart, and what is reported of it."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.events import Freeze, ScenarioEvent, Split
from sitl.studies.campaign.flight import TrialFlight, drawn
from sitl.studies.campaign.scenarios import layout_of
from sitl.studies.campaign.trials import Cell, Trial
from swarmctl.agent.planning import coordination
from swarmctl.agent.planning.coordination import Coordination
from swarmctl.agent.planning.separation_policy import Guaranteed
from swarmctl.bus.peer_clocks import PeerClocks
from swarmctl.bus.peers import agent_name
from swarmctl.config import load
from swarmctl.control.collision.barrier import Barrier, BarrierParams, Body
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit import trajectory_planner
from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.mpc.problem import Start
from swarmctl.core.clock import ClockError
from swarmctl.core.types import Array, Phase
from tests.closed_loop.conftest import ROOT

COMMITTED_M = 0.8
TOUCH_M = 0.48
TUBE_M = 0.5 * (COMMITTED_M - TOUCH_M)


def flown(cell: Cell, seed: int = 1) -> TrialFlight:
    flight = TrialFlight(Trial(cell, seed), layout_of(cell.scenario, seed, cell.agents))
    flight.run()
    return flight


def events(flight: TrialFlight, name: str) -> list[dict[str, object]]:
    return [event for log in flight.lockstep.logs for event in log.events if event["event"] == name]


def test_late_and_lost_messages_cost_time_and_no_distance() -> None:
    flight = flown(
        Cell(scenario="swap", agents=4, delay_ms=300.0, loss=0.3, noise="exact", wind_m_s=0.0, protections="guaranteed")
    )
    row = flight.row(None)
    assert row["outcome"] == "arrived"
    assert row["min_separation_m"] >= COMMITTED_M
    assert events(flight, "tracking_violation") == []


@pytest.mark.parametrize(
    ("traffic_rule", "bound_m"),
    [
        ("", COMMITTED_M),
        ("agent.commit.right_of_way_rad=0.35 agent.commit.stuck_m=0.1", COMMITTED_M - 0.03),
    ],
    ids=["right of way early", "control: only after standing"],
)
def test_agents_that_meet_give_way_by_rule_before_all_stand(traffic_rule: str, bound_m: float) -> None:
    """Late plans that end in stops lock in the middle of a swap, and to get out of that takes as long again."""
    row = flown(
        Cell(
            scenario="swap",
            agents=6,
            delay_ms=100.0,
            loss=0.0,
            noise="exact",
            wind_m_s=0.0,
            protections="guaranteed",
            sets=traffic_rule,
        )
    ).row(None)
    assert row["min_separation_m"] >= bound_m
    assert (row["flight_time_s"] < 11.0) is (traffic_rule == "")


def test_agents_fly_around_where_a_lost_peer_was_committed_to_end() -> None:
    """If recovery did not see it, an agent would stand for good between that place and the lost peer's last path."""
    assert (
        flown(
            Cell(
                scenario="death",
                agents=6,
                delay_ms=100.0,
                loss=0.0,
                noise="exact",
                wind_m_s=0.0,
                protections="guaranteed",
            ),
            3,
        ).row(None)["outcome"]
        == "arrived"
    )


def test_negative_control_agents_that_see_nobody_touch() -> None:
    assert (
        flown(
            Cell(scenario="swap", agents=4, delay_ms=300.0, loss=0.3, noise="exact", wind_m_s=0.0, protections="off")
        ).row(None)["min_separation_m"]
        < TOUCH_M
    )


def committed_in_the_dark(sees: type[Coordination] = Coordination) -> int:
    """How many trajectories are committed from 1.6 s to 2 s after the bus has fallen apart."""
    flight = TrialFlight(
        Trial(
            Cell(
                scenario="swap", agents=4, delay_ms=0.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="guaranteed"
            ),
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
        counts.append(sum(p.coordination.counts.committed for p in policies if isinstance(p, Guaranteed)))

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


def flown_by_clocks(ahead_ms: Sequence[float]) -> TrialFlight:
    """Four agents that swap, each by a clock of its own that also drifts."""
    cell = Cell(
        scenario="swap", agents=4, delay_ms=50.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="guaranteed"
    )
    clocks = {
        agent: ClockError(offset_us=round(1000 * ms), drift_ppm=200.0 * (-1) ** agent)
        for agent, ms in enumerate(ahead_ms)
    }
    flight = TrialFlight(Trial(cell, 2), replace(layout_of("swap", 2, 4), clocks=clocks))
    flight.run()
    return flight


def test_agents_whose_clocks_differ_by_a_second_keep_apart() -> None:
    flight = flown_by_clocks((-500.0, 500.0, -500.0, 500.0))
    row = flight.row(None)
    assert row["outcome"] == "arrived"
    assert row["min_separation_m"] >= COMMITTED_M
    assert {e["agent"] for e in events(flight, "clock_offset") if e["source"] == agent_name(0)} == {1, 3}


def test_negative_control_by_stamps_as_they_are_agents_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PeerClocks, "ahead_us", lambda self, agent: 0)
    assert flown_by_clocks((300.0, -300.0, 300.0, -300.0)).monitor.min_separation_m < TOUCH_M


def disturbed(event: ScenarioEvent, lost: Set[int] = frozenset(), limit_s: float = 12.0) -> TrialFlight:
    """Four agents that swap; those in `lost` need not arrive, and nobody has to stay in the mission."""
    cell = Cell(
        scenario="swap", agents=4, delay_ms=50.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="guaranteed"
    )
    layout = replace(layout_of("swap", 1, 4), events=(event,), limit_s=limit_s, lost=frozenset(lost))
    flight = TrialFlight(Trial(cell, 1), layout)
    flight.run()
    return flight


def halves(for_s: float = math.inf) -> Split:
    """Half a second after the mission has begun, two and two no longer hear each other."""
    return Split([frozenset({0, 1}), frozenset({2, 3})], 0.5, for_s)


def test_two_halves_that_are_cut_off_from_each_other_both_come_to_rest() -> None:
    flight = disturbed(halves())
    assert flight.monitor.min_separation_m >= COMMITTED_M
    assert np.linalg.norm(flight.lockstep.world.plant.vel_ned_m_s, axis=0).max() < 0.1
    told = events(flight, "membership")
    assert len(told) == 4 and all(len(e["suspected"]) == 2 and e["excluded"] == [] for e in told)  # type: ignore[arg-type]


def test_halves_that_hear_each_other_again_in_time_go_on() -> None:
    row = disturbed(halves(for_s=4.0), limit_s=20.0).row(None)
    assert row["outcome"] == "arrived"
    assert row["min_separation_m"] >= COMMITTED_M


def test_negative_control_halves_that_take_missing_tokens_for_deaths_collide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Coordination, "_required_peers", only_seen)
    assert disturbed(halves()).monitor.collided


def two_of_six_cut_off() -> TrialFlight:
    """A host with two agents is cut off from two other hosts in the middle of a swap, for 5 s."""
    cell = Cell(
        scenario="swap", agents=6, delay_ms=20.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="guaranteed"
    )
    event = Split([frozenset({0, 1, 2, 3}), frozenset({4, 5})], 2.5, 5.0)
    layout = replace(layout_of("swap", 1, 6), events=(event,), limit_s=9.0, lost=frozenset({4, 5}))
    flight = TrialFlight(Trial(cell, 1), layout)
    flight.run()
    return flight


def evasions(flight: TrialFlight) -> int:
    policies = [agent._separation for agent in flight._agents if agent is not None]
    return sum(policy.coordination.counts.evasive for policy in policies if isinstance(policy, Guaranteed))


def test_nobody_leaves_a_commitment_before_peers_that_are_merely_cut_off() -> None:
    flight = two_of_six_cut_off()
    assert flight.monitor.min_separation_m >= COMMITTED_M
    assert evasions(flight) == 0
    excluded = [e for e in events(flight, "membership") if e["excluded"]]
    assert {str(e["source"]) for e in excluded} == {agent_name(i) for i in range(4)}
    assert all(e["excluded"] == [4, 5] for e in excluded)


def test_negative_control_agents_that_doubt_silent_peers_evade(monkeypatch: pytest.MonkeyPatch) -> None:
    relied_on = Coordination._relied_on

    def only_heard(self: Coordination, utc_us: int, *messages: Any) -> Set[int]:
        heard = relied_on(self, utc_us, *messages) - self._absent() - self._membership.excluded
        self.committed_peers = {agent: self.committed_peers[agent] for agent in heard}
        return heard

    monkeypatch.setattr(Coordination, "_relied_on", only_heard)
    flight = two_of_six_cut_off()
    assert evasions(flight) > 4
    assert len(events(flight, "tracking_violation")) > 2, "pushed by safety filters, some leave their tubes"


def test_the_others_go_on_without_a_frozen_agent_once_they_agree() -> None:
    """Its process is stopped: its token stays on the bus, and its autopilot lands the vehicle."""
    flight = disturbed(Freeze(3, 1.5, math.inf), lost={3}, limit_s=25.0)
    assert flight.row(None)["outcome"] == "arrived"
    assert flight.monitor.min_separation_m >= TOUCH_M
    excluded = [e for e in events(flight, "membership") if e["excluded"]]
    assert {e["source"] for e in excluded} == {agent_name(i) for i in range(3)}
    assert all(e["excluded"] == [3] for e in excluded)


class HeldUp:
    """One x500 on a circle at 2.5 m/s whose world stands still for a while, again and again, while time goes on.

    So it is with simulators, and with an agent, that get too little of a processor: for 1.4 s the world gets 70 % of
    the time, in pieces, and the agent executes every other tick.
    """

    BEGINS_S, LASTS_S, AFTERWARDS_S = 3.0, 1.4, 1.0

    def __init__(self) -> None:
        sets = ["swarm.agents=1", "sitl.start=air", "sitl.estimator=exact", "separation.mode=guaranteed"]
        self.flight = Lockstep(load(ROOT / "configs" / "x500_circle.toml", sets))
        self._world_step, self._lost_us, self._began_us = self.flight.world.step, 0, 0
        self.flight.world.step = self._step  # type: ignore[method-assign]

    def _since_s(self) -> float:
        return (self.flight.clock.now_us() - self._began_us) * 1e-6 - self.BEGINS_S if self._began_us else -math.inf

    def _step(self, now_us: int) -> None:
        since_s = self._since_s()
        if 0.0 < since_s < self.LASTS_S and since_s % 0.233 < 0.07:
            self._lost_us += 1_000_000 // self.flight.config.sitl.physics_hz
        else:
            self._world_step(now_us - self._lost_us)

    def fly(self) -> tuple[float, float]:
        """Return how far it was off what it had committed to [m], and how fast it was afterwards [m/s]."""
        flight, fastest_m_s = self.flight, 0.0
        while (since_s := self._since_s()) < self.LASTS_S + self.AFTERWARDS_S:
            flight.starved = {0: 2} if 0.0 < since_s < self.LASTS_S else {}
            flight.step()
            if not self._began_us and flight.logs[0].rows and flight.logs[0].rows[-1]["phase"][0] == Phase.TRACK:
                self._began_us = flight.clock.now_us()
            if since_s > self.LASTS_S:
                fastest_m_s = max(fastest_m_s, float(np.linalg.norm(flight.world.plant.vel_ned_m_s[:, 0])))
        (agent,) = flight.agents
        assert agent is not None and isinstance(agent._separation, Guaranteed)
        return agent._separation.coordination.worst_tracking_m, fastest_m_s


def test_a_vehicle_that_is_held_up_slows_and_does_not_chase_what_it_had_committed_to() -> None:
    off_m, fastest_m_s = HeldUp().fly()
    assert off_m < 0.3
    assert fastest_m_s < 1.5


def test_negative_control_commitments_that_go_on_in_time_are_chased(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Commitments, "wait_for", lambda self, *_: None)
    monkeypatch.setattr(coordination, "slowed", lambda desired, *_: desired)
    off_m, fastest_m_s = HeldUp().fly()
    assert off_m > 0.4
    assert fastest_m_s > 2.3


@pytest.mark.parametrize(("body_m", "told"), [(0.48, False), (0.8, True)])
def test_a_tracking_violation_is_reported(body_m: float, told: bool) -> None:
    """The error may be half of the committed distance beyond touching bodies; the safety filter deflects large ones."""
    flight = flown(
        Cell(
            scenario="swap",
            agents=2,
            delay_ms=0.0,
            loss=0.0,
            noise="exact",
            wind_m_s=0.0,
            protections="guaranteed",
            sets=f"separation.body_m={body_m}",
        )
    )
    assert flight.row(None)["outcome"] == "arrived"
    off = events(flight, "tracking_violation")
    assert bool(off) is told
    if told:
        assert off[0]["begins"] is True
        assert float(str(off[0]["error_m"])) > float(str(off[0]["allowed_m"])) == pytest.approx(0.1 / 3)


@pytest.mark.parametrize(("weights", "moves", "follows"), [("", 10, True), ("{q_pos=2.0,q_vel=0.05,r=1.0}", 3, False)])
def test_the_committed_trajectory_is_tracked_in_height_too(
    weights: str, moves: int, follows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Into a climbing circle from rest; control: the thesis' soft z, which is good enough for a desired reference."""
    monkeypatch.setattr(trajectory_planner, "_FOLLOWING_MOVES_Z", moves)
    sets = ["swarm.agents=1", "sitl.start=air", "separation.mode=guaranteed", "mission.duration_s=2.5"]
    sets += [f"agent.commit.follow_z={weights}"] * bool(weights)
    flight = Lockstep(load(None, sets))
    flight.run()
    (told,) = [event for event in flight.logs[0].events if event["event"] == "commitments"]
    assert (told["worst_tracking_m"] < 0.1) is follows
    assert (told["worst_tracking_m"] > TUBE_M) is not follows


def test_a_tick_with_a_stale_state_commits_nothing_and_spends_no_time_on_it() -> None:
    flight = Lockstep(load(None, ["swarm.agents=1", "sitl.start=air", "separation.mode=guaranteed"]))
    while not flight.logs[0].rows or flight.logs[0].rows[-1]["phase"][0] != Phase.TRACK:
        flight.step()
    (agent,) = flight.agents
    assert agent is not None
    assert agent.timing.commitment_ms > 0.0
    flight.links[0][1].send = lambda data: None  # type: ignore[method-assign]
    for _ in range(15):
        flight.step()
    assert agent.timing.commitment_ms == 0.0
    assert agent.timing.setup_ms >= 0.0


@pytest.mark.parametrize("mode", ["guaranteed", "best_effort"])
def test_the_safety_filter_places_peers_on_their_committed_trajectories(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A commitment holds however old its message is, but for the error of the clock, which is a round trip at most.

    Control: a path's margin grows with the age the bus gives it.
    """
    flight = Lockstep(load(None, ["swarm.agents=2", "sitl.start=air", f"separation.mode={mode}", "bus.delay_ms=60"]))
    seen_m: list[float] = []
    filtered = Barrier.filtered

    round_trip_s = 0.0

    def watched(
        self: Barrier,
        virtual_control: Array,
        start: Start,
        disturbance_ned_m_s2: Array,
        hover_thrust_01: float,
        *,
        bodies: Sequence[Body],
    ) -> Array | None:
        seen_m.extend(body.apart_m - round_trip_s * math.hypot(*body.vel_ned_m_s) for body in bodies)
        return filtered(self, virtual_control, start, disturbance_ned_m_s2, hover_thrust_01, bodies=bodies)

    monkeypatch.setattr(Barrier, "filtered", watched)
    while not flight.logs[0].rows or flight.logs[0].rows[-1]["phase"][0] != Phase.TRACK:
        flight.step()
    seen_m.clear()
    if mode == "guaranteed":
        (agent, _) = flight.agents
        assert agent is not None
        round_trip_s = 1e-6 * agent._world_model.clocks.spread_us(1)
        assert 0.06 <= round_trip_s <= 0.16, "the delay there and back, and ticks"
    for _ in range(25):
        flight.step()
    least_m = SeparationParams().body_m + BarrierParams().margin_m
    assert len(seen_m) > 5
    assert (seen_m == pytest.approx([least_m] * len(seen_m))) is (mode == "guaranteed")


@pytest.mark.parametrize("relayed", [True, False], ids=["", "control: nobody relays"])
def test_all_arrive_although_links_fail_for_seconds(relayed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each direction between two agents delivers nothing for two fifths of the time, 2 s at once."""
    if not relayed:
        monkeypatch.setattr(coordination, "missed_by_peers", lambda *_: [])
    cell = Cell(
        scenario="swap",
        agents=4,
        delay_ms=0.0,
        loss=0.0,
        noise="exact",
        wind_m_s=0.0,
        protections="guaranteed",
        disturbance="bursts:0.4",
    )
    flight = TrialFlight(Trial(cell, 2), replace(drawn(cell, 2), limit_s=12.0))
    flight.run()
    assert flight.monitor.min_separation_m >= 0.8
    assert flight.row(None)["arrived"] is relayed
