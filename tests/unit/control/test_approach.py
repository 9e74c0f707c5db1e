"""Tests of the reference of who is far away from it."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.reference.approach import approached
from swarmctl.core.types import Array

AHEAD_S = np.array([0.1, 0.5, 1.0])
OWN_NED_M = np.array([1.0, 2.0, -3.0])
DIRECTION = np.array([0.6, 0.0, -0.8])


def away(*distances_m: float) -> Array:
    return OWN_NED_M + np.outer(distances_m, DIRECTION)


@pytest.mark.parametrize("distances_m", [(1.5, 1.5, 1.5), (0.2, 1.0, 2.0)])
def test_what_is_near_or_within_reach_is_left_as_it_is(distances_m: tuple[float, ...]) -> None:
    pos, vel = away(*distances_m), np.full((3, 3), 0.25)
    for found, given in zip(approached(pos, vel, AHEAD_S, OWN_NED_M, speed_max_m_s=2.0), (pos, vel), strict=True):
        assert np.array_equal(found, given)


def test_what_is_far_is_replaced_by_as_far_as_the_speed_leads_to_it() -> None:
    pos, vel = away(30.0, 30.0, 1.5), np.full((3, 3), 0.25)
    found_m, found_m_s = approached(pos, vel, AHEAD_S, OWN_NED_M, speed_max_m_s=2.0)
    assert np.allclose(found_m, away(0.2, 1.0, 1.5))
    assert np.allclose(found_m_s, np.stack([2.0 * DIRECTION, 2.0 * DIRECTION, np.full(3, 0.25)]))
    assert np.array_equal(pos, away(30.0, 30.0, 1.5)), "the reference itself is not changed"


def test_now_is_where_the_vehicle_is() -> None:
    found_m, found_m_s = approached(away(30.0), np.zeros((1, 3)), np.zeros(1), OWN_NED_M, speed_max_m_s=2.0)
    assert np.array_equal(found_m[0], OWN_NED_M)
    assert np.isfinite(found_m_s).all()
