"""Position control of the autopilot itself: hold, climb, go to, descend. P on position, PID on velocity.

Scalar code at autopilot rate for one vehicle; local NED; the output is attitude and thrust. It knows the true hover
thrust, as an autopilot's hover-thrust estimator does. Limits are parameters and act at once.
"""

from __future__ import annotations

import math

from sitl.acceleration import attitude_for, limited
from sitl.plant.sensors import Estimate
from sitl.px4.parameters import Parameters
from sitl.px4.stop_path import StopPath, Xy
from sitl.vehicle_parts import Command
from swarmctl.core.frames import GRAVITY_M_S2

VEL_P_1_S = 1.8  # MPC_XY_VEL_P_ACC
VEL_I_1_S2 = 0.4
Z_VEL_P_1_S = 4.0  # MPC_Z_VEL_P_ACC
Z_VEL_I_1_S2 = 2.0
ACC_MAX_M_S2 = 2.2  # on the way to a place; to rest it follows a `StopPath`
ACC_UP_MAX_M_S2 = 4.0
ACC_DOWN_MAX_M_S2 = 3.0
JERK_MAX_M_S3 = 20.0  # 0.4 m/s2, 2.3 deg a tick: the thesis' attitude loop follows ramps, not jumps
HOLD_SPEED_M_S = 0.3  # below this speed the position is latched
THRUST_MIN_01 = 0.06
CLIMB_FAST_ABOVE_M, CLIMB_GAIN = 25.0, 0.6  # fitted: 2.5 m in 7.8 s after arming, 30 m in 20-22 s
SLOW_BELOW_M, FAST_ABOVE_M = 5.0, 10.0  # MPC_LAND_ALT2, MPC_LAND_ALT1: between them vertical speed limits blend
_NAN = math.nan
Triple = tuple[float, float, float]


