"""Monitors missed deadlines and decides on the response: wider distances, hold, land.

Pure. Every protection relies on setpoints that leave in time and on plans made from fresh states. An agent whose
processor is too slow first widens its own and its peers' distances, then comes to rest, then lands.
"""

from __future__ import annotations

import enum
from collections import deque

from pydantic import Field

from swarmctl.core.params import Params

_TOLD_MARGIN_M = 0.02  # a smaller growth of distances after a stall is not worth an alert
_LOST_PART = 0.5  # of the time without setpoints that missed deadlines must explain
_OVER_01 = 0.67  # of `widen_01`, below which wider distances are over; between both they grow by nothing
_TOLD_WITHIN_US = 3_000_000  # a HEARTBEAT a second tells the mode, and some are lost


class OverloadParams(Params):
    """Thresholds on the fraction of deadlines missed within `window_s`, and what follows from stalls."""

    window_s: float = Field(2.0, gt=0, le=60)  # time over which missed deadlines are counted
    widen_01: float = Field(0.15, gt=0, le=1)  # above this fraction distances grow
    margin_max_m: float = Field(0.2, ge=0, le=10)  # growth of distances at `hold_01`
    hold_01: float = Field(0.4, gt=0, le=1)  # from this fraction on the agent comes to rest
    clear_01: float = Field(0.2, gt=0, le=1)  # below this fraction a resting agent goes on, and one that waits is armed
    land_after_s: float = Field(10.0, gt=0, le=600)  # longest hold for this reason; then land
    stall_memory_s: float = Field(30.0, ge=0, le=3600)  # time for which distances stay grown after a stall
    stall_accel_m_s2: float = Field(4.0, ge=0, le=50)  # growth a t^2 / 2 after a stall of t
    stall_margin_max_m: float = Field(0.5, ge=0, le=10)  # largest such growth


class Level(enum.IntEnum):
    """Response to missed deadlines, in increasing order."""

    NONE = 0
    WIDEN = 1
    HOLD = 2
    LAND = 3


