"""Time alignment, growth with age and the certificate agree with numbers worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.separation import (
    SeparationParams,
    align,
    aligned,
    certify,
    keep_out_along,
    keep_out_of_obstacle,
    keep_out_of_peer,
    radius_problem,
    visible,
    without_setpoints,
)
from swarmctl.core.autopilot_stop import ANSWER_S, BRAKE_M_S2
from swarmctl.core.obstacle import Obstacle
from tests import builders
from tests.benches.keep_outs import DT_US, PARAMS, STEPS, UTC_US, fixed, line, peer, straight


def test_alignment_interpolates_between_points() -> None:
    curve = peer(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, -1.0], [3.0, 2.0, -1.0], [3.0, 6.0, -1.0]]))
    found = align(curve, UTC_US + 25_000, 50_000, 3, brake_m_s2=3.0)
    np.testing.assert_allclose(found, [[0.25, 0.0, -0.25], [0.75, 0.0, -0.75], [1.5, 0.5, -1.0], [2.5, 1.5, -1.0]])


def test_alignment_before_the_first_point_goes_back_along_the_first_segment() -> None:
    found = align(straight(2.0), UTC_US - 150_000, DT_US, 2, brake_m_s2=3.0)
    np.testing.assert_allclose(found[:, 0], [-0.3, -0.1, 0.1], atol=1e-12)


def test_beyond_its_end_a_peer_brakes_to_a_stop() -> None:
    # 3 m/s at the end (x = 1.5 at 0.5 s), brake 3 m/s2: stops 1 s later 1.5 m on
    found = align(straight(3.0), UTC_US + 500_000, 250_000, 6, brake_m_s2=3.0)
    # 3 t - 1.5 t^2 at 0, .25, .5, .75, 1 s: 0, .65625, 1.125, 1.40625, 1.5, then at rest
    np.testing.assert_allclose(found[:, 0], [1.5, 2.15625, 2.625, 2.90625, 3.0, 3.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(found[:, 2], -2.0)


def test_a_path_that_has_just_ended_is_continued_at_every_time() -> None:
    """The peer has braked since the end of its path, before the first time that is asked for."""
    late_s = np.array([0.15, 0.25, 0.35, 0.45])
    found = align(straight(3.0), UTC_US + 650_000, DT_US, 3, brake_m_s2=3.0)
    np.testing.assert_allclose(found[:, 0], 1.5 + 3.0 * late_s - 1.5 * late_s**2, atol=1e-12)


def test_several_peers_are_where_each_alone_would_be() -> None:
    rng = np.random.default_rng(3)
    paths = [
        replace(
            peer(np.cumsum(rng.normal(scale=0.1, size=(count, 3)), axis=0), dt_us),
            t0_utc_us=UTC_US + since_us,
        )
        for count, dt_us, since_us in (
            (6, 100_000, 0),
            (40, 50_000, -80_000),
            (3, 100_000, -900_000),
            (9, 20_000, 70_000),
        )
    ]
    for some in (paths, paths[1:2], paths[2:3], paths[:2]):
        found = aligned(some, UTC_US, 25_000, 30, brake_m_s2=3.0)
        alone = [align(path, UTC_US, 25_000, 30, brake_m_s2=3.0) for path in some]
        np.testing.assert_allclose(found, alone, atol=1e-12)


def test_without_setpoints_the_first_level_acceleration_goes_on_and_then_it_brakes() -> None:
    t_s = np.arange(6) * (DT_US * 1e-6)
    turns = np.stack([2.0 * t_s, 0.5 * t_s**2, -2.0 - t_s**2], axis=1)
    turns[3:] = turns[2]  # planned later on, and not flown
    flown = align(without_setpoints(peer(turns)), UTC_US, 100_000, 40, brake_m_s2=3.0)
    kept_s = 0.1 * np.arange(6)
    np.testing.assert_allclose(flown[:6, 0], 2.0 * kept_s, atol=1e-12)
    np.testing.assert_allclose(flown[:6, 1], 0.5 * kept_s**2, atol=1e-12)
    np.testing.assert_allclose(np.diff(flown[:6, 2]), flown[1, 2] - flown[0, 2], atol=1e-12)
    stopped_m = np.linalg.norm(flown[-1] - flown[5])
    speed_m_s = np.linalg.norm(flown[5] - flown[4]) / 0.1
    assert stopped_m == pytest.approx(speed_m_s**2 / (2.0 * BRAKE_M_S2) + ANSWER_S * speed_m_s, rel=0.15)


def test_without_setpoints_a_turn_goes_on_until_the_attitude_is_that_of_the_last_one() -> None:
    """Then the acceleration of that time is kept, less what drag takes of what it adds."""
    t_s = 0.05 * np.arange(41)
    turns = np.stack([2.0 * np.sin(t_s), 2.0 - 2.0 * np.cos(t_s), np.full(41, -2.0)], axis=1)  # 2 m at 1 rad/s
    path = replace(peer(turns), dt_us=50_000)
    for drag_1_s in (0.0, 1.0):
        flown = without_setpoints(path, lag_s=0.2, drag_1_s=drag_1_s).pos_ned_m
        np.testing.assert_allclose(flown[:5], turns[:5], atol=2e-3)
        middle_s = 0.05 * np.arange(4.5, 9.0)  # between points, while the attitude is kept
        vel = np.diff(flown[4:10], axis=0) / 0.05
        kept_s = middle_s - 0.2 if not drag_1_s else 1.0 - np.exp(0.2 - middle_s)
        at_once = np.array([2.0 * np.cos(0.2), 2.0 * np.sin(0.2)])
        gained = np.outer(kept_s, [-2.0 * np.sin(0.2), 2.0 * np.cos(0.2)])
        np.testing.assert_allclose(vel[:, :2], at_once + gained, atol=0.06)
    np.testing.assert_array_equal(without_setpoints(path, lag_s=0.0).pos_ned_m, without_setpoints(path).pos_ned_m)


@pytest.mark.parametrize("drag_1_s", [0.0, 1.0])
def test_without_setpoints_what_the_last_setpoint_asks_for_is_kept_where_that_is_told(drag_1_s: float) -> None:
    """It is of one tick; the path goes on as setpoints would that are never sent."""
    t_s = 0.05 * np.arange(41)
    brakes = np.stack([2.0 * t_s - 0.5 * t_s**2, np.zeros(41), np.full(41, -2.0)], axis=1)
    told = replace(peer(brakes), dt_us=50_000, setpoint_accel_ned_m_s2=np.array([0.0, 3.0, 1.0]))
    flown = without_setpoints(told, lag_s=0.2, drag_1_s=drag_1_s).pos_ned_m
    np.testing.assert_array_equal(flown[:5], brakes[:5])
    acceleration = np.diff(flown[4:10], n=2, axis=0) / 0.05**2
    vel = np.diff(flown[4:10], axis=0)[:-1] / 0.05
    np.testing.assert_allclose(acceleration, [0.0, 3.0, 1.0] - drag_1_s * vel, atol=0.15)


def test_without_setpoints_height_is_held_once_the_attitude_is_not_kept_any_more() -> None:
    """An ArduCopter flies on level then; with little thrust it does not sink on meanwhile."""
    rests = replace(peer(np.tile([0.0, 0.0, -9.0], (41, 1))), setpoint_accel_ned_m_s2=np.array([1.0, 0.0, 2.0]))
    flown = align(without_setpoints(rests, keeps_s=1.0, coasts_s=2.0), UTC_US, 100_000, 30, brake_m_s2=3.0)
    down_m_s, north_m_s = np.diff(flown[:, 2]) / 0.1, np.diff(flown[:, 0]) / 0.1
    assert down_m_s[10] == pytest.approx(2.1, abs=0.1)
    assert down_m_s[19] < 1.3 and down_m_s[26] < 0.1
    assert north_m_s[19] == pytest.approx(1.3, abs=0.1), "it flies on for 2 s"


def test_without_setpoints_an_autopilot_that_takes_over_late_keeps_the_attitude_and_flies_on_level() -> None:
    """As an ArduCopter: GUID_TIMEOUT 1 s, FS_GCS_TIMEOUT 2 s."""
    t_s = np.arange(6) * (DT_US * 1e-6)
    turns = np.stack([2.0 * t_s, 0.5 * t_s**2, np.full(6, -2.0)], axis=1)
    flown = align(without_setpoints(peer(turns), keeps_s=1.0, coasts_s=2.0), UTC_US, 100_000, 60, brake_m_s2=3.0)
    kept_s = 0.1 * np.arange(11)
    np.testing.assert_allclose(flown[:11, :2], np.stack([2.0 * kept_s, 0.5 * kept_s**2], axis=1), atol=1e-9)
    vel_m_s = np.diff(flown[:, :2], axis=0) / 0.1
    np.testing.assert_allclose(vel_m_s[16:20], np.tile([2.0, 1.05 + ANSWER_S], (4, 1)), atol=0.03)
    assert np.linalg.norm(vel_m_s[22]) < np.linalg.norm(vel_m_s[19]) - 0.1, "it brakes then"
    assert np.linalg.norm(vel_m_s[-1]) < 1e-6


@pytest.mark.parametrize("points", [2, 3])
def test_without_setpoints_no_more_acceleration_is_kept_than_a_vehicle_has(points: int) -> None:
    jump = peer(np.array([[0.0, 0.0, -2.0], [0.0, 0.0, -2.0], [9.0, 0.0, -2.0]])[:points])
    flown = align(without_setpoints(jump), UTC_US, 100_000, 6, brake_m_s2=3.0)
    assert flown[-1, 0] <= 0.5 * 5.0 * 0.65**2


def test_a_path_one_hour_old_has_stopped() -> None:
    found = align(straight(3.0), UTC_US + 3_600_000_000, DT_US, 2, brake_m_s2=3.0)
    np.testing.assert_allclose(found[:, 0], 3.0)


def test_a_path_at_rest_is_not_extrapolated() -> None:
    found = align(straight(0.0), UTC_US + 10_000_000, DT_US, 2, brake_m_s2=3.0)
    np.testing.assert_allclose(found, np.tile([0.0, 0.0, -2.0], (3, 1)))


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


@pytest.mark.parametrize(
    ("age_s", "north_m", "radius_m"),
    [
        (9.0, 5.0, 2.15),  # all of the margin of age fits in between
        (9.0, 1.6, 1.6),
        (9.0, 0.5, 1.15),  # closer than is kept from the path itself
        (0.5, 0.5, 1.65),  # a path that is not that old is not a silent peer's
    ],
)
def test_a_silent_peer_is_not_approached_and_drives_nobody_away(age_s: float, north_m: float, radius_m: float) -> None:
    path = peer(np.zeros((3, 3)), radius_m=0.25)
    found = keep_out_along(
        path,
        np.zeros((STEPS + 1, 3)),
        UTC_US + round(age_s * 1e6),
        PARAMS,
        PARAMS.budget,
        parked=False,
        landing=False,
        here_ned_m=np.array([north_m, 0.0, -30.0]),  # level distances count: it may be at any height
    )
    assert found.radius_m == pytest.approx(radius_m)
    assert found.hard_min_distance_m == pytest.approx(1.05)


def test_the_distance_of_what_holds_at_every_height_is_level() -> None:
    here = np.array([3.0, 4.0, -12.0])
    assert fixed((0.0, 0.0, 0.0), 0.8, any_height=True).distance_m(here) == pytest.approx(5.0)
    assert fixed((0.0, 0.0, 0.0), 0.8).distance_m(here) == pytest.approx(13.0)


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


def test_a_wind_in_which_no_vehicle_can_stand_is_refused_in_other_words_than_a_radius() -> None:
    problem = radius_problem(SeparationParams(gust_m_s=30.0), 0.0, math.inf)
    assert problem.startswith("separation.gust_m_s = 30: no radius suffices")
    assert "inf" not in problem


def test_plans_keep_the_tracking_error_on_top_and_the_certificate_does_not() -> None:
    keep_out = keep_out_of_peer(peer(np.zeros((3, 3))), UTC_US, DT_US, 2, params=SeparationParams(tracking_m=0.07))
    assert keep_out.radius_m == pytest.approx(0.97)
    assert keep_out.hard_min_distance_m == pytest.approx(0.8)
