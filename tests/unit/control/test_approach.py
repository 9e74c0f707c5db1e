"""Tests of the reference of who is far away from it."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.reference.approach import approached, sink_max_m_s
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array

AHEAD_S = np.array([0.1, 0.5, 1.0])
OWN_NED_M = np.array([1.0, 2.0, -3.0])
DIRECTION = np.array([0.6, 0.0, -0.8])


DOWN = np.array([0.6, 0.0, 0.8])


def found(
    pos_ned_m: Array, vel_ned_m_s: Array, ahead_s: Array = AHEAD_S, sink_m_s: float = 50.0
) -> tuple[Array, Array]:
    return approached(pos_ned_m, vel_ned_m_s, ahead_s, OWN_NED_M, speed_max_m_s=2.0, sink_max_m_s=sink_m_s)


def away(*distances_m: float) -> Array:
    return OWN_NED_M + np.outer(distances_m, DIRECTION)


@pytest.mark.parametrize("distances_m", [(1.5, 1.5, 1.5), (0.2, 1.0, 2.0)])
def test_what_is_near_or_within_reach_is_left_as_it_is(distances_m: tuple[float, ...]) -> None:
    pos, vel = away(*distances_m), np.full((3, 3), 0.25)
    for kept, given in zip(found(pos, vel), (pos, vel), strict=True):
        assert np.array_equal(kept, given)


def test_what_is_far_is_replaced_by_as_far_as_the_speed_leads_to_it() -> None:
    pos, vel = away(30.0, 30.0, 1.5), np.full((3, 3), 0.25)
    found_m, found_m_s = found(pos, vel)
    assert np.allclose(found_m, away(0.2, 1.0, 1.5))
    assert np.allclose(found_m_s, np.stack([2.0 * DIRECTION, 2.0 * DIRECTION, np.full(3, 0.25)]))
    assert np.array_equal(pos, away(30.0, 30.0, 1.5)), "the reference itself is not changed"


def test_now_is_where_the_vehicle_is() -> None:
    found_m, found_m_s = found(away(30.0), np.zeros((1, 3)), np.zeros(1))
    assert np.array_equal(found_m[0], OWN_NED_M)
    assert np.isfinite(found_m_s).all()


def test_what_is_far_below_is_replaced_by_as_far_as_sinking_leads_to_it() -> None:
    pos = OWN_NED_M + np.outer([30.0, 30.0, 30.0], DOWN)
    found_m, found_m_s = found(pos, np.zeros((3, 3)), sink_m_s=0.8)
    assert np.allclose(found_m - OWN_NED_M, np.outer(AHEAD_S, DOWN))
    assert np.allclose(found_m_s, DOWN)


def test_what_is_far_above_is_flown_to_at_the_largest_speed() -> None:
    assert np.allclose(found(away(30.0, 30.0, 30.0), np.zeros((3, 3)), sink_m_s=0.8)[1], 2.0 * DIRECTION)


@pytest.mark.parametrize("excess_m_s2", [9.8, 4.9, 2.45])
def test_half_of_the_way_on_which_it_stops_is_left_for_what_is_late(excess_m_s2: float) -> None:
    sink_m_s = sink_max_m_s(GRAVITY_M_S2 + excess_m_s2)
    assert sink_m_s**2 / (2 * excess_m_s2) == pytest.approx(0.5 * 0.8 * sink_m_s)


def test_a_vehicle_with_hardly_any_thrust_left_sinks_slowly() -> None:
    assert sink_max_m_s(GRAVITY_M_S2 + 0.05) == sink_max_m_s(GRAVITY_M_S2 - 1.0) == 0.3
