"""The way to rest that PX4's AUTO modes fly from a velocity: straight ahead, with limited jerk, to a point.

The point is chosen as the mode begins, as far ahead as PX4's navigator takes the vehicle to need. The acceleration
along the path begins at zero, whatever the vehicle's is, and what is left of the way limits the speed: the vehicle
slows down within two seconds, and creeps to the point after that.
"""

from __future__ import annotations

import math

Xy = tuple[float, float]

VEL_D_01 = 0.2  # MPC_XY_VEL_D_ACC
_FILTER_1_S = 2.0 * math.pi * 5.0  # MPC_VELD_LP
DELAY_01 = 0.6  # of MPC_JERK_AUTO: the acceleration that is taken to be late, over the jerk
ARRIVED_M_S = 0.02


class StopPath:
    """The path of one stop, advanced every tick.

    Args:
        pos_m, vel_m_s: (north, east) where it begins.
        brake_m_s2: MPC_ACC_HOR.
        jerk_m_s3: MPC_JERK_AUTO.
    """

    def __init__(self, pos_m: Xy, vel_m_s: Xy, brake_m_s2: float, jerk_m_s3: float) -> None:
        self._begin_m = pos_m
        self._speed_m_s = math.hypot(*vel_m_s)
        self._ahead = vel_m_s[0] / self._speed_m_s, vel_m_s[1] / self._speed_m_s
        self._brake_m_s2, self._jerk_m_s3 = max(0.1, brake_m_s2), max(0.1, jerk_m_s3)
        self._length_m = self._speed_m_s * (0.5 * self._speed_m_s / self._brake_m_s2 + DELAY_01)
        self._way_m = self._accel_m_s2 = 0.0
        self._seen_m_s, self._seen_m_s2 = vel_m_s, (0.0, 0.0)

    @property
    def end_m(self) -> Xy:
        """Where the vehicle is to rest, (north, east)."""
        return self._at(self._length_m)

    @property
    def arrived(self) -> bool:
        """Whether the path has come to rest."""
        return self._speed_m_s < ARRIVED_M_S

    def advance(self, dt_s: float) -> tuple[Xy, Xy, Xy]:
        """Return position, velocity and acceleration (north, east) after one tick more."""
        self._way_m += self._speed_m_s * dt_s + 0.5 * self._accel_m_s2 * dt_s**2
        self._speed_m_s = max(0.0, self._speed_m_s + self._accel_m_s2 * dt_s)
        missing = self._allowed_m_s() - self._speed_m_s
        size = min(self._brake_m_s2, math.sqrt(2.0 * self._jerk_m_s3 * abs(missing)), 0.5 * abs(missing) / dt_s)
        change = math.copysign(size, missing) - self._accel_m_s2
        step = self._jerk_m_s3 * dt_s
        self._accel_m_s2 += max(-step, min(step, change))
        return self._at(self._way_m), self._along(self._speed_m_s), self._along(self._accel_m_s2)

    def damping_m_s2(self, vel_m_s: Xy, dt_s: float) -> Xy:
        """Return what PX4 takes from the acceleration (north, east) that it asks for, as its velocity changes."""
        share = min(1.0, _FILTER_1_S * dt_s)
        north, east = (
            kept + share * ((now - before) / dt_s - kept)
            for now, before, kept in zip(vel_m_s, self._seen_m_s, self._seen_m_s2, strict=True)
        )
        self._seen_m_s, self._seen_m_s2 = vel_m_s, (north, east)
        return VEL_D_01 * north, VEL_D_01 * east

    def _allowed_m_s(self) -> float:
        """Return the speed from which the rest of the way suffices for braking, with jerk, twice as late as needed."""
        left_m = max(0.0, self._length_m - self._way_m)
        late = 4.0 * self._brake_m_s2**2 / self._jerk_m_s3
        return 0.5 * (math.sqrt(late**2 + 8.0 * self._brake_m_s2 * left_m) - late)

    def _at(self, way_m: float) -> Xy:
        return self._begin_m[0] + way_m * self._ahead[0], self._begin_m[1] + way_m * self._ahead[1]

    def _along(self, size: float) -> Xy:
        return size * self._ahead[0], size * self._ahead[1]
