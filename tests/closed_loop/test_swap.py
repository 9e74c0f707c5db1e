"""Tests that eight agents swap places through one centre."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.core.types import PlanStatus
from tests.closed_loop.conftest import COARSE, Flight, Fly, mission_is_over, mission_t_s

SWAP = ("mission.duration_s=12", "sitl.start=air")  # from ten starts all agents arrive within 9.5 to 11.7 s


def all_arrived(lockstep: Lockstep) -> bool:
    """Everybody is where its reference has come to rest."""
    if mission_t_s(lockstep) < 8.0:
        return False
    last = [log.rows[-1][0] for log in lockstep.logs]
    return all(np.linalg.norm(row["pos_ned_m"] - row["ref_pos_ned_m"]) < 0.05 for row in last)


def check(flight: Flight) -> None:
    assert flight.separation_m() >= 0.85
    for agent in range(8):
        _, error = flight.tracked(agent)
        assert np.linalg.norm(error[-1]) < 0.1, "everybody arrives"
        ticks = flight.ticks(agent)
        status = ticks["plan_status"]
        assert not (status == PlanStatus.SOLVER_FAILED).any(), (
            "what OSQP does not finish is solved; alone it fails in 12"
        )
        assert np.count_nonzero(status == PlanStatus.RESIDUAL) <= 1, "one that lacks a metre may be inexact"


@pytest.mark.usefixtures("configured_starts")
def test_eight_agents_swap_without_touching(fly: Fly) -> None:
    flight = fly(*SWAP, config="swap8.toml", until=mission_is_over)
    assert flight.outcomes == {"completed"}
    check(flight)
    for agent in range(8):
        acted = flight.ticks(agent)["safety_filter_acted"]
        assert not acted.any(), "the safety filter is not what keeps them apart"


@pytest.mark.parametrize("seed", [1, 2])
def test_eight_agents_swap_from_starts_a_millimetre_off(fly: Fly, seed: int) -> None:
    """Which agent yields differs between starts, and so does the duration.

    Without the safety filter, as that is not what keeps them apart; it acts from one of six starts, on who pass fast.
    """
    sets = ("mission.duration_s=20", "agent.barrier.enabled=false")
    check(fly(*SWAP, *sets, config="swap8.toml", until=all_arrived, seed=seed))


def four_meet(fly: Fly, seed: int, *sets: str) -> Flight:
    """Fly a symmetric swap of four at half the rate until all have passed the middle."""
    places = "start.positions_ned_m=[[3,0,0],[0,3,0],[-3,0,0],[0,-3,0]]"
    mission = ("swarm.agents=4", places, "mission.swap.travel_s=6", "mission.duration_s=12", "sitl.start=air")
    return fly(*COARSE, *mission, *sets, config="swap8.toml", until=lambda now: mission_t_s(now) >= 5.0, seed=seed)


@pytest.mark.parametrize("seed", range(6))
def test_four_agents_that_meet_keep_their_distance_from_every_start(fly: Fly, seed: int) -> None:
    """The worst of 48 starts shifted by millimetres are 0.846 and 0.862 m."""
    assert four_meet(fly, seed).separation_m() >= 0.85


@pytest.mark.usefixtures("configured_starts")
def test_negative_control_without_room_for_those_who_come_closer_four_come_closer(fly: Fly) -> None:
    """From twelve starts they come to 0.81 to 0.90 m: each changes its plan while the others do."""
    assert any(four_meet(fly, seed, "separation.approach_01=0").separation_m() < 0.85 for seed in range(4))


@pytest.mark.usefixtures("configured_starts")
def test_with_one_problem_for_three_axes_agents_come_to_rest(fly: Fly) -> None:
    """OSQP's tolerance for dual residuals follows the largest increments, which are z's: x-y needs a closer one."""
    sets = ("swarm.agents=4", "mission.kind=swap", "controller.kind=dmpc3", "mission.duration_s=14", "sitl.start=air")
    flight = fly(*sets, until=mission_is_over)
    assert flight.separation_m() >= 0.85
    for agent in range(4):
        assert np.linalg.norm(flight.ticks(agent)["vel_ned_m_s"][-1]) < 0.03, "0.12 m/s with ten times the tolerance"
