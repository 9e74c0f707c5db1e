"""Position of a vehicle's local origin in the shared frame, and the test of positions against earlier ones.

Every autopilot counts from the point at which its estimator began, and may move that origin in flight. Positions and
origin arrive in separate messages, in either order, so that for a moment they do not belong together. The estimate may
also jump, towards the truth or away from it: then the position has moved but the vehicle has not.

A position that no flight can explain is bridged: the difference is subtracted, so that the vehicle keeps its place and
no agent flies across the difference. A newly reported origin explains the difference and ends the bridge. Otherwise the
vehicle may be at either place, and `margin_m` is the extra distance to keep from it. A short bridge is drawn in slowly
once positions have been steady. A long bridge stays until the estimate jumps back or the vehicle has landed: which
place is right can't be known, and to continue as before endangers no vehicle that was safe. For the same reason the
margin outlasts a bridge that was drawn in, unless the estimator itself reports that it has corrected its position.
"""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np
import pymap3d

from swarmctl.core.types import MAX_MARGIN_M, Array, GeoOrigin

_SAME_M = 0.02  # resolution of GPS_GLOBAL_ORIGIN: 1e-7 degrees, 11 mm
_JUMP_M = 0.3  # smaller steps are corrections of the estimator
_RESET_M = 0.02  # smallest step that counts when the estimator itself reports a reset
_ACCEL_M_S2 = 10.0  # largest acceleration of a vehicle
_LEEWAY_S = 0.5  # largest time without a sample for which that acceleration is assumed
_FORGET_S = 1.0  # an older position predicts nothing
_ASKED_US = 500_000  # wait for the origin; after it the origin is taken as unmoved
_STEADY_US = 3_000_000  # positions must be steady for this long after a jump to be believed
_DRAW_IN_M_S = 0.3  # speed at which a bridge shortens, and the vehicle is moved by it
_SHORT_M = 1.0  # longest bridge that is drawn in: peers can give this margin; drawing in 5 m has ended in a collision
_WIDEN_M_S = 2.0  # growth of the margin: peers can make room at this speed
_NARROW_M_S = 0.5
_NEAR_US = 100_000  # largest time between a geodetic and a local position of one moment
_FALLBACK_US = 3_000_000  # after this long without GPS_GLOBAL_ORIGIN the origin is computed from positions
_FALLBACK_POINTS = 9
_NOTHING = np.zeros(3)


