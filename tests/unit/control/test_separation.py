"""Time alignment, growth with age, half-spaces and the certificate agree with numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.half_spaces import half_spaces
from swarmctl.control.collision.separation import (
    KeepOut,
    SeparationParams,
    align,
    certify,
    keep_out_of_obstacle,
    keep_out_of_peer,
    radius_problem,
    visible,
)
from swarmctl.control.mpc.axes import HalfSpaces
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, PredictedPath
from tests import builders

UTC_US = 1_700_000_000_000_000
DT_US = 100_000
STEPS = 10
PARAMS = SeparationParams(
    stop_m_s2=1.4
)  # radius 0.9, slack 0.1, 4 m/s2 of age, at most 1 m, brake 3 m/s2, lost after 0.5 s


def peer(points: Array, dt_us: int = DT_US, radius_m: float = 0.0, agent: int = 1) -> PredictedPath:
    return builders.predicted_path(agent=agent, t0_utc_us=UTC_US, dt_us=dt_us, margin_m=radius_m, pos_ned_m=points)


def straight(speed_m_s: float, points: int = 6, dt_us: int = DT_US) -> PredictedPath:
    """Return points along north from the origin."""
    north = np.arange(points) * speed_m_s * dt_us * 1e-6
    return peer(np.stack([north, np.zeros(points), np.full(points, -2.0)], axis=1), dt_us)


def test_alignment_interpolates_between_points() -> None:
    curve = peer(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, -1.0], [3.0, 2.0, -1.0], [3.0, 6.0, -1.0]]))
    aligned = align(curve, UTC_US + 25_000, 50_000, 3, brake_m_s2=3.0)
    np.testing.assert_allclose(aligned, [[0.25, 0.0, -0.25], [0.75, 0.0, -0.75], [1.5, 0.5, -1.0], [2.5, 1.5, -1.0]])


def test_alignment_before_the_first_point_goes_back_along_the_first_segment() -> None:
    aligned = align(straight(2.0), UTC_US - 150_000, DT_US, 2, brake_m_s2=3.0)
    np.testing.assert_allclose(aligned[:, 0], [-0.3, -0.1, 0.1], atol=1e-12)


def test_beyond_its_end_a_peer_brakes_to_a_stop() -> None:
    # 3 m/s at the end (x = 1.5 at 0.5 s), brake 3 m/s2: stops 1 s later 1.5 m on
    aligned = align(straight(3.0), UTC_US + 500_000, 250_000, 6, brake_m_s2=3.0)
    # 3 t - 1.5 t^2 at 0, .25, .5, .75, 1 s: 0, .65625, 1.125, 1.40625, 1.5, then at rest
    np.testing.assert_allclose(aligned[:, 0], [1.5, 2.15625, 2.625, 2.90625, 3.0, 3.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(aligned[:, 2], -2.0)


def test_a_path_one_hour_old_has_stopped() -> None:
    aligned = align(straight(3.0), UTC_US + 3_600_000_000, DT_US, 2, brake_m_s2=3.0)
    np.testing.assert_allclose(aligned[:, 0], 3.0)


def test_a_path_at_rest_is_not_extrapolated() -> None:
    aligned = align(straight(0.0), UTC_US + 10_000_000, DT_US, 2, brake_m_s2=3.0)
    np.testing.assert_allclose(aligned, np.tile([0.0, 0.0, -2.0], (3, 1)))


@pytest.mark.parametrize(
    ("age_s", "margin_m", "any_height"),
    [(-0.1, 0.0, False), (0.0, 0.0, False), (0.1, 0.02, False), (0.5, 0.5, False), (0.6, 0.72, True), (9.0, 1.0, True)],
)
def test_keep_out_grows_with_age_to_its_cap_and_a_lost_peer_is_a_cylinder(
    age_s: float, margin_m: float, any_height: bool
) -> None:
    at_us = UTC_US + round(age_s * 1e6)
    path = peer(np.zeros((3, 3)), radius_m=0.25, agent=4)
    keep_out = keep_out_of_peer(path, at_us, DT_US, STEPS, params=PARAMS)
    assert keep_out.radius_m == pytest.approx(0.9 + 0.25 + margin_m)
    assert keep_out.hard_min_distance_m == pytest.approx(0.9 + 0.25 - 0.1)
    assert (keep_out.any_height, keep_out.priority_id) == (any_height, 4)


def test_the_keep_out_of_a_landed_peer_does_not_grow() -> None:
    keep_out = keep_out_of_peer(peer(np.zeros((3, 3))), UTC_US + 600_000_000, DT_US, STEPS, params=PARAMS, parked=True)
    assert keep_out.radius_m == pytest.approx(0.9)
    assert not keep_out.any_height


def test_a_moving_obstacle_has_constant_velocity_and_limited_visibility() -> None:
    obstacle = Obstacle(
        center_ned_m=(5.0, 0.0, -2.0),
        radius_m=1.0,
        keep_out_m=1.75,
        visibility_m=3.0,
        vel_ned_m_s=(-1.0, 0.5, 0.0),
    )
    keep_out = keep_out_of_obstacle(obstacle, 200_000, 2, PARAMS)
    np.testing.assert_allclose(keep_out.pos_ned_m, [[5.0, 0.0, -2.0], [4.8, 0.1, -2.0], [4.6, 0.2, -2.0]])
    assert [keep_out.radius_m, keep_out.hard_min_distance_m] == pytest.approx([1.75, 1.65])
    assert visible([obstacle], np.array([2.001, 0.0, -2.0])) == [obstacle]
    assert visible([obstacle], np.array([2.0, 0.0, -2.0])) == []
    assert visible([obstacle], np.array([5.0, 0.0, 1.0])) == []  # height counts


# -- certificate ------------------------------------------------------------------------------------------------------


def fixed(place: tuple[float, float, float], allowed_m: float, any_height: bool = False, steps: int = STEPS) -> KeepOut:
    return builders.keep_out(
        pos_ned_m=np.tile(place, (steps + 1, 1)),
        radius_m=allowed_m + 0.1,
        hard_min_distance_m=allowed_m,
        any_height=any_height,
    )


def line(start: tuple[float, float, float], end: tuple[float, float, float], steps: int = STEPS) -> Array:
    return np.linspace(start, end, steps + 1)


def test_margin_is_true_distance_minus_hard_minimum_distance() -> None:
    path = line((-5.0, 2.0, 0.0), (5.0, 2.0, 0.0))
    assert certify(path, [fixed((0.0, 0.0, 0.0), 0.8)], 0) == pytest.approx(1.2)
    assert certify(path, [fixed((0.0, 0.0, 0.0), 0.8), fixed((0.0, 1.5, 0.0), 0.8)], 0) == pytest.approx(-0.3)
    assert certify(path, [], 0) == math.inf


def test_a_column_is_seen_and_kept_clear_of_at_every_height() -> None:
    column = Obstacle(
        center_ned_m=(5.0, 0.0, -2.0),
        radius_m=1.0,
        keep_out_m=1.75,
        visibility_m=3.0,
        vel_ned_m_s=(0.0, 0.0, 0.0),
        column=True,
    )
    assert visible([column], np.array([2.001, 0.0, 30.0])) == [column]
    keep_out = keep_out_of_obstacle(column, DT_US, STEPS, PARAMS)
    assert keep_out.any_height
    assert keep_out.distance_m(np.array([2.0, 0.0, 30.0])) == pytest.approx(3.0)
    high_above = np.linspace([3.0, 0.0, -20.0], [4.0, 0.0, -20.0], STEPS + 1)
    assert certify(high_above, [keep_out], 0) == pytest.approx(1.0 - 1.65)
    sphere = keep_out_of_obstacle(column.model_copy(update={"column": False}), DT_US, STEPS, PARAMS)
    assert certify(high_above, [sphere], 0) > 10.0


def test_a_path_that_jumps_over_an_obstacle_between_two_samples_is_caught() -> None:
    path = line((-5.5, 0.0, 0.0), (4.5, 0.0, 0.0))  # samples 1 m apart, nearest ones 0.5 m from the centre
    assert certify(path, [fixed((0.0, 0.0, 0.0), 0.4)], 0) == pytest.approx(-0.4)


def test_a_swap_of_places_between_two_samples_is_caught() -> None:
    other = builders.keep_out(pos_ned_m=line((10.0, 0.0, 0.0), (0.0, 0.0, 0.0), 5))
    own = line((0.0, 0.0, 0.0), (10.0, 0.0, 0.0), 5)  # at no sample nearer than 2 m
    assert certify(own, [other], 0) == pytest.approx(-0.8)


def test_height_separates_from_a_sphere_but_not_from_a_cylinder() -> None:
    path = line((-5.0, 0.0, -3.0), (5.0, 0.0, -3.0))
    assert certify(path, [fixed((0.0, 0.0, 0.0), 0.8)], 0) == pytest.approx(2.2)
    assert certify(path, [fixed((0.0, 0.0, 0.0), 0.8, any_height=True)], 0) == pytest.approx(-0.8)


def test_steps_before_the_first_one_that_can_change_are_not_certified() -> None:
    path = line((0.85, 0.0, 0.0), (10.85, 0.0, 0.0))  # leaves; margin 0.05 in the first segment, 1.05 from the second
    keep_out = [fixed((0.0, 0.0, 0.0), 0.8)]
    assert certify(path, keep_out, 0) == pytest.approx(0.05)
    assert certify(path, keep_out, 1) == pytest.approx(1.05)


def test_from_inside_a_keep_out_a_plan_may_leave_but_not_approach() -> None:
    keep_out = [fixed((0.0, 0.0, 0.0), 0.8)]
    assert certify(line((0.5, 0.0, 0.0), (3.0, 0.0, 0.0)), keep_out, 0) == 0.0
    assert certify(line((0.5, 0.0, 0.0), (0.1, 0.0, 0.0)), keep_out, 0) == pytest.approx(-0.7)
    # the excuse is for that keep-out only
    assert certify(line((0.5, 0.0, 0.0), (3.0, 0.0, 0.0)), [*keep_out, fixed((3.0, 0.0, 0.0), 0.8)], 0) < 0.0


def crept_m(encounters: Encounters | None) -> float:
    """Distance to a keep-out of 0.8 m at rest after thirty ticks, each of which comes 1.9 cm closer if certified."""
    apart_m, keep_out = 0.6, fixed((0.0, 0.0, 0.0), 0.8)
    for _ in range(30):
        here = np.array([apart_m, 0.0, 0.0])
        (noted,) = [keep_out] if encounters is None else encounters.noted([replace(keep_out, key=1)], here)
        if certify(line((apart_m, 0.0, 0.0), (apart_m - 0.019, 0.0, 0.0)), [noted], 0) >= 0.0:
            apart_m -= 0.019
    return apart_m


def test_no_number_of_certified_plans_comes_two_centimetres_closer_in_one_encounter() -> None:
    assert crept_m(Encounters()) >= 0.6 - 0.02 - 1e-6
    assert crept_m(None) < 0.1, "control: measured tick by tick they arrive"


def test_an_encounter_begins_again_once_the_keep_out_was_left() -> None:
    encounters, keep_out = Encounters(), replace(fixed((0.0, 0.0, 0.0), 0.8), key=1)

    def entered_m(apart_m: float) -> float | None:
        return encounters.noted([keep_out], np.array([apart_m, 0.0, 0.0]))[0].entered_m

    assert entered_m(0.9) is None
    assert [entered_m(apart_m) for apart_m in (0.7, 0.6, 0.75)] == [0.7, 0.7, 0.7]
    assert entered_m(0.8) is None
    assert entered_m(0.5) == 0.5


def test_whoever_has_come_too_close_already_must_open() -> None:
    pushed = replace(fixed((0.0, 0.0, 0.0), 0.8), key=1, entered_m=0.7)  # by a peer or by wind, to 0.5 m
    assert certify(line((0.5, 0.0, 0.0), (0.499, 0.0, 0.0)), [pushed], 0) < 0.0
    assert certify(line((0.5, 0.0, 0.0), (0.6, 0.0, 0.0)), [pushed], 0) == 0.0


def test_a_full_control_horizon_leaves_the_last_step_to_certify() -> None:
    path = line((0.0, 0.0, 0.0), (5.0, 0.0, 0.0), 6)
    assert certify(path, [fixed((5.0, 0.0, 0.0), 0.8, steps=6)], 6) < 0.0


# -- half-spaces ------------------------------------------------------------------------------------------------------


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
            np.zeros(3),
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
    """From 2.9 m to 1.9 m away: 0.3 of the metre, at most 0.15 m; then nothing where nobody comes closer."""
    closing = line((-2.9, 0.0, -2.0), (-1.9, 0.0, -2.0))
    steady = line((-1.9, 0.0, -2.0), (-1.9, 0.0, -2.0))
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
    want_m = radius_m + np.minimum(0.3 * 0.1 * np.arange(1, STEPS + 1), 0.15)
    np.testing.assert_allclose(np.abs(kept_m(closing, peer_at_origin, params)), want_m, atol=1e-9)
    for guess, keep_out, used in (
        (steady, peer_at_origin, params),
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
    spaces = in_space(still((0.0, 0.0, -3.0)), rising_other)
    assert spaces.stop_s[0] == pytest.approx(1.0 / 2.8)
    assert spaces.stop_offset_m[0] == pytest.approx(1.0 + 0.9 + 1.0 / 2.8)  # -z: where it is then, and the radius


def test_in_space_a_climb_counts_as_progress() -> None:
    peer_ahead = builders.keep_out(pos_ned_m=np.linspace((1.5, 0.0, -0.2), (1.5, 0.0, -2.2), STEPS + 1))
    climbing = np.linspace((0.0, 0.0, 0.0), (0.05, 0.0, -2.0), STEPS + 1)  # 2 m, of which 5 cm are not up
    turned = in_space(climbing, peer_ahead, goal=(9.0, 0.0, -2.0)).normal[0, :, 1]
    np.testing.assert_allclose(turned, 0.0, atol=1e-9)


# -- how large the radius has to be -----------------------------------------------------------------------------------


def test_the_required_radius_covers_bodies_tracking_and_two_position_errors() -> None:
    params = SeparationParams(radius_m=0.9, body_m=0.48, tracking_m=0.05)
    assert params.budget.required_m(0.0) == pytest.approx(0.53)
    assert 1.2 < params.budget.required_m(0.28) < 1.5  # of an autopilot on plain GPS, as flights of them suggest
    rng, accuracy_m = np.random.default_rng(2), 0.28
    errors = rng.normal(scale=accuracy_m / math.sqrt(2.0), size=(100_000, 2, 2))
    apart = params.budget.required_m(accuracy_m) - 0.05 - np.linalg.norm(errors[:, 0] - errors[:, 1], axis=1)
    assert (apart < params.body_m).mean() < 0.03


@pytest.mark.parametrize(
    ("told", "accuracy_m", "refused"),
    [({}, 0.0, False), ({}, 0.28, True), ({"radius_m": 1.4}, 0.28, False), ({"allow_small_radius": True}, 0.28, False)],
)
def test_a_radius_that_is_too_small_is_refused_unless_allowed(
    told: dict[str, Any], accuracy_m: float, refused: bool
) -> None:
    problem = radius_problem(SeparationParams(**told), accuracy_m, 0.0)
    assert bool(problem) is refused
    if refused:
        assert all(part in problem for part in ("separation.radius_m = 0.9", "1.27 m", "allow_small_radius"))


def test_gusts_raise_the_radius_that_is_required() -> None:
    params = SeparationParams(gust_m_s=8.0)
    assert radius_problem(params, 0.0, 0.0) == ""
    problem = radius_problem(params, 0.0, 1.0)
    assert all(part in problem for part in ("gusts of 8 m/s, each 1.00 m,", "need 2.48 m"))


def test_plans_keep_the_tracking_error_on_top_and_the_certificate_does_not() -> None:
    keep_out = keep_out_of_peer(peer(np.zeros((3, 3))), UTC_US, DT_US, 2, params=SeparationParams(tracking_m=0.07))
    assert keep_out.radius_m == pytest.approx(0.97)
    assert keep_out.hard_min_distance_m == pytest.approx(0.8)
