"""Tests that every claim about a flight holds with either QP solver.

Single positions may differ. Three vehicles that close in on one moving point may settle around it at any angle, which
depends on the smallest difference; the negative control below shows how much.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from tests.closed_loop.conftest import FINE, Flight, Fly, fly_now

DURATION_S = 10.0
MISSION = (FINE, f"mission.duration_s={DURATION_S}", "sitl.start=air")
NUDGED = "start.positions_ned_m=[[-1.0,0.0,0.0],[0.0,0.001,0.0],[1.0,0.0,0.0]]"  # the second by 1 mm
OSQP, DAQP = ("controller.mpc.qp.solver='osqp'", "controller.mpc.qp.solver='daqp'")


@pytest.fixture(scope="module")
def osqp() -> Flight:
    return fly_now(*MISSION, OSQP)


@pytest.fixture(scope="module")
def daqp() -> Flight:
    return fly_now(*MISSION, DAQP, until=Lockstep.mission_is_over)


def apart_m(one: Flight, other: Flight) -> NDArray[np.float64]:
    """Return the distance (K, N) of every vehicle between two flights at common mission times, 0.02 s apart."""
    paths = []
    for flight in (one, other):
        began_s = flight.tracked(0)[0]["t_us"][0] * 1e-6
        t_s = flight.t_s - began_s
        paths.append(flight.pos_ned_m[(t_s >= 0.0) & (t_s < DURATION_S - 0.1)])
    count = min(len(path) for path in paths)
    return np.asarray(np.linalg.norm(paths[0][:count] - paths[1][:count], axis=2))


def test_both_complete_the_mission_without_a_failed_plan(osqp: Flight, daqp: Flight) -> None:
    assert osqp.problems == [], "also when it is handed back; with DAQP that is part of the other tests"
    for flight in (osqp, daqp):
        assert flight.outcomes == {"completed"}
        assert all(not flight.tracked(agent)[0]["plan_status"].any() for agent in range(3))


def test_summed_mean_tracking_error_is_the_same_within_one_per_cent(osqp: Flight, daqp: Flight) -> None:
    assert daqp.summed_mean_error_m() == pytest.approx(osqp.summed_mean_error_m(), rel=0.01)


def test_separation_is_the_same_within_a_centimetre(osqp: Flight, daqp: Flight) -> None:
    assert daqp.separation_m() == pytest.approx(osqp.separation_m(), abs=0.01)
    assert daqp.separation_m() >= 0.85


def test_height_is_the_same_within_a_centimetre(osqp: Flight, daqp: Flight) -> None:
    """It differs by 0.8 to 6.5 mm from six starts: agents that are elsewhere around the reference yield elsewhere."""
    heights = [flight.tracked(agent)[1][:, 2] for agent in range(3) for flight in (osqp, daqp)]
    for one, other in zip(heights[::2], heights[1::2], strict=True):
        np.testing.assert_allclose(one, other, atol=0.01)


def test_positions_diverge_slowly(osqp: Flight, daqp: Flight) -> None:
    apart = apart_m(osqp, daqp)
    assert apart[:50].max() < 0.1  # first second; measured 0.05
    assert apart.max() < 1.3  # the width of the formation: they settle at another angle; measured 0.3 to 1.1


def test_negative_control_a_millimetre_at_the_start_parts_them_as_much(daqp: Flight, fly: Fly) -> None:
    nudged = fly(*MISSION, DAQP, NUDGED, until=Lockstep.mission_is_over)
    assert apart_m(daqp, nudged).max() > 0.1  # measured 0.5; 1.1 by a millimetre the other way
