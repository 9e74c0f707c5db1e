"""Tests of the reference of who is away from it."""

from __future__ import annotations

import numpy as np

from swarmctl.control.reference.approach import approached

AHEAD_S = np.array([0.1, 0.5, 1.0])
OWN_NED_M = np.array([1.0, 2.0, -3.0])


def test_what_is_within_reach_is_left_as_it_is() -> None:
    pos, vel = OWN_NED_M + np.outer(AHEAD_S, [0.0, 2.0, 0.0]), np.tile([0.0, 2.0, 0.0], (3, 1))
    for found, given in zip(approached(pos, vel, AHEAD_S, OWN_NED_M, speed_max_m_s=2.1), (pos, vel), strict=True):
        assert np.array_equal(found, given)


def test_what_is_farther_is_replaced_by_as_far_as_the_speed_leads_to_it() -> None:
    direction = np.array([0.6, 0.0, -0.8])
    pos = OWN_NED_M + np.outer([30.0, 30.0, 1.5], direction)
    given = pos.copy(), np.full((3, 3), 0.25)
    found_m, found_m_s = approached(*given, AHEAD_S, OWN_NED_M, speed_max_m_s=2.0)
    assert np.allclose(found_m, OWN_NED_M + np.outer([0.2, 1.0, 1.5], direction))
    assert np.allclose(found_m_s, np.stack([2.0 * direction, 2.0 * direction, np.full(3, 0.25)]))
    assert np.array_equal(given[0], pos), "the reference itself is not changed"


def test_now_is_where_the_vehicle_is() -> None:
    found_m, found_m_s = approached(OWN_NED_M[None] + 1.0, np.zeros((1, 3)), np.zeros(1), OWN_NED_M, speed_max_m_s=2.0)
    assert np.array_equal(found_m[0], OWN_NED_M)
    assert np.isfinite(found_m_s).all()
