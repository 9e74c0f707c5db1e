"""How the autopilot itself flies: hold, take off, land, go home. P on position, PID on velocity -> attitude and thrust.

Scalar code at autopilot rate for one vehicle; local NED. It knows the true hover thrust, as an autopilot's hover-thrust
estimator does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sitl.parameters import Parameters
from sitl.sensors import Estimate
from sitl.vehicle import Array
from swarmctl.core.frames import GRAVITY_M_S2, quat_from_body_z

VEL_P_1_S = 1.8  # MPC_XY_VEL_P_ACC
VEL_I_1_S2 = 0.4
Z_VEL_P_1_S = 4.0  # MPC_Z_VEL_P_ACC
Z_VEL_I_1_S2 = 2.0
ACC_MAX_M_S2 = 3.0  # MPC_ACC_HOR: also how hard it brakes
ACC_UP_MAX_M_S2 = 4.0
ACC_DOWN_MAX_M_S2 = 3.0
JERK_MAX_M_S3 = 20.0  # 0.4 m/s2, 2.3 deg a tick: the thesis' attitude loop follows ramps, not jumps
HOLD_SPEED_M_S = 0.3  # slower than this, the position is latched
HOME_REACHED_M = 0.5
THRUST_MIN_01 = 0.06


@dataclass(frozen=True, slots=True)
class Command:
    """Attitude (4,) wxyz and collective thrust of one tick."""

    q_nb: Array
    thrust_01: float


class Navigator:
    """Position controller of one vehicle; `engage` at every entry to an AUTO mode, then `fly` every tick."""

    def __init__(self, parameters: Parameters, hover_thrust_01: float) -> None:
        self._parameters = parameters
        self._hover_01 = hover_thrust_01
        self._yaw_rad = 0.0
        self._hold_xy_m: tuple[float, float] | None = None
        self._hold_z_m: float | None = None
        self._integral_m_s2 = [0.0, 0.0, 0.0]
        self._acc_m_s2 = [0.0, 0.0]

    def engage(self, estimate: Estimate, *, fresh: bool) -> None:
        """Brake, then hold where that ends. `fresh`: forget the integrals too (the last flight was not ours)."""
        self._yaw_rad = estimate.yaw_rad
        self._hold_xy_m = self._hold_z_m = None
        if fresh:
            self._integral_m_s2 = [0.0, 0.0, 0.0]
            down = estimate.down_axis_ned
            self._acc_m_s2 = [-GRAVITY_M_S2 * down[0], -GRAVITY_M_S2 * down[1]]

    def keep_height(self, z_ned_m: float) -> None:
        """Hold at this height instead of where braking ends."""
        self._hold_z_m = z_ned_m

    def hold(self, estimate: Estimate, dt_s: float) -> Command:
        """LOITER: brake, latch the position, keep it."""
        if self._hold_z_m is None and abs(estimate.vel_ned_m_s[2]) < HOLD_SPEED_M_S:
            self._hold_z_m = estimate.pos_ned_m[2]
        return self._fly(estimate, self._speed_z(estimate, self._hold_z_m), dt_s)

    def climb_to(self, estimate: Estimate, z_ned_m: float, dt_s: float) -> Command:
        """Climb (or sink) to a height above where the climb began."""
        if self._hold_xy_m is None:
            self._hold_xy_m = estimate.pos_ned_m[0], estimate.pos_ned_m[1]
        self._hold_z_m = z_ned_m
        return self._fly(estimate, self._speed_z(estimate, z_ned_m), dt_s)

    def descend(self, estimate: Estimate, dt_s: float) -> Command:
        """LAND: brake horizontally and go down at MPC_LAND_SPEED."""
        self._hold_z_m = None
        return self._fly(estimate, self._parameters.real("MPC_LAND_SPEED"), dt_s)

    def go_home(self, estimate: Estimate, home_xy_m: tuple[float, float], dt_s: float) -> Command | None:
        """RTL at the present height; None once above home."""
        x_m, y_m, _ = estimate.pos_ned_m
        if math.hypot(x_m - home_xy_m[0], y_m - home_xy_m[1]) < HOME_REACHED_M:
            return None
        if self._hold_z_m is None:
            self._hold_z_m = estimate.pos_ned_m[2]
        self._hold_xy_m = home_xy_m
        return self._fly(estimate, self._speed_z(estimate, self._hold_z_m), dt_s)

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
        return _limited(north, east, self._parameters.real("MPC_XY_CRUISE"))

    def _fly(self, estimate: Estimate, speed_z_m_s: float, dt_s: float) -> Command:
        north, east = self._speed_xy(estimate)
        errors = tuple(
            s - v for s, v in zip((north, east, speed_z_m_s), estimate.vel_ned_m_s, strict=True)
        )  # velocity, NED
        for axis, (gain, limit) in enumerate(((VEL_I_1_S2, 2.0), (VEL_I_1_S2, 2.0), (Z_VEL_I_1_S2, 3.0))):
            if not estimate.on_ground and abs(errors[axis]) < 1.0:
                summed = self._integral_m_s2[axis] + gain * errors[axis] * dt_s
                self._integral_m_s2[axis] = max(-limit, min(limit, summed))
        i_north, i_east, i_down = self._integral_m_s2
        acc_n, acc_e = _limited(VEL_P_1_S * errors[0] + i_north, VEL_P_1_S * errors[1] + i_east, ACC_MAX_M_S2)
        acc_d = max(-ACC_UP_MAX_M_S2, min(ACC_DOWN_MAX_M_S2, Z_VEL_P_1_S * errors[2] + i_down))
        return self._aim(estimate, acc_n, acc_e, acc_d, dt_s)

    def _aim(self, estimate: Estimate, acc_n: float, acc_e: float, acc_d: float, dt_s: float) -> Command:
        if estimate.on_ground:
            acc_n = acc_e = 0.0
        step = JERK_MAX_M_S3 * dt_s
        d_n, d_e = _limited(acc_n - self._acc_m_s2[0], acc_e - self._acc_m_s2[1], step)
        self._acc_m_s2 = [self._acc_m_s2[0] + d_n, self._acc_m_s2[1] + d_e]
        down = np.array([-self._acc_m_s2[0], -self._acc_m_s2[1], GRAVITY_M_S2 - acc_d])
        down /= math.sqrt(float(down @ down))
        upright = max(0.5, estimate.down_axis_ned[2])
        thrust = self._hover_01 * (1.0 - acc_d / GRAVITY_M_S2) / upright
        ceiling = self._parameters.real("MPC_THR_MAX")
        return Command(quat_from_body_z(down, self._yaw_rad), max(THRUST_MIN_01, min(ceiling, thrust)))


def _limited(north: float, east: float, limit: float) -> tuple[float, float]:
    size = math.hypot(north, east)
    if size <= limit:
        return north, east
    return north * limit / size, east * limit / size
