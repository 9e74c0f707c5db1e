"""Which predicted paths are published: all, or those that peers could not have told from the one they have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field

from swarmctl.control.collision.separation import SeparationParams, align
from swarmctl.core.params import Params
from swarmctl.core.types import MAX_MARGIN_M, PredictedPath


class PathSharingParams(Params):
    """Sets when predicted paths are shared, and in how many bytes."""

    error_m: float = Field(0.0, ge=0, le=0.5)  # by which peers' copy of the path may be off now; 0: share every tick
    heartbeat_s: float = Field(0.1, gt=0, le=0.25)  # peers' copy is never older; they widen distances with its age
    far_hz: float = Field(0.0, ge=0, le=25)  # rate heard of peers out of reach, 5 or more; 0: all paths are heard
    compact: bool = False  # a third of the bytes, for radio links: points are rounded, by less than a millimetre


class PathSharing:
    """Chooses the paths to publish by what peers make of the newest one that was (event-triggered sharing).

    A peer interpolates a path and continues it by braking, as `align` does. A new path is published when it differs
    from that by more than `error_m + a t^2 / 2` at the time t ahead, when its margin has changed, or after
    `heartbeat_s`; a is the acceleration by which peers widen distances with the age of a path (`age_accel_m_s2`). What
    is published has `error_m` more margin.

    Args:
        params: see there.
        separation: how peers continue a path, and widen distances with its age.
    """

    def __init__(self, params: PathSharingParams, separation: SeparationParams) -> None:
        self._params, self._separation = params, separation
        self._shared: PredictedPath | None = None  # as predicted, without the margin for what is not published

    def choose(self, path: PredictedPath, *, always: bool = False) -> PredictedPath | None:
        """Return the path to publish in this tick, or None when peers need none, unless there `always` is one."""
        if not (always or self._is_due(path)):
            return None
        self._shared = path
        margin_m = min(MAX_MARGIN_M, path.margin_m + self._params.error_m)
        return path if margin_m == path.margin_m else replace(path, margin_m=margin_m)

    def _is_due(self, path: PredictedPath) -> bool:
        shared = self._shared
        if shared is None or not self._params.error_m or path.margin_m != shared.margin_m:
            return True
        age_us = path.t0_utc_us - shared.t0_utc_us
        return not 0 <= age_us < self._params.heartbeat_s * 1e6 or self._differs(path, shared)

    def _differs(self, path: PredictedPath, shared: PredictedPath) -> bool:
        brake_m_s2, accel_m_s2 = self._separation.brake_m_s2, self._separation.age_accel_m_s2
        known = align(shared, path.t0_utc_us, path.dt_us, len(path.pos_ned_m) - 1, brake_m_s2=brake_m_s2)
        ahead_s = np.arange(len(known)) * (path.dt_us * 1e-6)
        error_m = np.linalg.norm(path.pos_ned_m - known, axis=1)
        return bool((error_m > self._params.error_m + 0.5 * accel_m_s2 * ahead_s**2).any())
