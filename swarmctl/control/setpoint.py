"""Conversion of virtual controls to an attitude setpoint with normalised thrust."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.control.model import VehicleModelParams
from swarmctl.core.frames import GRAVITY_M_S2, quat_from_body_z, quat_of_tilt
from swarmctl.core.types import Array, AttitudeSetpoint

VALID_US = 100_000  # a setpoint is stale after this time
HELD_MAX_US = 200_000  # longest time for which a setpoint is expected to be held
_SUNK_M = 0.3  # below the reference; more than a gust costs that thrust makes good again
_CLIMB_1_S2 = 2.0  # vertical acceleration left for each metre more
_CLIMB_MAX_M_S2 = 1.0  # with 15 m/s2 of thrust it leaves 0.69 of tilt against the wind, level flight 0.76
_ATTITUDES = {"swing_twist": quat_of_tilt, "euler": quat_from_body_z}  # by `vehicle_model.heading`


class SetpointHold:
    """Expects for how long the next setpoint is held, from the times of those before.

    The inputs of a plan change after every step; the one that is sent is held until the next tick. Where ticks are
    missed, or are meant to be rarer, these are several steps, and the input of their middle stands for those that are
    never sent. The first one is bounded to the change of a single step: a vehicle whose agent runs one of ten ticks
    swings ever farther with it.
    """

    def __init__(self) -> None:
        self._sent_us: tuple[int, int] | None = None  # the last two, the newer one first

    def middle_us(self, now_us: int, dt_us: int) -> int:
        """Return by how much the middle of the next setpoint's time is later than that of one step of the plan.

        One late tick after others in time is no reason to expect another. To be called with each setpoint.

        Args:
            now_us: monotonic time.
            dt_us: step of the plan.
        """
        sent_us = self._sent_us
        self._sent_us = (now_us, now_us if sent_us is None else sent_us[0])
        if sent_us is None:
            return 0
        return max(0, min(now_us - sent_us[0], sent_us[0] - sent_us[1], HELD_MAX_US) - dt_us) // 2


def within_tilt(virtual_control: Array, params: VehicleModelParams) -> Array:
    """Return virtual controls (3,) whose (u_x, u_y) are shortened to the vehicle's largest tilt, where they ask more.

    Controllers bound each axis by itself, so both together may ask for 1.4 times as much.
    """
    return _shortened(virtual_control, params.u_max())


def within_bounds(virtual_control: Array, hover_thrust_01: float, params: VehicleModelParams) -> Array:
    """Return virtual controls (3,) that `setpoint_of` does not change any more: within largest tilt and thrust range.

    Args:
        virtual_control: u_x, u_y, and thrust over mass [m/s2].
        hover_thrust_01: thrust that holds the weight.
        params: bounds.
    """
    shortened = within_tilt(virtual_control, params)
    ux, uy, specific = shortened.tolist()
    asked_01 = hover_thrust_01 * specific / GRAVITY_M_S2
    bounded_01 = _within_range(asked_01, params)
    if bounded_01 == asked_01 or not math.isfinite(asked_01):
        return shortened
    return np.array([ux, uy, GRAVITY_M_S2 * bounded_01 / hover_thrust_01])


def _within_range(thrust_01: float, params: VehicleModelParams) -> float:
    return min(params.thrust_max_01, max(params.thrust_min_01, thrust_01))


def holding_height(virtual_control: Array, below_m: float, thrust_max_m_s2: float) -> Array:
    """Return virtual controls (3,) whose tilt is shortened until the largest thrust carries a sunken vehicle up again.

    Against a wind that asks for more than thrust has, a controller that plans height and position apart tilts as far as
    it may, and pays for it with height: in 10 m/s an x500 lost 8 m in 14 s, on the ground it would have been after 5 s.
    Height goes first: what is near is below, and the wind takes a level vehicle no farther than it must.

    Args:
        virtual_control: u_x, u_y, and thrust over mass [m/s2].
        below_m: height of the reference above the vehicle.
        thrust_max_m_s2: largest thrust over mass.
    """
    if below_m <= _SUNK_M:
        return virtual_control
    carried_m_s2 = GRAVITY_M_S2 + min(_CLIMB_MAX_M_S2, _CLIMB_1_S2 * (below_m - _SUNK_M))
    most = math.sqrt(max(0.0, 1.0 - (carried_m_s2 / thrust_max_m_s2) ** 2))
    return _shortened(virtual_control, most)


def _shortened(virtual_control: Array, most: float) -> Array:
    """Return virtual controls (3,) whose (u_x, u_y) is no longer than `most`."""
    ux, uy, specific = virtual_control.tolist()
    tilt = math.hypot(ux, uy)
    if not tilt > most:
        return virtual_control
    return np.array([ux * most / tilt, uy * most / tilt, specific])


def setpoint_of(
    virtual_control: Array, yaw_rad: float, hover_thrust_01: float, now_us: int, *, params: VehicleModelParams
) -> AttitudeSetpoint:
    """Return the attitude and thrust of virtual controls (3,): u_x, u_y, thrust over mass [m/s2].

    The body down axis is (u_x, u_y, sqrt(1 - u_x^2 - u_y^2)), limited by `within_tilt`. With the yaw of Euler angles
    these are thesis (3.26) and (3.33) without their singularity. A body that keeps that yaw while its tilt goes round
    turns about its down axis by fits and starts, faster than autopilots follow: see docs/real_autopilots.md. Thrust is
    linear in the autopilot's 0..1; `hover_thrust_01` holds the weight.
    """
    ux, uy, specific = within_tilt(virtual_control, params).tolist()
    tilt = math.hypot(ux, uy)
    down = np.array([ux, uy, math.sqrt(max(0.0, 1.0 - tilt * tilt))])
    thrust = hover_thrust_01 * specific / GRAVITY_M_S2
    thrust = _within_range(thrust, params) if math.isfinite(thrust) else math.nan
    return AttitudeSetpoint(_ATTITUDES[params.heading](down, yaw_rad), thrust, now_us + VALID_US)
