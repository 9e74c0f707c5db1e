"""Position control of ArduCopter itself: climb rates, heights, braking, holding, going to a place. Local NED, scalar.

Vertical and horizontal are separate, because GUIDED flies a given attitude at a controlled climb rate. Speeds are
shaped by an acceleration limit; position and velocity errors are fed back on top (PSC_*). It knows the true hover
thrust, as ArduCopter's hover-thrust learning does.
"""

from __future__ import annotations

import math

from sitl.acceleration import attitude_for, limited
from sitl.arducopter.parameters import CopterParameters
from sitl.arducopter.shaped_stop import ShapedStop, Xy
from sitl.plant.sensors import Estimate
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array

LEASH_M = 1.0  # limit of the shaped height's lead over the vehicle
Z_I_1_S2 = 2.0  # in place of PSC_ACCZ_I
Z_I_MAX_M_S2 = 3.0
XY_I_MAX_M_S2 = 2.0
DOWN_MAX_M_S2 = 0.9 * GRAVITY_M_S2
UP_MAX_M_S2 = 6.0
JERK_MAX_M_S3 = 15.0
HOLD_SPEED_M_S = 0.3  # below this speed the position is latched


class CopterNavigator:
    """Controllers of one vehicle; `engage` at every change of mode or of what is flown in it."""

    def __init__(self, parameters: CopterParameters, hover_thrust_01: float) -> None:
        self._parameters = parameters
        self.hover_01 = hover_thrust_01
        self._yaw_rad = 0.0
        self._hold_xy_m: Xy | None = None
        self._stop: ShapedStop | None = None
        self._hold_z_m: float | None = None
        self._z_m = self._down_m_s = 0.0  # shaped height and speed
        self._integral_m_s2 = [0.0, 0.0, 0.0]
        self._acc_m_s2 = [0.0, 0.0]

    def engage(self, estimate: Estimate) -> None:
        """Start from the present state, without memory of the flight before."""
        self._yaw_rad = estimate.yaw_rad
        self._hold_xy_m = self._hold_z_m = None
        self._z_m, self._down_m_s = estimate.pos_ned_m[2], estimate.vel_ned_m_s[2]
        self._integral_m_s2 = [0.0, 0.0, 0.0]
        down = estimate.down_axis_ned
        self._acc_m_s2 = [-GRAVITY_M_S2 * down[0], -GRAVITY_M_S2 * down[1]]
        self._stop = None
        if math.hypot(*estimate.vel_ned_m_s[:2]) > HOLD_SPEED_M_S:
            self._stop = ShapedStop(self._parameters, estimate, (self._acc_m_s2[0], self._acc_m_s2[1]))

    # --- vertical: throttle before angle boost ---

    def climb(self, estimate: Estimate, up_m_s: float, dt_s: float) -> float:
        """Return the throttle for a climb rate."""
        self._hold_z_m = None
        return self._throttle(estimate, -up_m_s, dt_s)

    def to_height(self, estimate: Estimate, z_ned_m: float, dt_s: float) -> float:
        """Return the throttle that flies to a height and holds it."""
        error = z_ned_m - self._z_m
        acc, gain = self._parameters.metres("WPNAV_ACCEL_Z"), self._parameters.real("PSC_POSZ_P")
        near = acc / gain**2
        speed = gain * error if abs(error) < near else math.copysign(math.sqrt(acc * (2 * abs(error) - near)), error)
        up, down = self._parameters.metres("WPNAV_SPEED_UP"), self._parameters.metres("WPNAV_SPEED_DN")
        return self._throttle(estimate, max(-up, min(down, speed)), dt_s)

    def hold_height(self, estimate: Estimate, dt_s: float) -> float:
        """Return the throttle that brakes and holds the height."""
        if self._hold_z_m is None and abs(self._down_m_s) < 1e-6:
            self._hold_z_m = self._z_m
        if self._hold_z_m is None:
            return self._throttle(estimate, 0.0, dt_s)
        return self.to_height(estimate, self._hold_z_m, dt_s)

    def _throttle(self, estimate: Estimate, down_m_s: float, dt_s: float) -> float:
        step = self._parameters.metres("WPNAV_ACCEL_Z") * dt_s
        change = max(-step, min(step, down_m_s - self._down_m_s))
        self._down_m_s += change
        z_m, speed = estimate.pos_ned_m[2], estimate.vel_ned_m_s[2]
        self._z_m = max(z_m - LEASH_M, min(z_m + LEASH_M, self._z_m + self._down_m_s * dt_s))
        wanted = self._down_m_s + self._parameters.real("PSC_POSZ_P") * (self._z_m - z_m)
        error = wanted - speed
        if not estimate.on_ground and abs(error) < 1.0:
            summed = self._integral_m_s2[2] + Z_I_1_S2 * error * dt_s
            self._integral_m_s2[2] = max(-Z_I_MAX_M_S2, min(Z_I_MAX_M_S2, summed))
        acc_d = change / dt_s + self._parameters.real("PSC_VELZ_P") * error + self._integral_m_s2[2]
        acc_d = max(-UP_MAX_M_S2, min(DOWN_MAX_M_S2, acc_d))
        return min(1.0, self.hover_01 * (1.0 - acc_d / GRAVITY_M_S2))

    # --- horizontal: attitude (4,) wxyz ---

    def hold(self, estimate: Estimate, dt_s: float) -> Array:
        """Return the attitude that brakes, latches the position and holds it."""
        x_m, y_m, _ = estimate.pos_ned_m
        self._stop = None
        if self._hold_xy_m is None and math.hypot(*estimate.vel_ned_m_s[:2]) < HOLD_SPEED_M_S:
            self._hold_xy_m = x_m, y_m
        if self._hold_xy_m is None:
            return self._steer(estimate, 0.0, 0.0, dt_s)
        return self._toward(estimate, self._hold_xy_m, dt_s)

    def stop(self, estimate: Estimate, brake_m_s2: float, dt_s: float) -> Array:
        """Return the attitude that brings the vehicle to rest as BRAKE and LAND do, at that much at most."""
        if self._stop is None:
            return self.hold(estimate, dt_s)
        return self._lean(estimate, self._stop.accel_m_s2(estimate, brake_m_s2, dt_s), self._tilt_m_s2(), dt_s)

    def go_to(self, estimate: Estimate, xy_m: tuple[float, float], dt_s: float) -> Array:
        """Return the attitude that flies to a place, which is held from then on."""
        self._hold_xy_m, self._stop = xy_m, None
        return self._toward(estimate, xy_m, dt_s)

    def _toward(self, estimate: Estimate, xy_m: tuple[float, float], dt_s: float) -> Array:
        north, east = xy_m[0] - estimate.pos_ned_m[0], xy_m[1] - estimate.pos_ned_m[1]
        distance, gain = math.hypot(north, east), self._parameters.real("PSC_POSXY_P")
        acc = 0.5 * self._parameters.metres("WPNAV_ACCEL")
        near = acc / gain**2
        speed = gain * distance if distance < near else math.sqrt(acc * (2 * distance - near))
        scale = min(self._parameters.metres("WPNAV_SPEED"), speed) / distance if distance > 0 else 0.0
        return self._steer(estimate, scale * north, scale * east, dt_s)

    def _steer(self, estimate: Estimate, north_m_s: float, east_m_s: float, dt_s: float) -> Array:
        gain, gain_i = self._parameters.real("PSC_VELXY_P"), self._parameters.real("PSC_VELXY_I")
        error = north_m_s - estimate.vel_ned_m_s[0], east_m_s - estimate.vel_ned_m_s[1]
        for axis in (0, 1):
            if not estimate.on_ground and abs(error[axis]) < 1.0:
                summed = self._integral_m_s2[axis] + gain_i * error[axis] * dt_s
                self._integral_m_s2[axis] = max(-XY_I_MAX_M_S2, min(XY_I_MAX_M_S2, summed))
        acc = gain * error[0] + self._integral_m_s2[0], gain * error[1] + self._integral_m_s2[1]
        return self._lean(estimate, acc, min(self._parameters.metres("WPNAV_ACCEL"), self._tilt_m_s2()), dt_s)

    def _tilt_m_s2(self) -> float:
        """Return the level acceleration at the largest tilt."""
        return GRAVITY_M_S2 * math.tan(math.radians(0.01 * self._parameters.real("ANGLE_MAX")))

    def _lean(self, estimate: Estimate, acc_m_s2: Xy, most_m_s2: float, dt_s: float) -> Array:
        acc = (0.0, 0.0) if estimate.on_ground else limited(*acc_m_s2, most_m_s2)
        change = limited(acc[0] - self._acc_m_s2[0], acc[1] - self._acc_m_s2[1], JERK_MAX_M_S3 * dt_s)
        self._acc_m_s2 = [self._acc_m_s2[0] + change[0], self._acc_m_s2[1] + change[1]]
        return attitude_for((self._acc_m_s2[0], self._acc_m_s2[1], 0.0), self._yaw_rad)
