"""Tests of the prediction of a vehicle that its autopilot or a pilot flies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.estimation.constant_velocity import predict_constant_velocity
from swarmctl.core.types import FlightMode
from tests import builders

BRAKE_M_S2 = 2.0
AHEAD_S = np.arange(0.0, 3.01, 0.1)
STATE = builders.vehicle_state(
    pos_ned_m=np.array([1.0, 2.0, -3.0]), vel_ned_m_s=np.array([2.0, 0.0, 0.0]), mode=FlightMode.MANUAL
)


def test_under_a_pilot_the_velocity_is_continued() -> None:
    assert predict_constant_velocity(STATE, AHEAD_S, BRAKE_M_S2)[-1] == pytest.approx([7.0, 2.0, -3.0])


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.LAND])
def test_in_hold_and_land_braking_is_predicted(mode: FlightMode) -> None:
    """From 2 m/s at 2 m/s2 it stops after 1 s and 1 m."""
    pos = predict_constant_velocity(replace(STATE, mode=mode), AHEAD_S, BRAKE_M_S2)
    assert pos[10:] == pytest.approx(np.tile([2.0, 2.0, -3.0], (len(AHEAD_S) - 10, 1)))
    assert pos[5] == pytest.approx([1.75, 2.0, -3.0]), "1 m/s left"
    resting = replace(STATE, mode=mode, vel_ned_m_s=np.zeros(3))
    assert predict_constant_velocity(resting, AHEAD_S, BRAKE_M_S2) == pytest.approx(
        np.tile(STATE.pos_ned_m, (len(AHEAD_S), 1))
    )
