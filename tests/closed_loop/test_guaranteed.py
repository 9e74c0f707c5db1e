"""Guaranteed separation in flight: late and lost messages, a bus that falls apart, and what is reported of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.flight import TrialFlight
from sitl.studies.campaign.trials import Row
from swarmctl.agent.planning.separation_policy import Guaranteed, SeparationDirective, SeparationInputs
from swarmctl.bus.bus import agent_name
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.config import load
from swarmctl.core.clock import ClockError
from tests.benches.guaranteed_trials import COMMITTED_M, GUARANTEED_SWAP, TOUCH_M, events, flown
from tests.closed_loop.conftest import AT_100_HZ, mission_t_s


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


def behind_one_that_dies() -> tuple[float, float]:
    """Fly an agent behind one that dies in front of a gap and was committed to end in it; return how near it comes.

    The other one's vehicle is landed before the gap, so that nothing but the commitment is left there. Distances [m]:
    the least to where that ends, and the one to the goal when it rests within a metre of it (29 s), or after 34 s.
    """
    ends_in_ned_m = np.array([10.8, 0.0, -5.0])
    posts = ",".join(
        f"{{center_ned_m=[10.8,{east_m},0],column=true,radius_m=0.3,keep_out_m=1.0,visibility_m=9}}"
        for east_m in (-2.9, -1.7, 1.7, 2.9)
    )
    flight = Lockstep(
        load(
            None,
            (
                AT_100_HZ,
                "swarm.agents=2",
                "start.positions_ned_m=[[-12,0,-5],[-6,0,-5]]",
                "mission.kind=goto",
                "mission.goto.goals_ned_m=[[16,0,-5],[20,0,-5]]",
                "mission.goto.speed_m_s=3.5",
                "mission.goto.accel_m_s2=2",
                "mission.duration_s=60",
                "separation.mode=guaranteed",
                "sitl.start=air",
                f"obstacles=[{posts}]",
            ),
        )
    )
    nearest_m, from_goal_m, speed_m_s, lives = np.inf, np.inf, np.inf, True
    while not mission_t_s(flight) > 34.0 and not (from_goal_m < 1.0 and speed_m_s < 0.1):
        flight.step()
        truth = flight.world.truth_rows()
        here, other = truth["pos_ned_m"]
        from_goal_m = float(np.linalg.norm(here - [16.0, 0.0, -5.0]))
        speed_m_s = float(np.linalg.norm(truth["vel_ned_m_s"][0]))
        if lives and other[0] > 0.0:
            flight.kill(1)
            lives = False
        nearest_m = min(nearest_m, float(np.linalg.norm(here - ends_in_ned_m)))
    return nearest_m, from_goal_m


def test_an_agent_flies_around_where_a_lost_peer_was_committed_to_end() -> None:
    """If recovery did not see that end, it would take the gap for free and stand before it for good."""
    nearest_m, from_goal_m = behind_one_that_dies()
    assert nearest_m > 0.75, "0.9 m from either of the two places where it may end"
    assert from_goal_m < 1.0


def test_negative_control_an_agent_that_does_not_see_where_a_lost_peer_may_be_stands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step = Guaranteed.step

    def without_lost_peers(self: Guaranteed, inputs: SeparationInputs) -> SeparationDirective:
        return replace(step(self, inputs), lost_peer_keep_outs=())

    monkeypatch.setattr(Guaranteed, "step", without_lost_peers)
    _, from_goal_m = behind_one_that_dies()
    assert from_goal_m > 5.0


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
