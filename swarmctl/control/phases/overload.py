"""Whether an agent still keeps its deadlines, and what follows when it does not.

Pure. Every protection counts on setpoints that leave in time and on plans made from what is true now. An agent whose
processor is too slow widens what it keeps clear of and asks its peers to; then it comes to rest; then it lands.
"""

from __future__ import annotations

import enum
from collections import deque

from pydantic import Field

from swarmctl.core.params import Params


class OverloadParams(Params):
    """Shares of missed deadlines, each over `window_s`."""

    window_s: float = Field(2.0, gt=0, le=60)
    widen_01: float = Field(0.15, gt=0, le=1)  # from here on distances grow
    margin_max_m: float = Field(0.2, ge=0, le=10)  # by so much where the agent comes to rest
    hold_01: float = Field(0.4, gt=0, le=1)  # from here on it comes to rest
    clear_01: float = Field(0.2, ge=0, le=1)  # below, it goes on
    land_after_s: float = Field(10.0, gt=0, le=600)  # of holding for this reason


class Level(enum.IntEnum):
    """What missed deadlines ask for."""

    NONE = 0
    WIDEN = 1
    HOLD = 2
    LAND = 3


class Overload:
    """Share of deadlines missed, and what it asks for.

    Attributes:
        level: what is to be done now.
        missed_01: share of deadlines missed in the window.
    """

    def __init__(self, params: OverloadParams, period_us: int) -> None:
        self._params, self._period_us = params, period_us
        self._seen: deque[tuple[int, int]] = deque()  # time, deadlines missed so far
        self._holds_since_us: int | None = None
        self.level, self.missed_01 = Level.NONE, 0.0

    @property
    def margin_m(self) -> float:
        """What to add to every distance: from 0 at `widen_01` to `margin_max_m` at `hold_01`."""
        p = self._params
        if self.level is Level.NONE:
            return 0.0
        excess_01 = (self.missed_01 - p.widen_01) / max(1e-9, p.hold_01 - p.widen_01)
        return p.margin_max_m * min(1.0, max(0.0, excess_01))

    def text(self) -> str:
        """The cause in words."""
        return f"overload: {100.0 * self.missed_01:.0f} % of deadlines missed"

    def update(self, now_us: int, missed: int) -> None:
        """Take in the deadlines missed so far, at monotonic `now_us`."""
        p = self._params
        self._seen.append((now_us, missed))
        while len(self._seen) > 2 and now_us - self._seen[1][0] >= p.window_s * 1e6:
            self._seen.popleft()
        since_us, before = self._seen[0]
        due = max(p.window_s * 1e6, now_us - since_us) / self._period_us
        self.missed_01 = min(1.0, (missed - before) / due)
        if self.missed_01 >= p.hold_01 and self._holds_since_us is None:
            self._holds_since_us = now_us
        elif self.missed_01 < p.clear_01:
            self._holds_since_us = None
        if self._holds_since_us is None:
            self.level = Level.WIDEN if self.missed_01 >= p.widen_01 else Level.NONE
        else:
            lands = now_us - self._holds_since_us > p.land_after_s * 1e6
            self.level = Level.LAND if lands else Level.HOLD
