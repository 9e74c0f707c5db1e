"""Tests of the reference of who is far away from it."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.mpc_params import AxisWeights, MpcParams
from swarmctl.control.reference.approach import Approach
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array

AHEAD_S = np.array([0.1, 0.5, 1.0])
OWN_NED_M = np.array([1.0, 2.0, -3.0])
UP, DOWN, NORTH = np.array([0.6, 0.0, -0.8]), np.array([0.6, 0.0, 0.8]), np.array([1.0, 0.0, 0.0])
AT_REST = np.zeros(3)


def found(
    pos_ned_m: Array,
    vel_ned_m_s: Array,
    ahead_s: Array = AHEAD_S,
    *,
    own_ned_m_s: Array = AT_REST,
    plans: bool = True,
    speed_max_m_s: float = 2.0,
    thrust_max_01: float = 1.0,
) -> tuple[Array, Array]:
    vehicle = VehicleModelParams(speed_max_m_s=speed_max_m_s, thrust_max_01=thrust_max_01)
    approach = Approach(MpcParams(), vehicle, plans=plans)
    return approach.reference(pos_ned_m, vel_ned_m_s, ahead_s, own_ned_m=OWN_NED_M, own_ned_m_s=own_ned_m_s)


def away(*distances_m: float, along: Array = UP) -> Array:
    there: Array = OWN_NED_M + np.outer(distances_m, along)
    return there


@pytest.mark.parametrize("distances_m", [(1.5, 1.5, 1.5), (0.2, 1.0, 2.0)])
def test_what_is_near_or_within_reach_is_left_as_it_is(distances_m: tuple[float, ...]) -> None:
    pos, vel = away(*distances_m), np.full((3, 3), 0.25)
    for kept, given in zip(found(pos, vel), (pos, vel), strict=True):
        assert np.array_equal(kept, given)


def test_what_is_far_is_replaced_by_as_far_as_the_speed_leads_to_it() -> None:
    pos, vel = away(30.0, 30.0, 1.5), np.full((3, 3), 0.25)
    found_m, found_m_s = found(pos, vel)
    assert np.allclose(found_m, away(0.2, 1.0, 1.5))
    assert np.allclose(found_m_s, np.stack([2.0 * UP, 2.0 * UP, np.full(3, 0.25)]))
    assert np.array_equal(pos, away(30.0, 30.0, 1.5)), "the reference itself is not changed"


def test_now_is_where_the_vehicle_is() -> None:
    found_m, found_m_s = found(away(30.0), np.zeros((1, 3)), np.zeros(1))
    assert np.array_equal(found_m[0], OWN_NED_M)
    assert np.isfinite(found_m_s).all()


# -- downwards --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("thrust_01", "sink_m_s"), [(0.6, 0.2 * 0.8 * GRAVITY_M_S2), (0.5, 0.3), (0.4, 0.3)])
def test_what_is_far_below_is_approached_as_thrust_stops_in_half_of_the_way(thrust_01: float, sink_m_s: float) -> None:
    found_m, found_m_s = found(
        away(30.0, 30.0, 30.0, along=DOWN), np.zeros((3, 3)), plans=False, thrust_max_01=thrust_01
    )
    assert found_m_s == pytest.approx(np.tile(sink_m_s / 0.8 * DOWN, (3, 1)))
    assert found_m - OWN_NED_M == pytest.approx(AHEAD_S[:, None] * found_m_s)


def test_what_is_far_above_is_flown_to_at_the_largest_speed() -> None:
    assert np.allclose(found(away(30.0, 30.0, 30.0), np.zeros((3, 3)), thrust_max_01=0.6)[1], 2.0 * UP)


# -- braking ----------------------------------------------------------------------------------------------------------

FAST_M_S = 9.0
STANDS = away(20.0, 20.0, 20.0, along=NORTH), np.zeros((3, 3))


def braked(pos: Array, vel: Array, own_m_s: float = FAST_M_S, *, plans: bool = True) -> tuple[Array, Array]:
    return found(pos, vel, own_ned_m_s=own_m_s * NORTH, plans=plans, speed_max_m_s=50.0)


def test_who_comes_so_fast_that_it_could_hardly_stop_is_told_to_brake() -> None:
    """From 4.8 m/s at 6.8 m, where plans brake by themselves, back by 1.7 m/s2."""
    pos, vel = braked(*STANDS)
    speed_m_s = np.sqrt(4.8**2 + 2 * 1.7 * (20.0 - 4.8**2 / 3.4))
    assert vel[:, 0] == pytest.approx(speed_m_s - 1.7 * AHEAD_S, abs=0.02)
    assert pos[:, 0] - OWN_NED_M[0] == pytest.approx(speed_m_s * AHEAD_S - 0.85 * AHEAD_S**2, abs=0.02)
    assert not vel[:, 1:].any() and (pos[:, 1:] == OWN_NED_M[1:]).all()


def test_who_is_slow_enough_is_not() -> None:
    assert np.array_equal(braked(*STANDS, own_m_s=7.0)[0], STANDS[0])


def test_who_follows_at_the_speed_of_its_reference_is_not() -> None:
    moving = STANDS[0], np.tile(FAST_M_S * NORTH, (3, 1))
    assert np.array_equal(braked(*moving)[0], moving[0])


@pytest.mark.parametrize(("along", "speed_max_m_s", "thrust_max_01"), [(NORTH, 9.5, 1.0), (DOWN, 50.0, 0.8)])
def test_who_brakes_is_told_no_more_than_a_vehicle_may_fly_and_sink(
    along: Array, speed_max_m_s: float, thrust_max_01: float
) -> None:
    pos, vel = away(20.0, 20.0, 20.0, along=along), np.tile(4.0 * along, (3, 1))
    told_m_s = found(pos, vel, own_ned_m_s=15.0 * along, speed_max_m_s=speed_max_m_s, thrust_max_01=thrust_max_01)[1]
    assert np.linalg.norm(told_m_s, axis=1).max() <= speed_max_m_s
    assert told_m_s[:, 2].max() <= (2.0 * thrust_max_01 - 1.0) * 0.8 * GRAVITY_M_S2
    assert (told_m_s @ along).min() > 3.999, "and no slower than its reference"


def test_what_brakes_by_the_distance_that_is_left_is_told_that() -> None:
    """A PID that followed speeds instead flew 30 m past its goal."""
    assert np.array_equal(braked(*STANDS, plans=False)[0], STANDS[0])


@pytest.mark.parametrize(("q_vel", "brakes"), [(0.5, False), (0.05, True), (0.0, True)])
def test_who_weighs_speed_little_is_told_to_brake_sooner(q_vel: float, brakes: bool) -> None:
    weights = AxisWeights(q_pos=1.5, q_vel=q_vel, r=0.01)
    approach = Approach(MpcParams(x=weights, y=weights), VehicleModelParams(), plans=True)
    pos, vel = away(4.0, 4.0, 4.0, along=NORTH), np.zeros((3, 3))
    found_m, _ = approach.reference(pos, vel, AHEAD_S, own_ned_m=OWN_NED_M, own_ned_m_s=4.0 * NORTH)
    assert np.array_equal(found_m, pos) is not brakes
