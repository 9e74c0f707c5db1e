"""What peers out of reach are told: a path now and then, and at once where it changes how far the vehicle may get."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.core.types import PredictedPath

UNTOLD_MARGIN_M = 0.1  # by which a vehicle's margin may grow before those out of reach are told
_FASTER_01 = 1.1


def speed_bound_m_s(path: PredictedPath, params: PathSharingParams) -> float:
    """Return the speed [m/s] that a vehicle keeps to, as far as all know who have this path of it.

    It is `speed_m_s`, or a tenth more than the largest speed along the path, so that one that accelerates does not tell
    all in every tick.
    """
    return max(params.speed_m_s, _FASTER_01 * _fastest_m_s(path))


def _fastest_m_s(path: PredictedPath) -> float:
    steps_m = path.pos_ned_m[1:] - path.pos_ned_m[:-1]
    return math.sqrt(float(np.einsum("kc,kc->k", steps_m, steps_m).max())) / (path.dt_us * 1e-6)


class FarPaths:
    """Chooses the paths that all hear: `far_hz` a second, and each that those out of reach could not have counted on.

    Args:
        params: see there.

    Attributes:
        told_m_s: speed that the own vehicle keeps to, as all have been told; 0 where nobody is out of reach.
    """

    def __init__(self, params: PathSharingParams) -> None:
        self._params = params
        self._due_us = 0
        self.told_m_s = self._told_margin_m = 0.0

    def include(self, path: PredictedPath, now_us: int) -> bool:
        """Return whether all hear the path of this tick."""
        if not self._params.far_hz:
            return False
        is_as_told = path.margin_m <= self._told_margin_m + UNTOLD_MARGIN_M and _fastest_m_s(path) <= self.told_m_s
        if is_as_told and now_us < self._due_us:
            return False
        self._due_us = now_us + round(1e6 / self._params.far_hz)
        self.told_m_s, self._told_margin_m = speed_bound_m_s(path, self._params), path.margin_m
        return True
