"""Tests of the prediction of a vehicle that its autopilot or a pilot flies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.estimation.constant_velocity import (
    StopJudge,
    predict_after_setpoints,
    predict_constant_velocity,
    predict_without_setpoints,
)
from swarmctl.core.frames import GRAVITY_M_S2, quat_from_euler
from swarmctl.core.types import FlightMode, Plan, PlanStatus
from tests import builders

BRAKE_M_S2 = 2.0
AHEAD_S = np.arange(0.0, 3.01, 0.1)
STATE = builders.vehicle_state(
    pos_ned_m=np.array([1.0, 2.0, -3.0]), vel_ned_m_s=np.array([2.0, 0.0, 0.0]), mode=FlightMode.MANUAL
)


def test_under_a_pilot_the_velocity_is_continued() -> None:
    assert predict_constant_velocity(STATE, AHEAD_S, BRAKE_M_S2, stops=False)[-1] == pytest.approx([7.0, 2.0, -3.0])


def test_braking_is_predicted_of_who_stops() -> None:
    """From 2 m/s at 2 m/s2 it stops after 1 s and 1 m."""
    pos = predict_constant_velocity(STATE, AHEAD_S, BRAKE_M_S2, stops=True)
    assert pos[10:] == pytest.approx(np.tile([2.0, 2.0, -3.0], (len(AHEAD_S) - 10, 1)))
    assert pos[5] == pytest.approx([1.75, 2.0, -3.0]), "1 m/s left"
    resting = replace(STATE, vel_ned_m_s=np.zeros(3))
    assert predict_constant_velocity(resting, AHEAD_S, BRAKE_M_S2, stops=True) == pytest.approx(
        np.tile(STATE.pos_ned_m, (len(AHEAD_S), 1))
    )


def test_who_hears_nothing_keeps_its_tilt_then_coasts_and_then_brakes() -> None:
    """By g/10 for 1 s, straight on until 2 s, and at 2 m/s2 to rest: ArduCopter by configs/ardupilot_sitl.toml."""
    accel_m_s2 = 0.1 * GRAVITY_M_S2
    tilted = replace(STATE, q_nb=quat_from_euler(0.0, -np.arctan(0.1), 0.0), mode=FlightMode.EXTERNAL)
    ahead_s = np.array([0.0, 1.0, 2.0, 2.5, 9.0])
    pos = predict_without_setpoints(tilted, ahead_s, keeps_s=1.0, coasts_s=2.0, brake_m_s2=BRAKE_M_S2)
    speed_m_s = 2.0 + accel_m_s2
    way_m = np.array([0.0, 2.0 + 0.5 * accel_m_s2, 4.0 + 1.5 * accel_m_s2, 0.0, 0.0])
    way_m[3:] = way_m[2] + np.array([0.5 * speed_m_s - 0.25, 0.25 * speed_m_s**2])
    assert pos == pytest.approx(STATE.pos_ned_m + np.outer(way_m, [1.0, 0.0, 0.0]))


def test_who_lands_before_it_levels_brakes_from_the_tilt_it_has() -> None:
    level = replace(STATE, mode=FlightMode.EXTERNAL)
    pos = predict_without_setpoints(level, AHEAD_S, keeps_s=1.0, coasts_s=0.5, brake_m_s2=BRAKE_M_S2)
    assert pos[[5, 30]] == pytest.approx(STATE.pos_ned_m + np.outer([1.0, 2.0], [1.0, 0.0, 0.0]))


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
    ahead_s = np.array([0.0, 1.0, 2.0])
    pos = predict_after_setpoints(plan, 1_250_000, ahead_s, keeps_s=1.0, coasts_s=9.0, brake_m_s2=BRAKE_M_S2)
    begun_m = 0.065  # half way between two points of the plan
    assert pos == pytest.approx(np.outer([begun_m, begun_m + 1.5, begun_m + 4.0], north))


def judged(mode: FlightMode, speeds_m_s: Sequence[float]) -> list[bool]:
    """Return what is judged of states 0.1 s apart at these speeds."""
    judge = StopJudge()
    return [
        judge.update(replace(STATE, t_us=100_000 * k, mode=mode, vel_ned_m_s=np.array([speed_m_s, 0.0, 0.0])))
        for k, speed_m_s in enumerate(speeds_m_s)
    ]


def test_who_enters_hold_stops_and_who_is_moved_in_it_does_not() -> None:
    assert judged(FlightMode.HOLD, [3.0] * 30) == [True] * 10 + [False] * 20
    braking = [3.0] * 11 + [3.0 - 0.1 * k for k in range(25)]
    assert judged(FlightMode.HOLD, braking)[-22:] == [True] * 22
    assert judged(FlightMode.HOLD, [0.0] * 20 + [1.0] * 10)[20:] == [False] * 10, "moved away from where it hovered"
    assert judged(FlightMode.HOLD, [0.3, 0.1, 0.4, 0.2] * 10) == [True] * 40, "estimates wander"


def test_who_lands_stops_and_who_is_flown_otherwise_does_not() -> None:
    assert all(judged(FlightMode.LAND, [1.0] * 20))
    assert not any(judged(FlightMode.MANUAL, [1.0] * 20))
