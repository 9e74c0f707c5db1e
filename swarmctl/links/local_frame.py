"""Where a vehicle's own local origin lies in the swarm's frame, and whether a position fits what was known before.

Every autopilot counts from where its own estimator began, and may move that origin in flight. Positions and origin come
in separate messages in either order, so that for a moment they do not belong together: then there is no position.
"""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np
import pymap3d

from swarmctl.core.types import Array, GeoOrigin

_SAME_M = 0.02  # GPS_GLOBAL_ORIGIN counts in 1e-7 degrees, 11 mm
_JUMP_M = 1.0
_ACCEL_M_S2 = 10.0  # no vehicle leaves its velocity faster
_LEEWAY_S = 0.5  # nor for longer without a sample between
_FORGET_US = 1_000_000  # a position this old predicts nothing
_PATIENCE_US = 2_000_000  # then a position that fits nothing is the new one
_NEAR_US = 100_000  # a geodetic and a local position of one moment
_FALLBACK_US = 3_000_000  # without GPS_GLOBAL_ORIGIN for so long, the origin is worked out from positions
_FALLBACK_POINTS = 9


class LocalFrame:
    """One vehicle's origin.

    Args:
        shared: origin of the swarm's frame.

    Attributes:
        offset_ned_m: (3,) local origin in the shared frame; None while unknown.
        invalid: positions that were not believed, by reason.
        jumps: positions that were believed although nothing led there.
    """

    def __init__(self, shared: GeoOrigin) -> None:
        self._shared = shared
        self.offset_ned_m: Array | None = None
        self.invalid: Counter[str] = Counter()
        self.jumps = 0
        self._moved_to: Array | None = None  # (3,) told, but positions do not fit it yet
        self._last: tuple[int, Array, Array] | None = None  # time, shared position and velocity of the last good one
        self._lost_us: int | None = None  # since when positions fit nothing
        self._guesses: deque[Array] = deque(maxlen=_FALLBACK_POINTS)
        self._guessing_us: int | None = None

    @property
    def wants_origin(self) -> bool:
        """Whether GPS_GLOBAL_ORIGIN would help now."""
        return self.offset_ned_m is None or self._lost_us is not None

    def forget(self) -> None:
        """The vehicle has rebooted: it counts from somewhere else."""
        self.offset_ned_m = self._moved_to = self._last = self._lost_us = self._guessing_us = None
        self._guesses.clear()

    def told(self, origin: GeoOrigin) -> None:
        """GPS_GLOBAL_ORIGIN."""
        offset_ned_m = self._in_shared(origin)
        if self.offset_ned_m is None:
            self.offset_ned_m = offset_ned_m
        elif math.dist(offset_ned_m, self.offset_ned_m) > _SAME_M:
            self._moved_to = offset_ned_m
        elif self._lost_us is not None:  # the frame is the same: it is the estimate that has jumped
            self._last = self._lost_us = None
            self.jumps += 1

    def seen(self, place: GeoOrigin, t_us: int, local_us: int, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        """A geodetic position at `t_us`, beside the newest local one at `local_us`: all there is without an origin."""
        if self.offset_ned_m is not None or abs(t_us - local_us) > _NEAR_US:
            return
        self._guessing_us = t_us if self._guessing_us is None else self._guessing_us
        self._guesses.append(self._in_shared(place) - pos_ned_m - vel_ned_m_s * ((t_us - local_us) * 1e-6))
        if t_us - self._guessing_us > _FALLBACK_US and len(self._guesses) == _FALLBACK_POINTS:
            self.offset_ned_m = np.median(np.stack(self._guesses), axis=0)

    def place(self, t_us: int, pos_ned_m: Array, vel_ned_m_s: Array, armed: bool) -> Array | None:
        """Position (3,) in the shared frame of a local one, or None while it can't be told.

        Args:
            t_us: time of the sample; any clock that does not jump.
            pos_ned_m, vel_ned_m_s: (3,) local.
            armed: on the ground, disarmed, an estimator may still be settling: everything is believed.
        """
        if self.offset_ned_m is None:
            self.invalid["no origin"] += 1
            return None
        offset_ned_m = self._fitting(t_us, pos_ned_m) if armed else self._moved_to
        if offset_ned_m is None and armed and not self._lost_for_long(t_us):
            self.invalid["position jumped" if self._moved_to is None else "origin moved"] += 1
            return None
        if offset_ned_m is None:
            self.jumps += armed
            offset_ned_m = self.offset_ned_m if self._moved_to is None else self._moved_to
        if offset_ned_m is self._moved_to:
            self._moved_to = None
        self.offset_ned_m, self._lost_us = offset_ned_m, None
        placed: Array = pos_ned_m + offset_ned_m
        self._last = (t_us, placed, vel_ned_m_s)
        return placed

    def _fitting(self, t_us: int, pos_ned_m: Array) -> Array | None:
        """The origin, old or newly told, with which a local position is where it is expected; None when neither is."""
        assert self.offset_ned_m is not None
        if self._last is None or not 0 <= t_us - self._last[0] < _FORGET_US:
            return self._moved_to if self._moved_to is not None or self._lost_us is not None else self.offset_ned_m
        offsets = [self.offset_ned_m] if self._moved_to is None else [self.offset_ned_m, self._moved_to]
        since_s = (t_us - self._last[0]) * 1e-6
        expected = self._last[1] + self._last[2] * since_s
        leeway_m = _JUMP_M + 0.5 * _ACCEL_M_S2 * min(since_s, _LEEWAY_S) ** 2
        missed_m, best = min((math.dist(pos_ned_m + offset, expected), k) for k, offset in enumerate(offsets))
        return offsets[best] if missed_m < leeway_m else None

    def _lost_for_long(self, t_us: int) -> bool:
        """Whether nothing has fitted for so long that the newest has to be believed."""
        self._lost_us = t_us if self._lost_us is None else self._lost_us
        return t_us - self._lost_us > _PATIENCE_US

    def _in_shared(self, place: GeoOrigin) -> Array:
        shared = self._shared
        ned = pymap3d.geodetic2ned(
            place.lat_deg, place.lon_deg, place.alt_m, shared.lat_deg, shared.lon_deg, shared.alt_m
        )
        return np.array(ned, dtype=float)
