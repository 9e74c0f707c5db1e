"""Where a vehicle goes that somebody else flies."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.core.types import Array, FlightMode, VehicleState

_STOPS = (FlightMode.HOLD, FlightMode.LAND)  # modes in which an autopilot is about to brake


def predict_constant_velocity(state: VehicleState, ahead_s: Array, brake_m_s2: float) -> Array:
    """Positions (N, 3) at times (N,) after a state: its velocity continued, or braked where the autopilot will stop."""
    if state.mode in _STOPS:
        speed = math.sqrt(float(state.vel_ned_m_s @ state.vel_ned_m_s))
        t_s = np.minimum(ahead_s, speed / brake_m_s2)
        ahead_s = t_s - 0.5 * brake_m_s2 * t_s * t_s / max(speed, 1e-6)  # of the present speed, for the same way
    return np.asarray(state.pos_ned_m + ahead_s[:, None] * state.vel_ned_m_s)
