"""Where a vehicle's own local origin lies in the swarm's frame, and whether a position fits what was known before.

Every autopilot counts from where its own estimator began, and may move that origin in flight. Positions and origin come
in separate messages in either order, so that for a moment they do not belong together. And an estimator may jump, to
what is right or to what is wrong: then its position has moved, but the vehicle has not.

A position that no flight can explain is therefore bridged: what it is off by is taken from it, so that the vehicle
stays where it was and nobody flies across the difference. A newly told origin explains it and ends the bridge. Else
the vehicle may be at either place: `margin_m` is what has to be kept clear of around it. A short bridge is drawn in
slowly once positions have been steady for a while. A long one stays until the estimate jumps back or the vehicle has
landed: nobody can tell which place is right, and only to go on as before puts nobody in danger who was not before.
"""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np
import pymap3d

from swarmctl.core.types import MAX_RADIUS_M, Array, GeoOrigin

_SAME_M = 0.02  # GPS_GLOBAL_ORIGIN counts in 1e-7 degrees, 11 mm
_JUMP_M = 0.3  # estimators that are corrected step by less
_RESET_M = 0.02  # of a step that the estimator itself tells of
_ACCEL_M_S2 = 10.0  # no vehicle leaves its velocity faster
_LEEWAY_S = 0.5  # nor for longer without a sample between
_FORGET_S = 1.0  # a position this old predicts nothing
_ASKED_US = 500_000  # for the origin, after which it is taken not to have moved
_STEADY_US = 3_000_000  # of positions after a jump, before they are believed
_DRAW_IN_M_S = 0.3  # how fast a bridge shortens: what a vehicle is moved by it
_SHORT_M = 1.0  # a margin that peers can give and fly on; drawn in, 5 m ended in a collision in truth
_WIDEN_M_S = 2.0  # how fast the margin grows: others can make room so fast
_NARROW_M_S = 0.5
_NEAR_US = 100_000  # a geodetic and a local position of one moment
_FALLBACK_US = 3_000_000  # without GPS_GLOBAL_ORIGIN for so long, the origin is worked out from positions
_FALLBACK_POINTS = 9
_NOTHING = np.zeros(3)


