"""The way to a reference from far away: no faster than the vehicle may fly, and can stop from.

A controller that minimises distances flies to a reference 60 m away as fast as it can, however slow the reference is,
and brakes when its horizon reaches there: 16 m too late at 12 m/s. To one that is 20 m below it falls, braked by no
more than what thrust is left beside its weight.
"""

from __future__ import annotations

import math

import numpy as np

from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array

_FAR_S = 0.8  # at the largest speed: what is nearer is braked for
_LEAST_SINK_M_S = 0.3  # however little thrust is left
_OF_BRAKING = 0.85  # share of the largest deceleration with which speeds fall on the way
_BRAKED_IN_TIME = 3.0  # times `_FAR_S` of deceleration: the most speed from which plans stop by themselves
_LEAST_BRAKED_S = 1.2  # of deceleration: what is as near is reached as weights have it, as in the thesis
_OF_STOPPING = 0.85  # share of the speed from which plans brake too late
_NEARLY = 0.9  # share of the speed on the way from which on it is told


class Approach:
    """Limits how a reference is approached.

    Args:
        mpc: parameters of the controller that follows it.
        vehicle: bounds of the airframe.
        plans: whether that controller plans by them. Others brake by the distance that is left, which has to be told.
    """

    def __init__(self, mpc: MpcParams, vehicle: VehicleModelParams, *, plans: bool) -> None:
        accel_max_m_s2 = mpc.accel_max_m_s2(vehicle)
        self._speed_max_m_s, self._brake_m_s2 = vehicle.speed_max_m_s, _OF_BRAKING * accel_max_m_s2
        self._sink_max_m_s = max(_LEAST_SINK_M_S, _FAR_S * (mpc.most_thrust_m_s2(vehicle) - GRAVITY_M_S2))
        horizon_s = min(_FAR_S, mpc.horizon_xy * mpc.dt_s)
        by_weights_s = max(_LEAST_BRAKED_S, _OF_STOPPING * _stopped_s(mpc, horizon_s))
        near_s = min(_BRAKED_IN_TIME * horizon_s, by_weights_s)
        self._near_m_s = accel_max_m_s2 * near_s
        self._near_m = 0.5 * self._near_m_s * near_s / _OF_BRAKING if plans else math.inf

    def reference(
        self, pos_ned_m: Array, vel_ned_m_s: Array, ahead_s: Array, *, own_ned_m: Array, own_ned_m_s: Array
    ) -> tuple[Array, Array]:
        """Return a reference, positions and velocities (N, 3) each; of a far one what can be reached by then.

        The rest is replaced by the straight way there at the largest speed: a vehicle that already flies as fast is
        then on its reference. Downwards that is what thrust stops in half of the way of `_FAR_S`. A vehicle that comes
        closer so fast that it could hardly stop is told to brake.

        Args:
            pos_ned_m, vel_ned_m_s: reference (N, 3).
            ahead_s: (N,) times of it from now, >= 0.
            own_ned_m, own_ned_m_s: where the vehicle is now, and its velocity (3,).
        """
        way_ned_m = pos_ned_m - own_ned_m
        far_m, down_m = np.sqrt((way_ned_m * way_ned_m).sum(axis=1)), way_ned_m[:, 2]
        if far_m[0] > self._near_m:
            away_m, direction = float(far_m[0]), way_ned_m[0] / far_m[0]
            stops_m_s = math.sqrt(self._near_m_s**2 + 2.0 * self._brake_m_s2 * (away_m - self._near_m))
            if float((own_ned_m_s - vel_ned_m_s[0]) @ direction) > _NEARLY * stops_m_s:
                closing_m_s = min(stops_m_s, self._faster_m_s(vel_ned_m_s[0], direction))
                left_m, slower_m_s = self._braking(ahead_s, away_m, closing_m_s)
                return pos_ned_m - left_m[:, None] * direction, vel_ned_m_s + slower_m_s[:, None] * direction
        ahead_or_near_s = np.maximum(ahead_s, _FAR_S)
        if (far_m <= self._speed_max_m_s * ahead_or_near_s).all() and (
            down_m <= self._sink_max_m_s * ahead_or_near_s
        ).all():
            return pos_ned_m, vel_ned_m_s
        least_s = np.maximum(far_m / self._speed_max_m_s, down_m / self._sink_max_m_s)  # that the way takes
        beyond = least_s > ahead_s
        pos, vel = pos_ned_m.copy(), vel_ned_m_s.copy()
        vel[beyond] = way_ned_m[beyond] / least_s[beyond, None]
        pos[beyond] = own_ned_m + vel[beyond] * ahead_s[beyond, None]
        return pos, vel

    def _faster_m_s(self, vel_ned_m_s: Array, direction: Array) -> float:
        """Return by how much a vehicle may be faster, in a direction (3,), than a reference with a velocity (3,)."""
        down = float(direction[2])
        sinks_m_s = (self._sink_max_m_s - float(vel_ned_m_s[2])) / down if down > 0.0 else math.inf
        return max(0.0, min(self._speed_max_m_s - float(vel_ned_m_s @ direction), sinks_m_s))

    def _braking(self, ahead_s: Array, away_m: float, closing_m_s: float) -> tuple[Array, Array]:
        """Return the distance [m] and the closing speed [m/s] (N,) that are left of these while a vehicle brakes."""
        braked_s = np.minimum(ahead_s, closing_m_s / self._brake_m_s2)
        left_m = away_m - (closing_m_s - 0.5 * self._brake_m_s2 * braked_s) * braked_s
        return left_m, closing_m_s - self._brake_m_s2 * braked_s


def _stopped_s(mpc: MpcParams, horizon_s: float) -> float:
    """Return the longest time of full braking that plans begin by themselves where it has to begin.

    Of plans that brake by a for their horizon T, from a distance d at a speed v, the cheapest has, by the weights q of
    distance and speed (r aside), a (q_pos T^5 / 20 + q_vel T^3 / 3) = q_vel v T^2 / 2 + q_pos (v T^4 / 8 - d T^3 / 6).
    With v = a s and d = v^2 / 2a, s is the larger root of s^2 / 2 - b s + c = 0.
    """
    slows = min(weights.q_vel / weights.q_pos for weights in (mpc.x, mpc.y))
    b, c = 0.75 * horizon_s + 3.0 * slows / horizon_s, 0.3 * horizon_s**2 + 2.0 * slows
    return b + math.sqrt(max(0.0, b * b - 2.0 * c))  # no root: plans always brake a little too late
