"""Figures of a flight on traces made by hand, by numbers worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from sitl.studies.thesis import score
from sitl.studies.thesis.trace import Row, Trace
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array
from swarmctl.telemetry.evaluation.referee import STEADY_AFTER_S

DT_S = 0.02
REFERENCE_NED_M = np.array([10.0, -20.0, -5.0])  # far off zero: a figure of positions would show


def trace_of(off_ned_m: Array, obstacles: Sequence[Obstacle] = ()) -> Trace:
    """A flight whose agents are `off_ned_m` (T, N, 3) away from a reference that stands still."""
    ticks, agents, _ = off_ned_m.shape
    nothing = np.zeros((ticks, agents, 3))
    reference = nothing + REFERENCE_NED_M
    return Trace(
        name="by hand",
        path="plant",
        t_s=np.asarray(np.arange(ticks) * DT_S, np.float64),
        pos_ned_m=reference + off_ned_m,
        vel_ned_m_s=nothing,
        euler_rad=nothing,
        ref_pos_ned_m=reference,
        euler_ref_rad=nothing,
        thrust_n=np.zeros((ticks, agents)),
        torque_n_m=nothing,
        failed=0,
        terminal_missed=0,
        obstacles=tuple(obstacles),
    )


def two_ticks() -> Trace:
    """Of the first agent 5 m and then 13 m off, of the second 1 m and then 2 m."""
    return trace_of(np.array([[[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]], [[0.0, 5.0, -12.0], [2.0, 0.0, 0.0]]]))


def late(before_m: float, after_ned_m: tuple[float, float, float], agents: int = 1) -> Trace:
    """`before_m` off northwards until 10 s, then `after_ned_m`; 12 s in all."""
    off = np.zeros((600, agents, 3))
    off[:500, :, 0] = before_m
    off[500:] = after_ned_m
    return trace_of(off)


def test_mean_distance_is_euclidean_and_of_the_first_vehicle() -> None:
    assert score.mean_distance_m(two_ticks()) == pytest.approx((5.0 + 13.0) / 2)


@pytest.mark.parametrize(("axis", "mse_m2"), [(0, 9.0 / 2), (1, (16.0 + 25.0) / 2), (2, 144.0 / 2)])
def test_mean_squared_error_is_of_one_axis_of_the_first_vehicle(axis: int, mse_m2: float) -> None:
    assert score.mse_m2(two_ticks(), axis) == pytest.approx(mse_m2)


def test_steady_rmse_is_of_the_worst_axis_after_10_s() -> None:
    assert score.steady_rmse_m(late(7.0, (0.01, -0.03, 0.02))) == pytest.approx(0.03)
    swinging = late(7.0, (0.0, 0.0, 0.0))
    swinging.pos_ned_m[500::2, 0, 2] += 0.04  # every second of 100 samples: 0.04 / sqrt(2)
    assert score.steady_rmse_m(swinging) == pytest.approx(0.04 / math.sqrt(2.0))


def test_steady_rmse_counts_a_constant_offset() -> None:
    """It is no standard deviation."""
    assert score.steady_rmse_m(late(0.0, (0.0, 0.5, 0.0))) == pytest.approx(0.5)


def test_the_sample_at_10_s_is_steady_and_the_one_before_is_not() -> None:
    at = late(0.0, (0.0, 0.0, 0.0))
    assert at.t_s[500] == STEADY_AFTER_S
    at.pos_ned_m[499, 0, 0] += 1.0
    assert score.steady_rmse_m(at) == 0.0
    at.pos_ned_m[500, 0, 0] += 1.0
    assert score.steady_rmse_m(at) == pytest.approx(math.sqrt(1.0 / 100))


def test_index_sums_the_mean_distances_of_all_agents() -> None:
    assert score.index_m(two_ticks()) == pytest.approx((5.0 + 13.0) / 2 + (1.0 + 2.0) / 2)


def test_index_of_one_vehicle_is_its_mean_distance() -> None:
    alone = late(2.0, (0.0, 0.0, 1.0))
    assert score.index_m(alone) == score.mean_distance_m(alone) == pytest.approx((500 * 2.0 + 100 * 1.0) / 600)


def test_index_after_a_time_forgets_what_was_before() -> None:
    trace = late(2.0, (0.0, 0.3, 0.4), agents=3)
    assert score.index_m(trace, 10.0) == pytest.approx(3 * 0.5)
    assert score.index_m(trace) == pytest.approx(3 * (500 * 2.0 + 100 * 0.5) / 600)


def test_separation_is_of_the_closest_pair_at_the_closest_tick() -> None:
    off = np.zeros((3, 3, 3))
    off[:, 1] = (4.0, 0.0, 0.0)
    off[:, 2] = (0.0, 9.0, 0.0)
    assert score.separation_m(trace_of(off)) == pytest.approx(4.0)
    off[1, 2] = (4.0, 0.6, -0.8)  # 1 m from the second, in height too, at one tick only
    assert score.separation_m(trace_of(off)) == pytest.approx(1.0)


def test_two_that_cross_at_different_times_are_never_close() -> None:
    off = np.zeros((2, 2, 3))
    off[:, 0, 0] = [0.0, 5.0]
    off[:, 1, 0] = [5.0, 0.0]
    assert score.separation_m(trace_of(off)) == pytest.approx(5.0)


def test_one_agent_is_infinitely_apart() -> None:
    assert score.separation_m(late(1.0, (0.0, 0.0, 0.0))) == math.inf


def test_clearance_is_of_the_nearest_agent_to_the_centre_of_the_nearest_obstacle() -> None:
    off = np.zeros((2, 2, 3))
    off[0, 1] = (0.0, 3.0, 0.0)
    spheres = [at_offset((0.0, 3.0, 2.0)), at_offset((100.0, 0.0, 0.0))]
    trace = trace_of(off, spheres)
    assert score.clearance_m(trace) == pytest.approx(2.0)  # centre, whatever radius and keep-out are
    assert score.clearance_m(replace(trace, obstacles=tuple(reversed(spheres)))) == pytest.approx(2.0)
    assert score.clearance_m(replace(trace, obstacles=tuple(spheres[1:]))) == pytest.approx(100.0)


def at_offset(off_ned_m: tuple[float, float, float]) -> Obstacle:
    north, east, down = REFERENCE_NED_M + np.array(off_ned_m)
    return Obstacle(center_ned_m=(float(north), float(east), float(down)))


def test_without_obstacles_clearance_is_infinite() -> None:
    assert score.clearance_m(two_ticks()) == math.inf


@pytest.mark.parametrize(
    ("ours", "limit", "met"), [(1.0, 1.0, True), (1.001, 1.0, False), (5.0, None, None), (math.nan, 1.0, False)]
)
def test_a_limit_is_kept_up_to_equality_and_never_by_no_number(ours: float, limit: float | None, met: bool) -> None:
    assert Row(name="row", published=None, ours=ours, limit=limit, path="plant", unit="m").met is met
