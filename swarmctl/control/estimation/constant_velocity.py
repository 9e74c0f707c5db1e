"""Prediction of a vehicle that its autopilot or a pilot flies: constant velocity, or braking in hold and land."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.core.types import Array, FlightMode, VehicleState

_STOPS = (FlightMode.HOLD, FlightMode.LAND)  # modes in which an autopilot brakes


def predict_constant_velocity(state: VehicleState, ahead_s: Array, brake_m_s2: float) -> Array:
    """Return positions (N, 3), NED [m], at `ahead_s` (N,) after a state.

    The velocity is continued, or reduced at `brake_m_s2` in modes in which the autopilot stops the vehicle.
    """
    if state.mode in _STOPS:
        speed = math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))
        t_s = np.minimum(ahead_s, speed / brake_m_s2)
        ahead_s = t_s - 0.5 * brake_m_s2 * t_s * t_s / max(speed, 1e-6)  # time to travel as far at the present speed
    return np.asarray(state.pos_ned_m + ahead_s[:, None] * state.vel_ned_m_s)
