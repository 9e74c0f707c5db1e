"""The margin that peers have to keep while the wind on a vehicle changes faster than its plans expect. Pure.

Plans take the estimated disturbance for constant. While a gust grows, each of them is a little wrong in the same
direction, and no certificate sees it, because every plan is right about the gust so far.
"""

from __future__ import annotations

import math
from collections import deque

from swarmctl.core.types import Array

_WINDOW_US = 400_000  # over which a change counts
_USUAL_M_S2 = 0.5  # change in calm air, of an estimate that settles; no margin is kept for it
_AHEAD_S = 0.7  # time until neighbours meet, for which the change goes on
_MOST_M = 0.5
_FORGOTTEN_S = 1.0  # time constant with which a margin shrinks again


class GustWatch:
    """Watches the estimated disturbance of one vehicle.

    Attributes:
        margin_m: by how much peers have to keep more from the newest path.
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[int, float, float]] = deque()  # time, north, east
        self.margin_m = 0.0

    def update(self, now_us: int, disturbance_ned_m_s2: Array) -> None:
        """Take in the newest estimate (3,), by which the vehicle is flown."""
        north, east = disturbance_ned_m_s2[:2].tolist()
        if self._recent:
            self.margin_m *= math.exp(-1e-6 * (now_us - self._recent[-1][0]) / _FORGOTTEN_S)
        self._recent.append((now_us, north, east))
        while now_us - self._recent[0][0] > _WINDOW_US:
            self._recent.popleft()
        change_m_s2 = math.hypot(north - self._recent[0][1], east - self._recent[0][2]) - _USUAL_M_S2
        self.margin_m = max(self.margin_m, min(_MOST_M, 0.5 * change_m_s2 * _AHEAD_S**2))

    def forget(self) -> None:
        """Begin anew: the vehicle is not flown by plans, or its estimate began anew."""
        self._recent.clear()
        self.margin_m = 0.0
