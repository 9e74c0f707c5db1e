"""Tests of the prediction of a vehicle that its autopilot or a pilot flies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.estimation.flown_by_others import (
    StopJudge,
    predict_after_setpoints,
    predict_flown_by_others,
    predict_without_setpoints,
)
from swarmctl.core.autopilot_stop import ANSWER_S, BRAKE_M_S2, HOLD_BRAKE_M_S2
from swarmctl.core.frames import GRAVITY_M_S2, quat_from_euler
from swarmctl.core.types import FlightMode, Plan, PlanStatus
from tests import builders

SEEN_AFTER_S = 0.05  # that no setpoint comes
AHEAD_S = np.arange(0.0, 3.01, 0.1)
STATE = builders.vehicle_state(
    pos_ned_m=np.array([1.0, 2.0, -3.0]), vel_ned_m_s=np.array([2.0, 0.0, 0.0]), mode=FlightMode.MANUAL
)


def test_under_a_pilot_the_velocity_is_continued_after_it_has_changed_as_the_tilt_says() -> None:
    assert predict_flown_by_others(STATE, AHEAD_S, BRAKE_M_S2, stops=False)[-1] == pytest.approx([7.0, 2.0, -3.0])
    tilted = replace(STATE, q_nb=quat_from_euler(0.0, -np.arctan(0.1), 0.0))
    gained_m = 0.1 * GRAVITY_M_S2 * (0.5 * 0.4**2 + 0.4 * 2.6)
    assert predict_flown_by_others(tilted, AHEAD_S, 9.0, stops=False)[-1, 0] == pytest.approx(7.0 + gained_m)
    climbs = replace(tilted, mode=FlightMode.TAKEOFF)
    assert predict_flown_by_others(climbs, AHEAD_S, 9.0, stops=False)[-1, 0] == pytest.approx(7.0)


def integrated_m(
    vel_m_s: float, phases: Sequence[tuple[float, float]], *, accel_m_s2: float, until_s: float
) -> tuple[float, float]:
    """Return way and speed of a motion whose acceleration approaches one after another, (begin, acceleration) each."""
    step_s, way_m, t_s = 1e-4, 0.0, 0.0
    while t_s < until_s and vel_m_s > 0.0:
        goal_m_s2 = next((goal for begin_s, goal in reversed(phases) if t_s >= begin_s), accel_m_s2)
        accel_m_s2 += (goal_m_s2 - accel_m_s2) / ANSWER_S * step_s
        vel_m_s += accel_m_s2 * step_s
        way_m += vel_m_s * step_s
        t_s += step_s
    return way_m, vel_m_s


@pytest.mark.parametrize("speed_m_s", [0.6, 2.0, 4.0])
@pytest.mark.parametrize("accel_m_s2", [-2.0, 0.0, 2.0])
@pytest.mark.parametrize("mode", [FlightMode.LAND, FlightMode.HOLD])
def test_who_stops_turns_its_acceleration_into_braking(speed_m_s: float, accel_m_s2: float, mode: FlightMode) -> None:
    q_nb = quat_from_euler(0.0, -np.arctan(accel_m_s2 / GRAVITY_M_S2), 0.0)
    state = replace(STATE, vel_ned_m_s=np.array([speed_m_s, 0.0, 0.0]), q_nb=q_nb, mode=mode)
    brake_m_s2 = HOLD_BRAKE_M_S2 if mode is FlightMode.HOLD else BRAKE_M_S2
    way_m = (predict_flown_by_others(state, AHEAD_S, 9.0, stops=True) - STATE.pos_ned_m) @ [1.0, 0.0, 0.0]
    for ahead_s, reached_m in zip(AHEAD_S[::5], way_m[::5], strict=True):
        expected_m, _ = integrated_m(speed_m_s, [(0.0, -brake_m_s2)], accel_m_s2=accel_m_s2, until_s=ahead_s)
        assert reached_m == pytest.approx(expected_m, abs=0.06)


@pytest.mark.parametrize(
    ("speed_m_s", "measured_m"),
    [(0.77, 0.32), (2.11, 1.48), (3.37, 2.83), (1.03, 0.50), (1.90, 1.15), (3.97, 4.1)],
)
def test_ways_to_rest_are_those_of_real_autopilots_that_land(speed_m_s: float, measured_m: float) -> None:
    state = replace(STATE, vel_ned_m_s=np.array([speed_m_s, 0.0, 0.0]), mode=FlightMode.LAND)
    way_m = predict_flown_by_others(state, np.array([9.0]), 9.0, stops=True)[0, 0] - STATE.pos_ned_m[0]
    assert 0.8 * measured_m < way_m < 1.2 * measured_m


def test_who_brakes_more_softly_is_taken_to() -> None:
    way_m = predict_flown_by_others(STATE, np.array([9.0]), 1.0, stops=True)[0, 0] - STATE.pos_ned_m[0]
    assert way_m == pytest.approx(2.0 * ANSWER_S + 2.0, abs=0.05)


def test_who_hovers_in_wind_is_not_expected_where_its_tilt_points() -> None:
    leaning = replace(
        STATE,
        vel_ned_m_s=np.array([0.2, 0.0, 0.0]),
        q_nb=quat_from_euler(0.0, -0.3, 0.0),
        mode=FlightMode.HOLD,
    )
    way_m = predict_flown_by_others(leaning, AHEAD_S, BRAKE_M_S2, stops=True)[:, 0] - STATE.pos_ned_m[0]
    assert way_m[-1] == pytest.approx(0.2**2 / (2.0 * BRAKE_M_S2))


def test_who_rests_is_predicted_to_rest() -> None:
    resting = replace(STATE, vel_ned_m_s=np.zeros(3), mode=FlightMode.HOLD)
    assert predict_flown_by_others(resting, AHEAD_S, BRAKE_M_S2, stops=True) == pytest.approx(
        np.tile(STATE.pos_ned_m, (len(AHEAD_S), 1))
    )


@pytest.mark.parametrize(("keeps_s", "coasts_s"), [(1.0, 2.0), (0.5, 0.5), (1.0, 0.5)])
def test_who_hears_nothing_keeps_its_tilt_then_coasts_and_then_brakes(keeps_s: float, coasts_s: float) -> None:
    """By g/10, as an ArduCopter does (configs/ardupilot_sitl.toml), a PX4, and who lands before it levels."""
    accel_m_s2 = 0.1 * GRAVITY_M_S2
    tilted = replace(STATE, q_nb=quat_from_euler(0.0, -np.arctan(0.1), 0.0), mode=FlightMode.EXTERNAL)
    pos = predict_without_setpoints(tilted, AHEAD_S, keeps_s=keeps_s, coasts_s=coasts_s, brake_m_s2=BRAKE_M_S2)
    kept_s, coasted_s = min(keeps_s, coasts_s) + SEEN_AFTER_S, coasts_s + SEEN_AFTER_S
    phases = [(kept_s, 0.0 if coasted_s > kept_s else -BRAKE_M_S2), (coasted_s, -BRAKE_M_S2)]
    for ahead_s, reached_m in zip(AHEAD_S[::5], (pos - STATE.pos_ned_m)[::5, 0], strict=True):
        expected_m, _ = integrated_m(2.0, phases, accel_m_s2=accel_m_s2, until_s=ahead_s)
        assert reached_m == pytest.approx(expected_m, abs=0.03)
    assert pos[:, 1:] == pytest.approx(np.tile(STATE.pos_ned_m[1:], (len(pos), 1)))


@pytest.mark.parametrize("drag_1_s", [0.33, 1.0])
def test_a_tilt_against_the_drag_keeps_the_speed_until_the_vehicle_levels(drag_1_s: float) -> None:
    """Without the drag of the vehicle it would be taken to accelerate: at 2 m/s a PX4 was expected 1.2 m too far."""
    q_nb = quat_from_euler(0.0, -np.arctan(drag_1_s * 2.0 / GRAVITY_M_S2), 0.0)
    tilted = replace(STATE, q_nb=q_nb, mode=FlightMode.EXTERNAL)
    limits = {"keeps_s": 1.0, "coasts_s": 2.0, "brake_m_s2": BRAKE_M_S2, "drag_1_s": drag_1_s}
    way_m = predict_without_setpoints(tilted, AHEAD_S, **limits)[:, 0] - STATE.pos_ned_m[0]
    kept = AHEAD_S <= 1.0
    assert way_m[kept] == pytest.approx(2.0 * AHEAD_S[kept])
    levelled_s = 2.0 - 1.0 - SEEN_AFTER_S
    assert way_m[20] == pytest.approx(2.1 + 2.0 * (1.0 - np.exp(-drag_1_s * levelled_s)) / drag_1_s, abs=0.02)
    stops = predict_flown_by_others(replace(tilted, mode=FlightMode.LAND), AHEAD_S, 9.0, stops=True, drag_1_s=drag_1_s)
    straight = predict_flown_by_others(replace(STATE, mode=FlightMode.LAND), AHEAD_S, 9.0, stops=True)
    assert stops == pytest.approx(straight)


def test_who_follows_a_plan_has_its_last_attitude_later_than_the_setpoint() -> None:
    """On a circle of 2 m at 1 rad/s: until then it turns, and then keeps the acceleration of that time."""
    t_s = 0.05 * np.arange(41.0)[:, None]
    plan = Plan(
        status=PlanStatus.OK,
        t0_us=1_000_000,
        dt_us=50_000,
        pos_ned_m=np.hstack([2.0 * np.sin(t_s), 2.0 - 2.0 * np.cos(t_s), 0.0 * t_s]),
        vel_ned_m_s=np.hstack([2.0 * np.cos(t_s), 2.0 * np.sin(t_s), 0.0 * t_s]),
        virtual_control=np.zeros((40, 3)),
    )
    limits = {"keeps_s": 1.0, "coasts_s": 9.0, "brake_m_s2": BRAKE_M_S2, "lag_s": 0.2}
    pos = predict_after_setpoints(plan, 1_100_000, np.array([0.0, 0.1, 0.2, 0.6]), **limits)
    assert pos[:3] == pytest.approx(plan.pos_ned_m[[2, 4, 6]], abs=1e-9)
    accel = 2.0 * np.array([-np.sin(0.3), np.cos(0.3), 0.0])
    kept = plan.pos_ned_m[6] + 0.4 * plan.vel_ned_m_s[6] + 0.5 * 0.4**2 * accel
    assert pos[3] == pytest.approx(kept, abs=0.01)


def test_who_has_followed_a_plan_keeps_the_acceleration_that_it_had_there() -> None:
    """0.25 s into a plan that accelerates from rest at 2 m/s2 it flies 0.5 m/s."""
    t_s = 0.1 * np.arange(6.0)[:, None]
    north = np.array([1.0, 0.0, 0.0])
    plan = Plan(
        status=PlanStatus.OK,
        t0_us=1_000_000,
        dt_us=100_000,
        pos_ned_m=t_s**2 * north,
        vel_ned_m_s=2.0 * t_s * north,
        virtual_control=np.zeros((5, 3)),
    )
    ahead_s = np.array([0.0, 1.0, 3.0])
    pos = predict_after_setpoints(plan, 1_250_000, ahead_s, keeps_s=1.0, coasts_s=9.0, brake_m_s2=BRAKE_M_S2)
    begun_m, kept_s = 0.065, 1.0 + SEEN_AFTER_S  # half way between two points of the plan
    levelled_m_s = 0.5 + 2.0 * (kept_s + ANSWER_S)
    last_m = 0.5 * kept_s + kept_s**2 + levelled_m_s * (3.0 - kept_s) - 2.0 * ANSWER_S**2
    assert pos == pytest.approx(np.outer([begun_m, begun_m + 1.5, begun_m + last_m], north), abs=1e-3)


def judged(mode: FlightMode, speeds_m_s: Sequence[float]) -> list[bool]:
    """Return what is judged of states 0.1 s apart at these speeds."""
    judge = StopJudge()
    return [
        judge.update(replace(STATE, t_us=100_000 * k, mode=mode, vel_ned_m_s=np.array([speed_m_s, 0.0, 0.0])))
        for k, speed_m_s in enumerate(speeds_m_s)
    ]


def test_who_enters_hold_stops_and_who_is_moved_in_it_does_not() -> None:
    assert judged(FlightMode.HOLD, [3.0] * 30) == [True] * 2 + [False] * 28
    braking = [3.0] * 11 + [3.0 - 0.1 * k for k in range(25)]
    assert judged(FlightMode.HOLD, braking)[-22:] == [True] * 22
    assert judged(FlightMode.HOLD, [0.0] * 20 + [1.0] * 10)[20:] == [False] * 10, "moved away from where it hovered"
    assert judged(FlightMode.HOLD, [0.3, 0.1, 0.4, 0.2] * 10) == [True] * 40, "estimates wander"


def test_who_lands_stops_and_who_is_flown_otherwise_does_not() -> None:
    assert all(judged(FlightMode.LAND, [1.0] * 20))
    assert not any(judged(FlightMode.MANUAL, [1.0] * 20))
