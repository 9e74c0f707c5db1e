"""Guaranteed separation in flight: late and lost messages, a bus that falls apart, and what is reported of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from sitl.studies.campaign.conditions.scenarios import layout_of
from sitl.studies.campaign.flight import TrialFlight
from sitl.studies.campaign.trials import Row
from swarmctl.agent.planning.separation_policy import Guaranteed, SeparationDirective, SeparationInputs
from swarmctl.bus.bus import agent_name
from swarmctl.bus.peer_clocks import PeerClocks
from swarmctl.core.clock import ClockError
from tests.benches.guaranteed_trials import COMMITTED_M, GUARANTEED_SWAP, TOUCH_M, events, flown


def test_late_and_lost_messages_cost_time_and_no_distance() -> None:
    flight = flown(replace(GUARANTEED_SWAP, delay_ms=300.0, loss=0.3))
    row = flight.row(None)
    assert row["outcome"] == "arrived"
    assert row["min_separation_m"] >= COMMITTED_M
    assert events(flight, "tracking_violation") == []


PROMPT_S = 12.0  # of four trials: 8.1 to 9.9 s; agents that lock in the middle of their swap take 11 to 18 s


def swap_of_six(traffic_rule: str = "", seed: int = 1) -> Row:
    """Fly a swap whose plans are late, for `PROMPT_S` at most."""
    cell = replace(GUARANTEED_SWAP, agents=6, delay_ms=100.0, sets=traffic_rule)
    return flown(cell, seed, limit_s=PROMPT_S).row(None)


def test_agents_that_meet_give_way_by_rule_before_all_stand() -> None:
    row = swap_of_six(seed=2)
    assert row["min_separation_m"] >= COMMITTED_M
    assert row["arrived"]


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_agents_that_give_way_only_after_standing_lock() -> None:
    row = swap_of_six("agent.commit.right_of_way_rad=0.35 agent.commit.stuck_m=0.1", seed=2)
    assert row["min_separation_m"] >= COMMITTED_M - 0.03
    assert not row["arrived"]


SWAP_WITH_A_DEATH = replace(GUARANTEED_SWAP, scenario="death", agents=6, delay_ms=100.0)


def test_agents_fly_around_where_a_lost_peer_was_committed_to_end() -> None:
    """If recovery did not see it, an agent would stand for good between that place and the lost peer's last path.

    From one of six starts the lost peer, number 5, may stay 0.45 m from the goal of another, which waits beside it.
    """
    flight = flown(SWAP_WITH_A_DEATH, 3)
    goals_ned_m = layout_of("death", 3, 6).goals_ned_m
    witness = flight.lockstep.agents[0]
    assert witness is not None and isinstance(witness._separation, Guaranteed) and goals_ned_m is not None
    kept = witness._separation.coordination.lost_peer_keep_outs
    free = [i for i in range(5) if all(keep_out.distance_m(goals_ned_m[i]) > keep_out.radius_m for keep_out in kept)]
    assert len(free) >= 4
    assert flight.monitor.arrived[free].all()
    assert not flight.monitor.collided


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_an_agent_that_does_not_see_where_a_lost_peer_may_be_stands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One of ten layouts shows it; who sees it arrives there in 19.4 s, from four of six shifted starts."""
    step = Guaranteed.step

    def without_lost_peers(self: Guaranteed, inputs: SeparationInputs) -> SeparationDirective:
        return replace(step(self, inputs), lost_peer_keep_outs=())

    monkeypatch.setattr(Guaranteed, "step", without_lost_peers)
    assert not flown(SWAP_WITH_A_DEATH, 9, limit_s=20.5).row(None)["arrived"]


def test_negative_control_agents_that_see_nobody_touch() -> None:
    assert (
        flown(replace(GUARANTEED_SWAP, delay_ms=300.0, loss=0.3, protections="off")).row(None)["min_separation_m"]
        < TOUCH_M
    )


def flown_by_clocks(ahead_ms: Sequence[float], sets: str = "") -> TrialFlight:
    """Four agents that swap, each by a clock of its own that also drifts."""
    cell = replace(GUARANTEED_SWAP, delay_ms=50.0, sets=sets)
    clocks = {
        agent: ClockError(offset_us=round(1000 * ms), drift_ppm=200.0 * (-1) ** agent)
        for agent, ms in enumerate(ahead_ms)
    }
    return flown(cell, 2, clocks=clocks)


def test_agents_whose_clocks_differ_by_a_second_keep_apart() -> None:
    flight = flown_by_clocks((-500.0, 500.0, -500.0, 500.0))
    row = flight.row(None)
    assert row["outcome"] == "arrived"
    assert row["min_separation_m"] >= COMMITTED_M
    assert {e["agent"] for e in events(flight, "clock_offset") if e["source"] == agent_name(0)} == {1, 3}


def test_negative_control_by_stamps_as_they_are_agents_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PeerClocks, "ahead_us", lambda self, agent: 0)
    flight = flown_by_clocks((300.0, -300.0, 300.0, -300.0), "separation.approach_01=0")
    assert flight.monitor.min_separation_m < TOUCH_M