class LocalFrame:
    """Tracks the origin of one vehicle's local frame.

    Args:
        shared: origin of the shared frame.

    Attributes:
        offset_ned_m: (3,) local origin in the shared frame; None while unknown.
        bridge_ned_m: (3,) correction added to positions since the newest jump.
        drawn_ned_m: (3,) what has been drawn in of bridges over jumps that the estimator itself has not reported.
        margin_m: distance by which the vehicle may be away from its reported position, because of a jump.
        jump_m: size of the newest jump.
        invalid: number of positions that were not believed, by reason.
        jumps: number of jumps of the estimate.
    """

    bridge_ned_m: Array
    drawn_ned_m: Array
    margin_m: float
    _is_reset: bool  # the estimator itself has reported the newest jump
    _may_have_moved: bool  # bridged, and not yet known whether the origin has moved
    _jumped_us: int

    def __init__(self, shared: GeoOrigin) -> None:
        self._shared = shared
        self.offset_ned_m: Array | None = None
        self.invalid: Counter[str] = Counter()
        self.jumps = 0
        self.jump_m = 0.0
        self._moved_to: Array | None = None  # (3,) reported origin that positions do not fit yet
        self._last: tuple[int, Array, Array] | None = None  # time, shared position and velocity of the newest sample
        self._guesses: deque[Array] = deque(maxlen=_FALLBACK_POINTS)
        self._guessing_us: int | None = None
        self._settle()

    @property
    def wants_origin(self) -> bool:
        """Whether GPS_GLOBAL_ORIGIN should be requested now."""
        return self.offset_ned_m is None or self._may_have_moved

    @property
    def _unexplained(self) -> bool:
        """Whether that jump is of the origin or of the estimate: a reset is of the estimate, and counted already."""
        return self._may_have_moved and not self._is_reset

    def forget(self) -> None:
        """Discard the origin: the vehicle has rebooted and counts from another point."""
        self.offset_ned_m = self._moved_to = self._last = self._guessing_us = None
        self._guesses.clear()
        self._settle()

    def told(self, origin: GeoOrigin) -> None:
        """Take a GPS_GLOBAL_ORIGIN."""
        offset_ned_m = self._in_shared(origin)
        if self.offset_ned_m is None:
            self.offset_ned_m = offset_ned_m
        elif math.dist(offset_ned_m, self.offset_ned_m) > _SAME_M:
            self._moved_to = offset_ned_m
        else:
            self._moved_to = None
            self.jumps += self._unexplained  # the frame is unchanged, so the estimate has jumped
            self._may_have_moved = False

    def seen(self, place: GeoOrigin, t_us: int, local_us: int, pos_ned_m: Array, *, vel_ned_m_s: Array) -> None:
        """Take a geodetic position at `t_us` beside the newest local one at `local_us`: the fallback for the origin."""
        if self.offset_ned_m is not None or abs(t_us - local_us) > _NEAR_US:
            return
        self._guessing_us = t_us if self._guessing_us is None else self._guessing_us
        self._guesses.append(self._in_shared(place) - pos_ned_m - vel_ned_m_s * ((t_us - local_us) * 1e-6))
        if t_us - self._guessing_us > _FALLBACK_US and len(self._guesses) == _FALLBACK_POINTS:
            self.offset_ned_m = np.median(np.stack(self._guesses), axis=0)

    def place(
        self, t_us: int, pos_ned_m: Array, vel_ned_m_s: Array, armed: bool, *, reset: bool = False
    ) -> Array | None:
        """Return the shared position (3,) of a local one, or None while it can't be known.

        Args:
            t_us: time of the sample, on a clock without jumps.
            pos_ned_m, vel_ned_m_s: (3,) in the local frame.
            armed: False: the estimator may still be settling on the ground, so every position is believed.
            reset: the estimator itself reports that it has moved its position.
        """
        if self.offset_ned_m is None:
            self.invalid["no origin"] += 1
            return None
        since_s = -1.0 if self._last is None else (t_us - self._last[0]) * 1e-6
        if not armed:
            self._take_origin()
            self._settle()
        elif self._last is not None and 0.0 <= since_s < _FORGET_S:
            self._draw_in(t_us, since_s)
            self._fit(t_us, pos_ned_m, self._last[1] + self._last[2] * since_s, since_s, reset=reset)
        elif self._moved_to is not None:
            self._take_origin()
        placed: Array = pos_ned_m + self.offset_ned_m + self.bridge_ned_m
        self._last = (t_us, placed, vel_ned_m_s)
        return placed

    def _fit(self, t_us: int, pos_ned_m: Array, expected_ned_m: Array, since_s: float, *, reset: bool) -> None:
        """Apply the origin that brings a local position to its expected place; without one, bridge the difference."""
        assert self.offset_ned_m is not None
        step_m = _RESET_M if reset else _JUMP_M
        leeway_m = step_m + 0.5 * _ACCEL_M_S2 * min(since_s, _LEEWAY_S) ** 2
        missing_ned_m = expected_ned_m - pos_ned_m - self.offset_ned_m
        missed_m = math.dist(missing_ned_m.tolist(), self.bridge_ned_m.tolist())
        if self._moved_to is not None:
            moved_m = math.dist(pos_ned_m + self._moved_to, expected_ned_m)
            if moved_m < leeway_m and (self._may_have_moved or moved_m < missed_m):
                self._take_origin()
                return
        if missed_m < leeway_m:
            return
        self.bridge_ned_m, self._jumped_us, self._is_reset = missing_ned_m, t_us, reset
        self.jump_m = math.sqrt(float(missing_ned_m @ missing_ned_m))
        self._may_have_moved = self.jump_m >= step_m  # otherwise it has jumped back
        self.jumps += reset

    def _draw_in(self, t_us: int, since_s: float) -> None:
        """Adapt the margin, and shorten a short bridge once positions have been steady."""
        bridge_ned_m = self.bridge_ned_m
        left_m = 0.0 if bridge_ned_m is _NOTHING else math.sqrt(float(bridge_ned_m @ bridge_ned_m))
        if t_us - self._jumped_us > _ASKED_US:  # no moved origin has been reported
            self.jumps += self._unexplained
            self._may_have_moved = False
        doubted_m = self.jump_m if left_m else 0.0
        if self.drawn_ned_m is not _NOTHING:
            doubted_m = math.dist((bridge_ned_m + self.drawn_ned_m).tolist(), (0.0, 0.0, 0.0))
        wanted_m = 0.0 if self._unexplained or doubted_m < _SAME_M else min(doubted_m, MAX_MARGIN_M)
        widest_m, least_m = self.margin_m + _WIDEN_M_S * since_s, self.margin_m - _NARROW_M_S * since_s
        self.margin_m = max(min(wanted_m, widest_m), least_m)
        if left_m and self.jump_m <= _SHORT_M and t_us - self._jumped_us > _STEADY_US:
            self.bridge_ned_m = bridge_ned_m * max(0.0, 1.0 - _DRAW_IN_M_S * since_s / left_m)
            if not self._is_reset:
                self.drawn_ned_m = self.drawn_ned_m + bridge_ned_m - self.bridge_ned_m

    def _take_origin(self) -> None:
        """Adopt a moved origin: positions have moved with it, and there was no jump."""
        if self._moved_to is not None:
            self.offset_ned_m, self._moved_to = self._moved_to, None
            self.bridge_ned_m, self._may_have_moved = _NOTHING, False

    def _settle(self) -> None:
        self.bridge_ned_m, self.drawn_ned_m, self.margin_m = _NOTHING, _NOTHING, 0.0
        self._is_reset, self._may_have_moved, self._jumped_us = False, False, 0

    def _in_shared(self, place: GeoOrigin) -> Array:
        shared = self._shared
        ned = pymap3d.geodetic2ned(
            place.lat_deg, place.lon_deg, place.alt_m, shared.lat_deg, shared.lon_deg, shared.alt_m
        )
        return np.array(ned, dtype=float)
