"""When, and how far, half-spaces are turned: who is stuck gives way, and obstacles that lie ahead are passed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmctl.control.collision.half_spaces import half_spaces
from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.core.types import Array
from tests import builders
from tests.benches.keep_outs import PARAMS, STEPS, line


def turns_rad(guess: Array, *keep_outs: KeepOut, goal_north_m: float) -> list[Array]:
    """Return by how much the normals (Hp,) of keep-outs north of the vehicle are turned clockwise, at rest."""
    spaces = half_spaces(
        keep_outs,
        guess,
        np.array([goal_north_m, 0.0]),
        np.zeros(2),
        dt_s=0.1,
        own_priority_id=0,
        params=PARAMS,
    )
    assert spaces is not None
    return [np.arctan2(-normal[:, 1], -normal[:, 0]) for normal in spaces.normal]


def flown(north_m: float) -> Array:
    """Return a plan that flies so far over its horizon."""
    return line((0.0, 0.0, 0.0), (north_m, 0.0, 0.0))


def still(north_m: float, *, obstacle: bool = False) -> KeepOut:
    place = np.tile((north_m, 0.0, 0.0), (STEPS + 1, 1))
    return builders.keep_out(pos_ned_m=place, priority_id=-1 if obstacle else 1)


@pytest.mark.parametrize(
    ("moved_m", "share_01"), [(0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (1.25, 0.75), (1.5, 0.5), (2.0, 0.0), (3.0, 0.0)]
)
def test_the_less_a_plan_is_stuck_the_less_it_gives_way(moved_m: float, share_01: float) -> None:
    """Fully where it moves no more than `stuck_m` over its horizon, and no more from twice that on."""
    (turned,) = turns_rad(flown(moved_m * PARAMS.stuck_m), still(1.5), goal_north_m=8.0)
    np.testing.assert_allclose(turned, PARAMS.right_of_way_rad * share_01, atol=1e-9)


def test_beside_an_obstacle_only_that_is_given_way_to_by_a_plan_that_moves_on() -> None:
    ahead, passed = turns_rad(flown(0.5), still(1.9), still(1.9, obstacle=True), goal_north_m=8.0)
    np.testing.assert_allclose(ahead, 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(passed), PARAMS.right_of_way_obstacle_rad, atol=1e-9)


def test_an_obstacle_is_passed_where_it_is_near_and_more_than_its_distance_is_left_to_fly() -> None:
    """Nearer than 2.3 m, twice 0.9 m and a half; and the goal farther than 0.675 m, three quarters of 0.9 m."""
    plan = flown(1.0)
    (turned,) = turns_rad(plan, still(2.55, obstacle=True), goal_north_m=1.6)
    north_m = plan[1:, 0]
    passed = (2.55 - north_m < 2.3) & (1.6 - north_m > 0.675)
    assert passed.tolist() == [False] * 2 + [True] * 7 + [False]
    np.testing.assert_allclose(np.abs(turned), PARAMS.right_of_way_obstacle_rad * passed, atol=1e-9)


@pytest.mark.parametrize("east_m", [-0.02, 0.02])
def test_an_obstacle_that_comes_at_an_agent_at_its_goal_is_passed_and_not_fled_from(east_m: float) -> None:
    """What is left to fly is counted from the obstacle, as if it stood."""

    def turned_rad(coming_m: float) -> Array:
        away = line((3.0, -east_m, 0.0), (3.0 - coming_m, -east_m, 0.0))
        (found,) = turns_rad(flown(0.0), builders.keep_out(pos_ned_m=away, priority_id=-1), goal_north_m=0.0)
        return found

    to_its_side = -math.copysign(PARAMS.right_of_way_obstacle_rad, east_m)
    assert turned_rad(1.8)[-1] == pytest.approx(to_its_side, abs=0.03), "to the side that the agent is on"
    assert turned_rad(0.0)[-1] == pytest.approx(0.0, abs=0.03), "one that stands"
    assert turned_rad(-1.8)[-1] == pytest.approx(0.0, abs=0.03), "one that leaves"
