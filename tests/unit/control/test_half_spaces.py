"""Half-spaces keep the distances they stand for, and pass on the side of the right of way."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from swarmctl.control.collision.half_spaces import half_spaces
from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.collision.separation import SeparationParams, certify, keep_out_of_obstacle, keep_out_of_peer
from swarmctl.control.mpc.condensed_qp.axes import HalfSpaces
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array
from tests import builders
from tests.benches.keep_outs import DT_US, PARAMS, STEPS, fixed, line


def spaces_of(
    guess: Array, *keep_outs: KeepOut, priority_id: int = 0, goal: tuple[float, float] = (0.0, 0.0)
) -> HalfSpaces:
    """Return half-spaces of an agent at rest."""
    spaces = half_spaces(
        keep_outs, guess, np.array(goal), np.zeros(2), dt_s=0.1, own_priority_id=priority_id, params=PARAMS
    )
    assert spaces is not None
    return spaces


def still(place: tuple[float, float, float]) -> Array:
    return np.tile(place, (STEPS + 1, 1))


@pytest.mark.parametrize(("north", "east"), list(product((-2.0, 0.0, 2.0), (-1.5, 1.5))))
def test_a_half_space_faces_the_agent_at_the_radius(north: float, east: float) -> None:
    own = np.array([north, east])
    spaces = spaces_of(still((north, east, 0.0)), fixed((0.0, 0.0, 0.0), 0.8), goal=(north, east))
    normal, offset = spaces.normal[0, -1], spaces.offset_m[0, -1]
    np.testing.assert_allclose(normal, own / np.linalg.norm(own), atol=1e-9)
    assert offset == pytest.approx(0.9)
    assert normal @ own > offset  # we are on the allowed side,
    assert normal @ np.zeros(2) < offset  # the other is not


def test_the_offset_moves_with_the_keep_out() -> None:
    spaces = spaces_of(still((10.0, 5.0, 0.0)), fixed((10.0, 3.0, 0.0), 0.8), goal=(10.0, 5.0))
    assert spaces.offset_m[0, 0] == pytest.approx(3.0 + 0.9)  # along east


@pytest.mark.parametrize(
    ("height_m", "needed_m"), [(0.0, 0.9), (0.54, 0.72), (-0.72, 0.54), (0.9, -math.inf), (5.0, -math.inf)]
)
def test_a_height_difference_reduces_the_horizontal_distance(height_m: float, needed_m: float) -> None:
    sphere = fixed((0.0, 0.0, 0.0), 0.8)
    spaces = spaces_of(still((2.0, 0.0, height_m)), sphere, goal=(2.0, 0.0))
    assert spaces.offset_m[0, 3] == pytest.approx(needed_m)
    cylinder = fixed((0.0, 0.0, 0.0), 0.8, any_height=True)
    assert spaces_of(still((2.0, 0.0, height_m)), cylinder, goal=(2.0, 0.0)).offset_m[0, 3] == pytest.approx(0.9)


def squeezed(place: tuple[float, float, float]) -> KeepOut:
    """Return a keep-out with downwash 2 and hard minimum distance 0.8 m."""
    return replace(fixed(place, 0.8), downwash=2.0)


@pytest.mark.parametrize(("height_m", "needed_m"), [(0.0, 0.9), (1.0, math.sqrt(0.81 - 0.25)), (1.8, 0.0)])
def test_downwash_reaches_higher_than_wide(height_m: float, needed_m: float) -> None:
    """The plane, space and the certificate agree."""
    spaces = spaces_of(still((2.0, 0.0, height_m)), squeezed((0.0, 0.0, 0.0)), goal=(2.0, 0.0))
    if needed_m:
        assert spaces.offset_m[0, 3] == pytest.approx(needed_m)
    else:
        assert np.isneginf(spaces.offset_m).all()
    for angle in (0.3, 1.0, 1.4):  # rows touch the ellipsoid (x/0.9)^2 + (z/1.8)^2 = 1 from outside
        where = (1.2 * math.cos(angle), 0.0, -2.4 * math.sin(angle))
        rows = in_space(still(where), squeezed((0.0, 0.0, 0.0)), goal=where)
        normal, offset = rows.normal[0, 5], rows.offset_m[0, 5]
        touches = np.array([0.9 * math.cos(angle), 0.0, -1.8 * math.sin(angle)])
        assert normal @ touches == pytest.approx(offset)
        round_it = np.linspace(0.0, 2.0 * math.pi, 50)
        skin = np.stack([0.9 * np.cos(round_it), 0 * round_it, 1.8 * np.sin(round_it)], axis=1)
        assert (skin @ normal).max() <= offset + 1e-6
    assert certify(still((0.0, 0.0, -1.7)), [squeezed((0.0, 0.0, 0.0))], 0) == pytest.approx(0.05)
    assert certify(still((0.9, 0.0, 0.0)), [squeezed((0.0, 0.0, 0.0))], 0) == pytest.approx(0.1)


def test_downwash_applies_to_peers_and_not_to_obstacles() -> None:
    params = SeparationParams(downwash=2.0)
    path = builders.predicted_path(dt_us=DT_US, pos_ned_m=still((0.0, 0.0, 0.0)))
    assert keep_out_of_peer(path, 0, DT_US, STEPS, params=params).downwash == 2.0
    ball = Obstacle(
        center_ned_m=(0.0, 0.0, 0.0), radius_m=1.0, keep_out_m=1.75, visibility_m=3.0, vel_ned_m_s=(0.0, 0.0, 0.0)
    )
    assert keep_out_of_obstacle(ball, DT_US, STEPS, params).downwash == 1.0


def test_downwash_takes_as_long_to_stop_from_above() -> None:
    for keep_out in (fixed((0.0, 0.0, 0.0), 0.8), squeezed((0.0, 0.0, 0.0))):
        spaces = half_spaces(
            [keep_out],
            still((0.0, 0.0, -3.0)),
            np.array([0.0, 0.0, -3.0]),
            np.array([0.0, 0.0, 2.8]),
            dt_s=0.1,
            own_priority_id=0,
            params=PARAMS,
        )
        assert spaces is not None
        assert spaces.stop_s[0] == pytest.approx(2.8 / (2 * 1.4))


def test_far_keep_outs_get_no_row() -> None:
    assert np.isneginf(spaces_of(still((4.0, 0.0, 0.0)), fixed((0.0, 0.0, 0.0), 0.8)).offset_m).all()
    assert np.isfinite(spaces_of(still((3.8, 0.0, 0.0)), fixed((0.0, 0.0, 0.0), 0.8)).offset_m).all()
    assert (
        half_spaces([], still((4.0, 0.0, 0.0)), np.zeros(2), np.zeros(2), dt_s=0.1, own_priority_id=0, params=PARAMS)
        is None
    )


@pytest.mark.parametrize("axes", [2, 3])
def test_plans_keep_more_from_a_peer_that_comes_closer_and_less_the_less_is_left(axes: int) -> None:
    """From 2.9 m to 1.9 m away: 0.3 of what is beyond 5 cm, at most 0.15 m; nothing where nobody comes closer."""
    closing = line((-2.9, 0.0, -2.0), (-1.9, 0.0, -2.0))
    steady = line((-1.9, 0.0, -2.0), (-1.9, 0.0, -2.0))
    swinging = line((-1.95, 0.0, -2.0), (-1.9, 0.0, -2.0))
    peer_at_origin, obstacle = fixed((0.0, 0.0, -2.0), 0.8), replace(fixed((0.0, 0.0, -2.0), 0.8), priority_id=-1)
    params = PARAMS.model_copy(
        update={"approach_01": 0.3, "approach_max_m": 0.15, "right_of_way_rad": 0.0, "right_of_way_obstacle_rad": 0.0}
    )
    goal = np.zeros(axes)

    def kept_m(guess: Array, keep_out: KeepOut, used: SeparationParams) -> Array:
        spaces = half_spaces([keep_out], guess, goal, np.zeros(axes), dt_s=0.1, own_priority_id=0, params=used)
        assert spaces is not None
        return np.asarray(-spaces.offset_m[0])

    radius_m = peer_at_origin.radius_m
    want_m = radius_m + np.minimum(0.3 * (0.1 * np.arange(1, STEPS + 1) - 0.05), 0.15)
    np.testing.assert_allclose(np.abs(kept_m(closing, peer_at_origin, params)), want_m, atol=1e-9)
    for guess, keep_out, used in (
        (steady, peer_at_origin, params),
        (swinging, peer_at_origin, params),
        (closing, obstacle, params),
        (closing, peer_at_origin, params.model_copy(update={"approach_01": 0.0})),
    ):
        np.testing.assert_allclose(np.abs(kept_m(guess, keep_out, used)), radius_m, atol=1e-9)


def test_coincident_agents_take_opposite_sides_by_their_ids() -> None:
    place = (1.0, 2.0, -2.0)
    other_of_0 = builders.keep_out(pos_ned_m=still(place))
    other_of_1 = builders.keep_out(pos_ned_m=still(place), priority_id=0)
    first = spaces_of(still(place), other_of_0, priority_id=0, goal=(1.0, 2.0))
    second = spaces_of(still(place), other_of_1, priority_id=1, goal=(1.0, 2.0))
    assert np.isfinite(first.normal).all()
    np.testing.assert_allclose(first.normal[0, 0], [-1.0, 0.0])
    np.testing.assert_allclose(second.normal[0, 0], [1.0, 0.0])
    # kept, both constraints put at least twice the radius between them
    assert -first.offset_m[0, 0] + 1.0 + second.offset_m[0, 0] - 1.0 >= 1.8 - 1e-9


def test_stuck_head_on_agents_turn_to_opposite_sides() -> None:
    north_bound, south_bound = still((0.0, 0.0, 0.0)), still((1.0, 0.0, 0.0))
    a = spaces_of(
        north_bound,
        builders.keep_out(pos_ned_m=south_bound),
        priority_id=0,
        goal=(5.0, 0.0),
    )
    b = spaces_of(
        south_bound,
        builders.keep_out(pos_ned_m=north_bound, priority_id=0),
        priority_id=1,
        goal=(-5.0, 0.0),
    )
    # turned by 0.35 rad: (-1, 0) -> (-cos, -sin), (1, 0) -> (cos, sin)
    np.testing.assert_allclose(a.normal[0, 0], [-math.cos(0.35), -math.sin(0.35)], atol=1e-9)
    np.testing.assert_allclose(b.normal[0, 0], [math.cos(0.35), math.sin(0.35)], atol=1e-9)
    moving = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), STEPS + 1)  # makes progress: peers' normals stay
    c = spaces_of(
        moving,
        builders.keep_out(pos_ned_m=still((2.0, 0.0, 0.0))),
        goal=(5.0, 0.0),
    )
    np.testing.assert_allclose(c.normal[0, 0], [-1.0, 0.0], atol=1e-9)
    obstacle = builders.keep_out(
        pos_ned_m=still((2.0, 0.0, 0.0)), priority_id=-1
    )  # obstacles do not evade: always turned
    assert abs(spaces_of(moving, obstacle, goal=(5.0, 0.0)).normal[0, 0, 1]) > 0.3


def test_of_two_stuck_above_each_other_the_lower_one_turns_to_the_north() -> None:
    lower, upper, beside = (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.03, -1.0)

    def first(own: tuple[float, float, float], other: tuple[float, float, float], goal_z_m: float) -> Array:
        peer = builders.keep_out(pos_ned_m=still(other))
        normal: Array = in_space(still(own), peer, goal=(0.0, 0.0, goal_z_m)).normal[0, 0]
        return normal

    c, s = math.cos(0.35), math.sin(0.35)
    np.testing.assert_allclose(first(lower, upper, -5.0), [s, 0.0, c], atol=1e-9)
    np.testing.assert_allclose(first(upper, lower, 4.0), [-s, 0.0, -c], atol=1e-9)
    assert first(lower, upper, 5.0) == pytest.approx([0.0, 0.0, 1.0]), "it flies away"
    assert first(lower, beside, -5.0)[2] > 0.999, "it is not exactly below"


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("east_m", [0.05, -0.05])
def test_obstacles_are_passed_on_the_side_the_agent_is_on(east_m: float, axes: int) -> None:
    moving = np.linspace((0.0, east_m, 0.0), (1.0, east_m, 0.0), STEPS + 1)
    obstacle = builders.keep_out(pos_ned_m=still((2.0, 0.0, 0.0)), priority_id=-1)
    spaces = half_spaces(
        [obstacle], moving, np.array([5.0, 0.0, 0.0][:axes]), np.zeros(axes), dt_s=0.1, own_priority_id=0, params=PARAMS
    )
    assert spaces is not None
    normal = spaces.normal[0]
    assert (np.sign(normal[:, 1]) == np.sign(east_m)).all()
    assert (np.abs(normal[:, 1]) > 0.2).all()  # more than the 0.05 / 2 without the turn


def test_the_stopping_row_adds_the_braking_distance_only_when_closing() -> None:
    guess = still((-3.0, 0.0, 0.0))
    wall = [fixed((0.0, 0.0, 0.0), 0.8)]
    params = PARAMS.model_copy(update={"right_of_way_rad": 0.0, "right_of_way_obstacle_rad": 0.0})
    closing = half_spaces(
        wall, guess, np.array([5.0, 0.0]), np.array([2.8, 0.0]), dt_s=0.1, own_priority_id=0, params=params
    )
    assert closing is not None
    # v / (2 a): p + v * v / (2 a) is where braking with a = 1.4 from 2.8 m/s ends
    assert closing.stop_s[0] == pytest.approx(2.8 / (2 * 1.4))
    assert closing.stop_offset_m[0] == pytest.approx(0.9)
    opening = half_spaces(
        wall, guess, np.array([5.0, 0.0]), np.array([-2.8, 0.0]), dt_s=0.1, own_priority_id=0, params=params
    )
    assert opening is not None
    assert opening.stop_s[0] == 0.0


def test_the_stopping_row_includes_the_motion_of_the_peer() -> None:
    other = builders.keep_out(pos_ned_m=line((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)))  # 1 m/s south
    params = PARAMS.model_copy(update={"right_of_way_rad": 0.0, "right_of_way_obstacle_rad": 0.0})
    spaces = half_spaces(
        [other],
        still((-3.0, 0.0, 0.0)),
        np.array([5.0, 0.0]),
        np.array([1.8, 0.0]),
        dt_s=0.1,
        own_priority_id=0,
        params=params,
    )
    assert spaces is not None
    assert spaces.stop_s[0] == pytest.approx(2.8 / 2.8)  # closing speed 1.8 + 1.0
    # normal is south (-1, 0): other at its end -1 - 1 s * 1 m/s = -2 -> offset 2 + 0.9
    assert spaces.stop_offset_m[0] == pytest.approx(2.9)


def stopping(guess: Array, others: Array) -> HalfSpaces:
    """Return half-spaces of an agent at rest against a peer that moves."""
    params = PARAMS.model_copy(update={"right_of_way_rad": 0.0})
    peer = builders.keep_out(pos_ned_m=others)
    spaces = half_spaces([peer], guess, np.zeros(2), np.zeros(2), dt_s=0.1, own_priority_id=0, params=params)
    assert spaces is not None
    return spaces


def test_the_stopping_row_counts_what_the_peer_does_at_the_end_of_the_horizon() -> None:
    """It turns away on its way: it comes at 1 m/s, and flies east past the agent then."""
    turning = np.vstack([line((6.0, 0.0, 0.0), (5.5, 0.0, 0.0), 5), line((5.5, 0.3, 0.0), (5.5, 1.5, 0.0), 4)])
    spaces = stopping(still((3.0, 1.5, 0.0)), turning)
    np.testing.assert_allclose(spaces.normal[0, -1], [-1.0, 0.0])
    assert spaces.stop_s[0] == pytest.approx(0.0), "it comes no closer any more"
    assert spaces.stop_offset_m[0] == pytest.approx(-5.5 + 0.9)
    back = stopping(still((3.0, 1.5, 0.0)), turning[::-1])
    assert back.stop_offset_m[0] == pytest.approx(back.offset_m[0, -1]), "it leaves at the end"


def test_a_keep_out_that_is_far_at_the_end_bounds_no_stop() -> None:
    leaving, coming = line((2.0, 0.0, 0.0), (6.0, 0.0, 0.0)), line((6.0, 0.0, 0.0), (2.0, 0.0, 0.0))
    spaces = stopping(still((0.0, 0.0, 0.0)), leaving)
    assert np.isfinite(spaces.offset_m[0, 0]) and np.isneginf(spaces.stop_offset_m[0])
    spaces = stopping(still((0.0, 0.0, 0.0)), coming)
    assert np.isneginf(spaces.offset_m[0, 0]) and np.isfinite(spaces.stop_offset_m[0])


# -- half-spaces in space ---------------------------------------------------------------------------------------------


def in_space(
    guess: Array, *keep_outs: KeepOut, priority_id: int = 0, goal: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> HalfSpaces:
    """Return half-spaces of an agent at rest."""
    spaces = half_spaces(
        keep_outs, guess, np.array(goal), np.zeros(3), dt_s=0.1, own_priority_id=priority_id, params=PARAMS
    )
    assert spaces is not None
    return spaces


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("seed", range(20))
def test_positions_within_a_half_space_are_at_least_the_radius_away(seed: int, axes: int) -> None:
    rng = np.random.default_rng([seed, 0, 11])
    guess = np.cumsum(rng.normal(0.0, 0.2, (STEPS + 1, 3)), axis=0)
    goal = rng.normal(0.0, 4.0, 3)
    keep_outs = [
        builders.keep_out(
            pos_ned_m=rng.normal(0.0, 1.0, 3) + np.cumsum(rng.normal(0.0, 0.1, (STEPS + 1, 3)), axis=0),
            radius_m=float(rng.uniform(0.3, 2.0)),
            hard_min_distance_m=0.1,
            any_height=bool(k % 2),
            priority_id=int(rng.integers(-1, 3)),
        )
        for k in range(6)
    ]
    spaces = half_spaces(
        keep_outs, guess, goal[:axes], rng.normal(0.0, 1.0, axes), dt_s=0.1, own_priority_id=1, params=PARAMS
    )
    assert spaces is not None
    assert spaces.normal.shape == (6, STEPS, axes)
    np.testing.assert_allclose(np.linalg.norm(spaces.normal, axis=2), 1.0, atol=1e-12)
    assert np.isfinite(spaces.offset_m).any()
    for s, keep_out in enumerate(keep_outs):
        if keep_out.any_height and axes == 3:
            np.testing.assert_array_equal(spaces.normal[s, :, 2], 0.0)
        for k in np.flatnonzero(np.isfinite(spaces.offset_m[s])):
            points = keep_out.pos_ned_m[k + 1] + rng.uniform(-4.0, 4.0, (300, 3))
            if axes == 2:
                points[:, 2] = guess[k + 1, 2]  # the plane it is told for
            # onto the face of the half-space where they are nearest, and a random way in
            normal = spaces.normal[s, k]
            shift = spaces.offset_m[s, k] - points[:, :axes] @ normal + np.abs(rng.normal(0.0, 0.05, 300))
            points[:, :axes] += shift[:, None] * normal
            apart = points - keep_out.pos_ned_m[k + 1]
            if keep_out.any_height:
                apart[:, 2] = 0.0
            assert np.linalg.norm(apart, axis=1).min() >= keep_out.radius_m - 1e-9


def test_in_space_an_agent_above_is_kept_above() -> None:
    spaces = in_space(still((0.0, 0.0, -2.0)), fixed((0.0, 0.0, -1.0), 0.8), goal=(0.0, 0.0, -2.0))
    np.testing.assert_allclose(spaces.normal[0], np.tile([0.0, 0.0, -1.0], (STEPS, 1)))
    np.testing.assert_allclose(spaces.offset_m[0], 1.0 + 0.9)  # -z >= 1.9: at most 1.9 m below the origin's height
    oblique = in_space(still((1.2, 0.0, -1.6)), fixed((0.0, 0.0, 0.0), 0.8), goal=(1.2, 0.0, -1.6))
    np.testing.assert_allclose(oblique.normal[0, 0], [0.6, 0.0, -0.8])
    assert oblique.offset_m[0, 0] == pytest.approx(0.9)  # all of it: height is no relief but a direction


def test_in_space_a_cylinder_is_avoided_sideways_only() -> None:
    cylinder = fixed((0.0, 0.0, 0.0), 0.8, any_height=True)
    spaces = in_space(still((1.2, 0.0, -1.6)), cylinder, goal=(1.2, 0.0, -1.6))
    np.testing.assert_allclose(spaces.normal[0], np.tile([1.0, 0.0, 0.0], (STEPS, 1)))
    np.testing.assert_allclose(spaces.offset_m[0], 0.9)


@pytest.mark.parametrize("any_height", [False, True])
@pytest.mark.parametrize("above_m", [0.0, 5.0])
def test_in_space_coincident_centres_have_a_side(above_m: float, any_height: bool) -> None:
    place = (1.0, 2.0, -2.0)
    over = still((1.0, 2.0, -2.0 - (above_m if any_height else 0.0)))  # straight above a cylinder is inside it too
    for priority_id, north in ((0, -1.0), (1, 1.0)):
        other = builders.keep_out(pos_ned_m=still(place), any_height=any_height, priority_id=1 - priority_id)
        spaces = in_space(over, other, priority_id=priority_id, goal=(1.0, 2.0, -2.0))
        np.testing.assert_allclose(spaces.normal[0], np.tile([north, 0.0, 0.0], (STEPS, 1)))
        np.testing.assert_allclose(spaces.offset_m[0], north * 1.0 + 0.9)
        assert np.isfinite(spaces.stop_offset_m).all()
        assert np.isfinite(spaces.stop_s).all()


def test_in_space_the_stopping_row_includes_vertical_speed() -> None:
    sinking = half_spaces(
        [fixed((0.0, 0.0, 0.0), 0.8)],
        still((0.0, 0.0, -3.0)),
        np.zeros(3),
        np.array([0.0, 0.0, 2.8]),
        dt_s=0.1,
        own_priority_id=0,
        params=PARAMS,
    )
    assert sinking is not None
    assert sinking.stop_s[0] == pytest.approx(2.8 / (2 * 1.4))
    assert sinking.stop_offset_m[0] == pytest.approx(0.9)
    rising_other = builders.keep_out(pos_ned_m=line((0.0, 0.0, 0.0), (0.0, 0.0, -1.0)))  # 1 m/s up
    spaces = in_space(still((0.0, 0.0, -3.0)), rising_other, goal=(0.0, 0.0, -3.0))
    assert spaces.stop_s[0] == pytest.approx(1.0 / 2.8)
    assert spaces.stop_offset_m[0] == pytest.approx(1.0 + 0.9 + 1.0 / 2.8)  # -z: where it is then, and the radius


def test_in_space_a_climb_counts_as_progress() -> None:
    peer_ahead = builders.keep_out(pos_ned_m=np.linspace((1.5, 0.0, -0.2), (1.5, 0.0, -2.2), STEPS + 1))
    climbing = np.linspace((0.0, 0.0, 0.0), (0.05, 0.0, -2.0), STEPS + 1)  # 2 m, of which 5 cm are not up
    turned = in_space(climbing, peer_ahead, goal=(9.0, 0.0, -2.0)).normal[0, :, 1]
    np.testing.assert_allclose(turned, 0.0, atol=1e-9)