class LocalFrame:
    """One vehicle's origin.

    Args:
        shared: origin of the swarm's frame.

    Attributes:
        offset_ned_m: (3,) local origin in the shared frame; None while unknown.
        bridge_ned_m: (3,) added to positions since they have jumped.
        margin_m: by how much the vehicle may be elsewhere than its position says, because of a jump.
        jump_m: size of the newest jump.
        invalid: positions that were not believed, by reason.
        jumps: how often the estimate has jumped.
    """

    bridge_ned_m: Array
    margin_m: float
    _unexplained: bool  # bridged, and nobody has said yet whether the origin has moved
    _jumped_us: int

    def __init__(self, shared: GeoOrigin) -> None:
        self._shared = shared
        self.offset_ned_m: Array | None = None
        self.invalid: Counter[str] = Counter()
        self.jumps = 0
        self.jump_m = 0.0
        self._moved_to: Array | None = None  # (3,) told, but positions do not fit it yet
        self._last: tuple[int, Array, Array] | None = None  # time, shared position and velocity of the last one
        self._guesses: deque[Array] = deque(maxlen=_FALLBACK_POINTS)
        self._guessing_us: int | None = None
        self._settle()

    @property
    def wants_origin(self) -> bool:
        """Whether GPS_GLOBAL_ORIGIN would help now."""
        return self.offset_ned_m is None or self._unexplained

    def forget(self) -> None:
        """The vehicle has rebooted: it counts from somewhere else."""
        self.offset_ned_m = self._moved_to = self._last = self._guessing_us = None
        self._guesses.clear()
        self._settle()

    def told(self, origin: GeoOrigin) -> None:
        """GPS_GLOBAL_ORIGIN."""
        offset_ned_m = self._in_shared(origin)
        if self.offset_ned_m is None:
            self.offset_ned_m = offset_ned_m
        elif math.dist(offset_ned_m, self.offset_ned_m) > _SAME_M:
            self._moved_to = offset_ned_m
        else:
            self._moved_to = None
            self.jumps += self._unexplained  # the frame is the same: it is the estimate that has jumped
            self._unexplained = False

    def seen(self, place: GeoOrigin, t_us: int, local_us: int, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        """A geodetic position at `t_us`, beside the newest local one at `local_us`: all there is without an origin."""
        if self.offset_ned_m is not None or abs(t_us - local_us) > _NEAR_US:
            return
        self._guessing_us = t_us if self._guessing_us is None else self._guessing_us
        self._guesses.append(self._in_shared(place) - pos_ned_m - vel_ned_m_s * ((t_us - local_us) * 1e-6))
        if t_us - self._guessing_us > _FALLBACK_US and len(self._guesses) == _FALLBACK_POINTS:
            self.offset_ned_m = np.median(np.stack(self._guesses), axis=0)

    def place(self, t_us: int, pos_ned_m: Array, vel_ned_m_s: Array, armed: bool, reset: bool = False) -> Array | None:
        """Position (3,) in the shared frame of a local one, or None while it can't be told.

        Args:
            t_us: time of the sample; any clock that does not jump.
            pos_ned_m, vel_ned_m_s: (3,) local.
            armed: on the ground, disarmed, an estimator may still be settling: everything is believed.
            reset: the estimator itself says that it has moved its position, by whatever it may be.
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
            self._fit(t_us, pos_ned_m, self._last[1] + self._last[2] * since_s, since_s, reset)
        elif self._moved_to is not None:
            self._take_origin()
        placed: Array = pos_ned_m + self.offset_ned_m + self.bridge_ned_m
        self._last = (t_us, placed, vel_ned_m_s)
        return placed

    def _fit(self, t_us: int, pos_ned_m: Array, expected_ned_m: Array, since_s: float, reset: bool) -> None:
        """Take the explanation that brings a local position to where it is expected; without one, bridge it."""
        assert self.offset_ned_m is not None
        step_m = _RESET_M if reset else _JUMP_M
        leeway_m = step_m + 0.5 * _ACCEL_M_S2 * min(since_s, _LEEWAY_S) ** 2
        missing_ned_m = expected_ned_m - pos_ned_m - self.offset_ned_m
        missed_m = math.dist(missing_ned_m, self.bridge_ned_m)
        if self._moved_to is not None:
            moved_m = math.dist(pos_ned_m + self._moved_to, expected_ned_m)
            if moved_m < leeway_m and (self._unexplained or moved_m < missed_m):
                self._take_origin()
                return
        if missed_m < leeway_m:
            return
        self.bridge_ned_m, self._jumped_us = missing_ned_m, t_us
        self.jump_m = math.sqrt(float(missing_ned_m @ missing_ned_m))
        self._unexplained = not reset and self.jump_m >= step_m  # else it has jumped back
        self.jumps += reset

    def _draw_in(self, t_us: int, since_s: float) -> None:
        """Widen or narrow the margin, and shorten a short bridge once positions have been steady."""
        left_m = math.sqrt(float(self.bridge_ned_m @ self.bridge_ned_m))
        if self._unexplained and t_us - self._jumped_us > _ASKED_US:  # nobody tells of an origin that has moved
            self._unexplained = False
            self.jumps += 1
        wanted_m = min(self.jump_m, MAX_RADIUS_M) if left_m and not self._unexplained else 0.0
        widest_m, least_m = self.margin_m + _WIDEN_M_S * since_s, self.margin_m - _NARROW_M_S * since_s
        self.margin_m = max(min(wanted_m, widest_m), least_m)
        if left_m and self.jump_m <= _SHORT_M and t_us - self._jumped_us > _STEADY_US:
            self.bridge_ned_m = self.bridge_ned_m * max(0.0, 1.0 - _DRAW_IN_M_S * since_s / left_m)

    def _take_origin(self) -> None:
        """The origin has moved, and positions with it: what was told last holds, and there was no jump."""
        if self._moved_to is not None:
            self.offset_ned_m, self._moved_to = self._moved_to, None
            self.bridge_ned_m, self._unexplained = _NOTHING, False

    def _settle(self) -> None:
        self.bridge_ned_m, self.margin_m = _NOTHING, 0.0
        self._unexplained, self._jumped_us = False, 0

    def _in_shared(self, place: GeoOrigin) -> Array:
        shared = self._shared
        ned = pymap3d.geodetic2ned(
            place.lat_deg, place.lon_deg, place.alt_m, shared.lat_deg, shared.lon_deg, shared.alt_m
        )
        return np.array(ned, dtype=float)
