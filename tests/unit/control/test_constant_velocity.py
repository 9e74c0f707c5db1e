"""Tests of the prediction of a vehicle that its autopilot or a pilot flies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.estimation.constant_velocity import StopJudge, predict_constant_velocity
from swarmctl.core.types import FlightMode
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
