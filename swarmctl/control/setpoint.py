"""Conversion of virtual controls to an attitude setpoint with normalised thrust."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.control.model import VehicleModelParams
from swarmctl.core.frames import GRAVITY_M_S2, quat_from_body_z
from swarmctl.core.types import Array, AttitudeSetpoint

VALID_US = 100_000  # a setpoint is stale after this time


def within_tilt(virtual_control: Array, params: VehicleModelParams) -> Array:
    """Return virtual controls (3,) whose (u_x, u_y) are shortened to the vehicle's largest tilt, where they ask more.

    Controllers bound each axis by itself, so both together may ask for 1.4 times as much.
    """
    ux, uy, specific = virtual_control.tolist()
    tilt, limit = math.hypot(ux, uy), params.u_max()
    if not tilt > limit:
        return virtual_control
    return np.array([ux * limit / tilt, uy * limit / tilt, specific])


def setpoint_of(
    virtual_control: Array, yaw_rad: float, hover_thrust_01: float, now_us: int, *, params: VehicleModelParams
) -> AttitudeSetpoint:
    """Return the attitude and thrust of virtual controls (3,): u_x, u_y, thrust over mass [m/s2].

    The body down axis is (u_x, u_y, sqrt(1 - u_x^2 - u_y^2)): thesis (3.26) and (3.33) without their singularity. Tilt
    is limited by `within_tilt`. Thrust is linear in the autopilot's 0..1; `hover_thrust_01` holds the weight.
    """
    ux, uy, specific = within_tilt(virtual_control, params).tolist()
    tilt = math.hypot(ux, uy)
    down = np.array([ux, uy, math.sqrt(max(0.0, 1.0 - tilt * tilt))])
    thrust = hover_thrust_01 * specific / GRAVITY_M_S2
    thrust = min(params.thrust_max_01, max(params.thrust_min_01, thrust)) if math.isfinite(thrust) else math.nan
    return AttitudeSetpoint(quat_from_body_z(down, yaw_rad), thrust, now_us + VALID_US)
