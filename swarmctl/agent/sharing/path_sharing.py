"""Which predicted paths are published: all, or those that peers could not have told from the one they have."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydantic import Field

from swarmctl.bus.messages.path_messages import decode_path, encode_path
from swarmctl.control.collision.separation import SeparationParams, align
from swarmctl.core.params import Params
from swarmctl.core.types import MAX_MARGIN_M, PredictedPath


class PathSharingParams(Params):
    """Sets when predicted paths are shared, and in how many bytes."""

    error_m: float = Field(0.0, ge=0, le=0.5)  # by which peers' copy of the path may be off now; 0: share every tick
    heartbeat_s: float = Field(0.1, gt=0, le=0.25)  # peers' copy is never older; they widen distances with its age
    far_hz: float = Field(0.0, ge=0, le=25)  # rate heard of peers out of reach, 0.5 or more; 0: all paths are heard
    speed_m_s: float = Field(3.0, gt=0, le=50)  # that those out of reach count on; faster ones tell them at once
    compact: bool = False  # a third of the bytes, for radio links: points are rounded, by less than a millimetre

    def longest_s(self, rate_hz: float) -> float:
        """Return how long the paths of an agent are apart at most, at this tick rate."""
        return max(1.0 / rate_hz, self.heartbeat_s if self.error_m else 0.0)


class _Shared(NamedTuple):
    """A path that was published."""

    known: PredictedPath  # as it is read from its bytes
    margin_m: float  # without what was added to it


class PathSharing:
    """Chooses the paths to publish by what peers make of those that were (event-triggered sharing).

    A peer interpolates a path and continues it by braking, as `align` does. A new path is published

    1. when it differs from the newest published one by more than `error_m + a t^2 / 2` at the time t ahead;
    2. when it differs from the one before by more than that and `a A^2 / 2`, where A is the age of that one: whoever
       has missed the newest one still has it, and keeps that much more. So a path that was published because it was
       new is published again in the next tick, unless the one before would do;
    3. when its margin has changed, or after `heartbeat_s`.

    The acceleration a is that by which peers widen distances with the age of a path (`age_accel_m_s2`). Paths are
    compared as peers read them, with what compact points are rounded by. What is published has `error_m` more margin.
    What the last setpoint asks for is not compared: peers know it as of the newest path that they have.

    Args:
        params: see there.
        separation: how peers continue a path, and widen distances with its age.
    """

    def __init__(self, params: PathSharingParams, separation: SeparationParams) -> None:
        self._params, self._separation = params, separation
        self._newest: _Shared | None = None
        self._before: _Shared | None = None  # what peers have that missed the newest one

    def message(self, path: PredictedPath, *, for_all: bool = False) -> bytes | None:
        """Return the message to publish in this tick, or None when peers need none.

        Args:
            path: of this tick.
            for_all: whether those out of reach hear it, too: there always is a message then, and it is compact.
        """
        if not (for_all or self._is_due(path)):
            return None
        margin_m = min(MAX_MARGIN_M, path.margin_m + self._params.error_m)
        wider = path if margin_m == path.margin_m else replace(path, margin_m=margin_m)
        payload = encode_path(wider, compact=for_all or self._params.compact)
        if self._params.error_m:
            known = decode_path(payload)  # None: faster than peers believe
            self._newest, self._before = None if known is None else _Shared(known, path.margin_m), self._newest
        return payload

    def _is_due(self, path: PredictedPath) -> bool:
        newest, before = self._newest, self._before
        if newest is None or path.margin_m != newest.margin_m:
            return True
        age_us = path.t0_utc_us - newest.known.t0_utc_us
        if not 0 <= age_us < self._params.heartbeat_s * 1e6 or self._differs(path, newest.known, 0.0):
            return True
        if before is None:
            return False
        age_s = max(0.0, (path.t0_utc_us - before.known.t0_utc_us) * 1e-6)
        kept_m = self._separation.budget.age_margin_m(age_s, parked=False)
        return path.margin_m > before.margin_m or self._differs(path, before.known, kept_m)

    def _differs(self, path: PredictedPath, known: PredictedPath, kept_m: float) -> bool:
        """Return whether a path differs from a published one by more than is allowed, and peers keep because of age."""
        brake_m_s2, accel_m_s2 = self._separation.brake_m_s2, self._separation.age_accel_m_s2
        expected = align(known, path.t0_utc_us, path.dt_us, len(path.pos_ned_m) - 1, brake_m_s2=brake_m_s2)
        ahead_s = np.arange(len(expected)) * (path.dt_us * 1e-6)
        error_m = np.linalg.norm(path.pos_ned_m - expected, axis=1)
        return bool((error_m > self._params.error_m + kept_m + 0.5 * accel_m_s2 * ahead_s**2).any())
