"""The host's clocks: monotonic time, comparable between processes of one host, and UTC whose steps are slewed.

Monotonic time goes on while the host is suspended, as the vehicle does: its mode is in doubt after such a pause.
"""

from __future__ import annotations

import time
from collections.abc import Callable

_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # Linux alone has it
_UTC_SLEW_01 = 0.01  # largest correction of UTC per elapsed time


def monotonic_us() -> int:
    """Return monotonic time [us], which is comparable between processes of this host."""
    return _monotonic_ns() // 1000


def utc_us() -> int:
    """Return UTC as the host has it at this moment [us]."""
    return time.time_ns() // 1000


def _monotonic_ns() -> int:
    return time.clock_gettime_ns(_CLOCK)


class WallClock:
    """Reads the host's clocks. UTC steps are slewed, so that in flight time neither jumps nor runs backwards.

    Args:
        monotonic_ns, utc_ns: these clocks.
    """

    def __init__(
        self, monotonic_ns: Callable[[], int] = _monotonic_ns, utc_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._monotonic_ns, self._utc_ns = monotonic_ns, utc_ns
        self._read_ns = monotonic_ns()
        self._offset_ns = utc_ns() - self._read_ns

    def now_us(self) -> int:
        return self._monotonic_ns() // 1000

    def utc_us(self) -> int:
        return self._discipline() // 1000

    def utc_of_us(self, t_us: int) -> int:
        self._discipline()
        return (1000 * t_us + self._offset_ns) // 1000

    def utc_ahead_us(self) -> int:
        """Return by how much UTC is ahead of monotonic time."""
        return self.utc_of_us(0)

    def _discipline(self) -> int:
        """Follow the host's UTC; return it [ns]."""
        now_ns = self._monotonic_ns()
        most_ns = int((now_ns - self._read_ns) * _UTC_SLEW_01)
        off_ns = self._utc_ns() - now_ns - self._offset_ns
        self._offset_ns += off_ns if -most_ns <= off_ns <= most_ns else most_ns if off_ns > 0 else -most_ns
        self._read_ns = now_ns
        return now_ns + self._offset_ns

    def sleep_until(self, t_us: int) -> None:
        """Return at monotonic time `t_us`, or at once when it has passed."""
        left_us = t_us - self.now_us()
        if left_us > 0:
            time.sleep(left_us * 1e-6)