class SetpointStops:
    """Tells when setpoints stopped because deadlines were missed: the autopilot takes the vehicle back then.

    Without this an overload looks like a pilot's takeover. A stop is remembered for as long as an autopilot may take to
    tell its new mode.

    Args:
        period_us: period of the ticks.
    """

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._ticked_us: int | None = None
        self._sent_us: int | None = None
        self._missed = self._missed_at_sent = 0
        self._text, self._until_us = "", 0

    @property
    def has_sent(self) -> bool:
        """Return whether a setpoint has left in the newest tick."""
        return self._sent_us is not None and self._sent_us == self._ticked_us

    def update(self, now_us: int, missed: int, loss_s: float) -> None:
        """Begin a tick.

        Args:
            now_us: monotonic time.
            missed: deadlines missed so far; those since the last tick may not be counted yet.
            loss_s: time without setpoints after which the autopilot takes over.
        """
        skipped = 0 if self._ticked_us is None else max(0, (now_us - self._ticked_us) // self._period_us - 1)
        self._ticked_us, self._missed = now_us, missed
        if self._sent_us is None:
            return
        stopped_us = now_us - self._sent_us
        lost = max(missed - self._missed_at_sent, skipped)
        if stopped_us > loss_s * 1e6 and lost * self._period_us > _LOST_PART * stopped_us:
            counts = f"{lost} deadline misses, {self._missed_at_sent + lost} since the start"
            self._text = f"overload: setpoints stopped {stopped_us * 1e-6:.1f} s ({counts})"
            self._until_us = now_us + _TOLD_WITHIN_US

    def sent(self, now_us: int) -> None:
        """Note that a setpoint has left in the tick of this time."""
        self._sent_us, self._missed_at_sent = now_us, self._missed

    def text(self, now_us: int) -> str:
        """Return what has stopped the setpoints, and for how long, or ""."""
        return self._text if now_us < self._until_us else ""


class Overload:
    """Measures the fraction of deadlines missed and derives the response.

    Args:
        params: thresholds.
        period_us: period of the ticks.

    Attributes:
        level: response required now.
        missed_01: fraction of deadlines missed in the window.
    """

    def __init__(self, params: OverloadParams, period_us: int) -> None:
        self._params, self._period_us = params, period_us
        self._seen: deque[tuple[int, int]] = deque()  # time, deadlines missed so far
        self._holds_since_us: int | None = None
        self._stalls: deque[tuple[int, int]] = deque()  # end, length; each shorter than the one before
        self.level, self.missed_01 = Level.NONE, 0.0

    @property
    def margin_m(self) -> float:
        """Margin to add to every distance [m]: for the fraction of missed deadlines, or for the longest stall."""
        return max(self._missed_margin_m(), self._stall_margin_m())

    def _missed_margin_m(self) -> float:
        """Return 0 at `widen_01`, and linearly up to `margin_max_m` at `hold_01`."""
        p = self._params
        if self.level is Level.NONE:
            return 0.0
        excess_01 = (self.missed_01 - p.widen_01) / max(1e-9, p.hold_01 - p.widen_01)
        return p.margin_max_m * min(1.0, max(0.0, excess_01))

    def _stall_margin_m(self) -> float:
        """Return how far two vehicles that keep their attitudes come closer in a stall as long as the longest one."""
        p, stall_s = self._params, self._longest_stall_s
        return min(p.stall_margin_max_m, 0.5 * p.stall_accel_m_s2 * stall_s * stall_s)

    @property
    def _longest_stall_s(self) -> float:
        return self._stalls[0][1] * 1e-6 if self._stalls else 0.0

    def text(self) -> str:
        """Return the text of the alert, "" without one."""
        if self.level is not Level.NONE:
            return f"overload: {100.0 * self.missed_01:.0f} % of deadlines missed"
        if self._stall_margin_m() < _TOLD_MARGIN_M:
            return ""
        return f"overload: stood still for {self._longest_stall_s:.1f} s"

    def update(self, now_us: int, missed: int, *, flew: bool = True) -> None:
        """Begin a tick.

        Args:
            now_us: monotonic time.
            missed: deadlines missed so far.
            flew: a setpoint has left in the tick before; a stall while the autopilot flies moves nobody.
        """
        p = self._params
        self._remember_stall(now_us, flew)
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
            least_01 = p.widen_01 if self.level is Level.NONE else _OVER_01 * p.widen_01
            self.level = Level.WIDEN if self.missed_01 >= least_01 else Level.NONE
        else:
            lands = now_us - self._holds_since_us > p.land_after_s * 1e6
            self.level = Level.LAND if lands else Level.HOLD

    def _remember_stall(self, now_us: int, flew: bool) -> None:
        """Note how long no tick has run until this one, and forget what is over for `stall_memory_s`."""
        stalled_us = now_us - self._seen[-1][0] - self._period_us if self._seen else 0
        if flew and stalled_us >= self._period_us:
            while self._stalls and self._stalls[-1][1] <= stalled_us:
                self._stalls.pop()
            self._stalls.append((now_us, stalled_us))
        while self._stalls and now_us - self._stalls[0][0] > self._params.stall_memory_s * 1e6:
            self._stalls.popleft()


class Readiness:
    """Tells when a processor has carried the load of a flight for long enough to begin one.

    An agent begins where one that rests for missed deadlines would go on: from `clear_01` on it has too much to do.

    Args:
        params: thresholds.
    """

    def __init__(self, params: OverloadParams) -> None:
        self._params = params
        self._since_us: int | None = None  # since when few enough are missed

    def reset(self) -> None:
        """Begin anew: the load is not that of a flight."""
        self._since_us = None

    def unmet(self, now_us: int, missed_01: float) -> str:
        """Return what to wait for, or "".

        Args:
            now_us: monotonic time.
            missed_01: fraction of deadlines missed of late.
        """
        p = self._params
        if missed_01 >= p.clear_01:
            self._since_us = None
        elif self._since_us is None:
            self._since_us = now_us
        if self._since_us is not None and now_us - self._since_us >= p.window_s * 1e6:
            return ""
        asked_percent, now_percent = 100.0 * p.clear_01, 100.0 * missed_01
        return (
            f"its processor to keep up: fewer than {asked_percent:.0f} % of deadlines missed for {p.window_s:g} s "
            f"(now {now_percent:.0f} %)"
        )