class Navigator:
    """Position controller of one vehicle; `engage` at every entry to an AUTO mode, then fly every tick."""

    def __init__(self, parameters: Parameters, hover_thrust_01: float) -> None:
        self.hover_01 = hover_thrust_01
        self.speed_m_s: float | None = None  # of DO_CHANGE_SPEED, instead of MPC_XY_CRUISE
        self._parameters = parameters
        self._yaw_rad = 0.0
        self._hold_xy_m: Xy | None = None
        self._stop: StopPath | None = None
        self._hold_z_m: float | None = None
        self._integral_m_s2 = [0.0, 0.0, 0.0]
        self._acc_m_s2 = [0.0, 0.0]
        self._speed_ned_m_s: Triple = (0.0, 0.0, 0.0)

    def engage(self, estimate: Estimate, *, fresh: bool) -> None:
        """Brake, then hold where that ends. `fresh`: reset the integrals too (another controller flew before)."""
        self._yaw_rad = estimate.yaw_rad
        self._hold_xy_m = self._hold_z_m = self._stop = None
        if math.hypot(*estimate.vel_ned_m_s[:2]) > HOLD_SPEED_M_S:
            limits = self._parameters.real("MPC_ACC_HOR"), self._parameters.real("MPC_JERK_AUTO")
            self._stop = StopPath(estimate.pos_ned_m[:2], estimate.vel_ned_m_s[:2], *limits)
        if fresh:
            self._integral_m_s2 = [0.0, 0.0, 0.0]
            down = estimate.down_axis_ned
            self._acc_m_s2 = [-GRAVITY_M_S2 * down[0], -GRAVITY_M_S2 * down[1]]

    def target(self) -> tuple[float, ...]:
        """Setpoints (11,) of position, velocity and acceleration NED, yaw, yaw rate; NaN: none."""
        x_m, y_m = self._hold_xy_m or (_NAN, _NAN)
        z_m = _NAN if self._hold_z_m is None else self._hold_z_m
        return x_m, y_m, z_m, *self._speed_ned_m_s, *self._acc_m_s2, _NAN, self._yaw_rad, _NAN

    def keep_height(self, z_ned_m: float) -> None:
        """Hold this height instead of the one where braking ends."""
        self._hold_z_m = z_ned_m

    def set_yaw(self, yaw_rad: float) -> None:
        """Turn the nose to a yaw; NaN leaves it."""
        if math.isfinite(yaw_rad):
            self._yaw_rad = yaw_rad

    def hold(self, estimate: Estimate, dt_s: float) -> Command:
        """Fly LOITER: brake, latch the position, hold it."""
        if self._hold_z_m is None and abs(estimate.vel_ned_m_s[2]) < HOLD_SPEED_M_S:
            self._hold_z_m = estimate.pos_ned_m[2]
        return self._fly(estimate, self._speed_z(estimate, self._hold_z_m), dt_s)

    def climb_to(
        self, estimate: Estimate, z_ned_m: float, ground_z_m: float, ramp_01: float, *, dt_s: float
    ) -> Command:
        """Take off to a height above the begin of the climb, slowly near the ground; `ramp_01` scales the speed."""
        if self._hold_xy_m is None:
            self._hold_xy_m = estimate.pos_ned_m[0], estimate.pos_ned_m[1]
        self._hold_z_m = z_ned_m
        fast = self._parameters.real("MPC_Z_VEL_MAX_UP")
        slow = min(fast, self._parameters.real("MPC_TKO_SPEED"))
        limit = ramp_01 * _blend(ground_z_m - estimate.pos_ned_m[2], slow, fast, CLIMB_FAST_ABOVE_M)
        wanted = CLIMB_GAIN * self._parameters.real("MPC_Z_P") * (z_ned_m - estimate.pos_ned_m[2])
        return self._fly(estimate, max(-limit, min(slow, wanted)), dt_s)

    def go_to(self, estimate: Estimate, xy_m: tuple[float, float], z_ned_m: float, dt_s: float) -> Command:
        """Fly straight to a point."""
        self._hold_xy_m, self._hold_z_m = xy_m, z_ned_m
        return self._fly(estimate, self._speed_z(estimate, z_ned_m), dt_s)

    def descend(
        self, estimate: Estimate, ground_z_m: float, dt_s: float, xy_m: tuple[float, float] | None = None
    ) -> Command:
        """Fly LAND where braking ends, or at `xy_m`: fast above `FAST_ABOVE_M`, MPC_LAND_SPEED near the ground."""
        if xy_m is not None:
            self._hold_xy_m = xy_m
        self._hold_z_m = None
        slow = self._parameters.real("MPC_LAND_SPEED")
        fast = max(slow, self._parameters.real("MPC_Z_VEL_MAX_DN"))
        return self._fly(estimate, _blend(ground_z_m - estimate.pos_ned_m[2], slow, fast), dt_s)

    def descend_blind(self, estimate: Estimate, dt_s: float) -> Command:
        """Descend without a position: level, at MPC_LAND_SPEED, drifting with the wind."""
        self._hold_xy_m = self._hold_z_m = self._stop = None
        sink = self._parameters.real("MPC_LAND_SPEED")
        self._speed_ned_m_s = 0.0, 0.0, sink
        acc_d = self._acc_down(estimate, sink, dt_s)
        return self._aim(estimate, 0.0, 0.0, acc_d, dt_s=dt_s)

    def _speed_z(self, estimate: Estimate, target_z_m: float | None) -> float:
        if target_z_m is None:
            return 0.0
        wanted = self._parameters.real("MPC_Z_P") * (target_z_m - estimate.pos_ned_m[2])
        up, down = self._parameters.real("MPC_Z_VEL_MAX_UP"), self._parameters.real("MPC_Z_VEL_MAX_DN")
        return max(-up, min(down, wanted))

    def _speed_xy(self, estimate: Estimate) -> tuple[float, float]:
        x_m, y_m, _ = estimate.pos_ned_m
        if self._hold_xy_m is None:
            if math.hypot(*estimate.vel_ned_m_s[:2]) > HOLD_SPEED_M_S:
                return 0.0, 0.0
            self._hold_xy_m = x_m, y_m
        gain = self._parameters.real("MPC_XY_P")
        north, east = gain * (self._hold_xy_m[0] - x_m), gain * (self._hold_xy_m[1] - y_m)
        cruise = self._parameters.real("MPC_XY_CRUISE") if self.speed_m_s is None else self.speed_m_s
        return limited(north, east, max(0.0, min(cruise, self._parameters.real("MPC_XY_VEL_MAX"))))

    def _fly(self, estimate: Estimate, speed_z_m_s: float, dt_s: float) -> Command:
        if self._stop is not None and self._hold_xy_m is None:
            acc_n, acc_e = self._brake(self._stop, estimate, speed_z_m_s, dt_s)
        else:
            wanted = self._speed_xy(estimate)
            self._speed_ned_m_s = *wanted, speed_z_m_s
            acc_n, acc_e = limited(*self._toward(estimate, wanted, dt_s), ACC_MAX_M_S2)
        return self._aim(estimate, acc_n, acc_e, self._acc_down(estimate, speed_z_m_s, dt_s), dt_s=dt_s)

    def _brake(self, stop: StopPath, estimate: Estimate, speed_z_m_s: float, dt_s: float) -> Xy:
        """Return the acceleration (north, east) that follows a way to rest, whose end is held from then on."""
        pos_m, vel_m_s, acc_m_s2 = stop.advance(dt_s)
        if stop.arrived:
            self._hold_xy_m = stop.end_m
        gain = self._parameters.real("MPC_XY_P")
        north, east = (vel_m_s[axis] + gain * (pos_m[axis] - estimate.pos_ned_m[axis]) for axis in (0, 1))
        self._speed_ned_m_s = north, east, speed_z_m_s
        acc_n, acc_e = self._toward(estimate, (north, east), dt_s)
        less_n, less_e = stop.damping_m_s2(estimate.vel_ned_m_s[:2], dt_s)
        return acc_n + acc_m_s2[0] - less_n, acc_e + acc_m_s2[1] - less_e

    def _toward(self, estimate: Estimate, wanted_m_s: Xy, dt_s: float) -> Xy:
        """Return the acceleration (north, east) towards a velocity."""
        acc: list[float] = []
        for axis in (0, 1):
            error = wanted_m_s[axis] - estimate.vel_ned_m_s[axis]
            acc.append(VEL_P_1_S * error + self._summed(estimate, axis, VEL_I_1_S2, 2.0, error=error, dt_s=dt_s))
        return acc[0], acc[1]

    def _acc_down(self, estimate: Estimate, speed_z_m_s: float, dt_s: float) -> float:
        error = speed_z_m_s - estimate.vel_ned_m_s[2]
        summed = self._summed(estimate, 2, Z_VEL_I_1_S2, 3.0, error=error, dt_s=dt_s)
        return max(-ACC_UP_MAX_M_S2, min(ACC_DOWN_MAX_M_S2, Z_VEL_P_1_S * error + summed))

    def _summed(self, estimate: Estimate, axis: int, gain: float, limit: float, *, error: float, dt_s: float) -> float:
        """Return the velocity-error integral; frozen while the error is large, and on the ground except to take off."""
        leaving = axis == 2 and error < 0.0
        if (leaving or not estimate.on_ground) and abs(error) < 1.0:
            summed = self._integral_m_s2[axis] + gain * error * dt_s
            self._integral_m_s2[axis] = max(-limit, min(limit, summed))
        return self._integral_m_s2[axis]

    def _aim(self, estimate: Estimate, acc_n: float, acc_e: float, acc_d: float, *, dt_s: float) -> Command:
        if estimate.on_ground:
            acc_n = acc_e = 0.0
        step = JERK_MAX_M_S3 * dt_s
        d_n, d_e = limited(acc_n - self._acc_m_s2[0], acc_e - self._acc_m_s2[1], step)
        tilt_rad = math.radians(max(1.0, min(85.0, self._parameters.real("MPC_TILTMAX_AIR"))))
        level = (GRAVITY_M_S2 - acc_d) * math.tan(tilt_rad)  # horizontal acceleration at this tilt
        self._acc_m_s2 = list(limited(self._acc_m_s2[0] + d_n, self._acc_m_s2[1] + d_e, level))
        cos_tilt = max(0.5, estimate.down_axis_ned[2])
        thrust = self.hover_01 * (1.0 - acc_d / GRAVITY_M_S2) / cos_tilt
        ceiling = self._parameters.real("MPC_THR_MAX")
        floor = min(self._parameters.real("MPC_THR_MIN"), ceiling) if not estimate.on_ground else THRUST_MIN_01
        q_nb = attitude_for((self._acc_m_s2[0], self._acc_m_s2[1], acc_d), self._yaw_rad)
        return Command(q_nb=q_nb, thrust_01=max(0.0, min(1.0, ceiling, max(floor, thrust))))


def _blend(height_m: float, slow: float, fast: float, fast_above_m: float = FAST_ABOVE_M) -> float:
    share = (height_m - SLOW_BELOW_M) / (fast_above_m - SLOW_BELOW_M)
    return slow + (fast - slow) * max(0.0, min(1.0, share))
