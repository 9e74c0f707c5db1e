"""Body-rate setpoints beside the attitude loops: flown instead of an attitude, or as feed-forward to one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sitl.plant.vehicle import Mask
from swarmctl.core.types import Array

_INTEGRAL_1_S = 1.5  # of the rate loop, over its proportional gain
_WINDUP_RAD_S = 1.0


class RateLoop:
    """PI loops on body rates of the vehicles that fly rates; without cost while none does.

    Attributes:
        feeding: some vehicle has a feed-forward.
        feed_rad_s: (3, N) body rates to add to those of the attitude loop.
    """

    def __init__(self, gain_nm_s: Array, vehicles: int, dt_s: float) -> None:
        """Set `gain_nm_s` (3, 1), torque over rate error."""
        self._gain_nm_s = gain_nm_s
        self._dt_s = dt_s
        self._wanted_rad_s = np.zeros((3, vehicles))  # NaN: that axis is uncontrolled
        self._integral_rad = np.zeros((3, vehicles))
        self._on: Mask = np.zeros(vehicles, dtype=bool)
        self._active = False
        self.feeding = False
        self.feed_rad_s = np.zeros((3, vehicles))

    def set(self, vehicle: int, rate_frd_rad_s: Sequence[float] | None, feed_frd_rad_s: Sequence[float] | None) -> None:
        """Set the setpoint of one vehicle: rates to fly, or None for its attitude; and a feed-forward."""
        if rate_frd_rad_s is not None:
            if not self._on[vehicle]:
                self._integral_rad[:, vehicle] = 0.0
            self._wanted_rad_s[:, vehicle] = [r if math.isfinite(r) else math.nan for r in rate_frd_rad_s]
        self._on[vehicle] = rate_frd_rad_s is not None
        self._active = bool(self._on.any())
        self.feed_rad_s[:, vehicle] = feed_frd_rad_s or 0.0
        self.feeding = bool(self.feed_rad_s.any())

    def overrule(self, rate_frd_rad_s: Array, live: Array | None, out: Array) -> None:
        """Replace the torques (3, N) in `out` of vehicles that fly rates; `live` as of `AttitudeLoop.torque`."""
        if not self._active:
            return
        on = self._on
        share = 1.0 if live is None else live[on]
        error = np.nan_to_num(self._wanted_rad_s[:, on] - rate_frd_rad_s[:, on])
        summed = self._integral_rad[:, on] + _INTEGRAL_1_S * self._dt_s * error
        summed = np.clip(summed, -_WINDUP_RAD_S, _WINDUP_RAD_S) * share
        self._integral_rad[:, on] = summed
        out[:, on] = self._gain_nm_s * (error + summed) * share
