"""The two clocks of a process behind one protocol, which is passed in as an argument.

Monotonic microseconds (`now_us`) are for deadlines and ages inside this process; disciplined UTC microseconds
(`utc_us`) are for everything that leaves it. The wall-clock implementation lives in `swarmctl.wall_clock`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """Provides the time to an agent and its links."""

    def now_us(self) -> int:
        """Return monotonic time of this process [us]."""

    def utc_us(self) -> int:
        """Return disciplined UTC [us since 1970], comparable between hosts."""

    def utc_of_us(self, t_us: int) -> int:
        """Return UTC at monotonic time `t_us`. No hold-up of this process comes between two readings: there is one."""


class SimClock:
    """Simulated time, which moves only by `advance`. Both clocks tick together, `epoch_us` apart."""

    def __init__(self, epoch_us: int = 1_700_000_000_000_000) -> None:
        self._now_us = 0
        self._epoch_us = epoch_us

    def now_us(self) -> int:
        return self._now_us

    def utc_us(self) -> int:
        return self._epoch_us + self._now_us

    def utc_of_us(self, t_us: int) -> int:
        return self._epoch_us + t_us

    def advance(self, step_us: int) -> None:
        """Advance time by `step_us` (> 0)."""
        if step_us <= 0:
            raise ValueError(f"step_us: {step_us} must be positive")
        self._now_us += step_us


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockError:
    """Error of a host's UTC."""

    offset_us: int = 0  # ahead of true UTC at monotonic time 0
    drift_ppm: float = 0.0  # gain on true UTC, > -1e6


class TickClock:
    """A clock with one difference of UTC from monotonic time in all that a tick does.

    A host's two clocks are read one after the other, so that the difference is another one by microseconds whenever it
    is measured. Decisions that follow from it could not be repeated from a recording, which has one UTC of each tick.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.begin_tick(clock.now_us())

    def begin_tick(self, now_us: int) -> None:
        """Take over the difference that there is at monotonic time `now_us`."""
        self._ahead_us = self._clock.utc_of_us(now_us) - now_us

    def now_us(self) -> int:
        return self._clock.now_us()

    def utc_us(self) -> int:
        return self._clock.now_us() + self._ahead_us

    def utc_of_us(self, t_us: int) -> int:
        return t_us + self._ahead_us


class OffsetClock:
    """A clock whose UTC is wrong by `error`; its monotonic time is that of `clock`."""

    def __init__(self, clock: Clock, error: ClockError) -> None:
        self._clock = clock
        self._error = error

    def now_us(self) -> int:
        return self._clock.now_us()

    def utc_us(self) -> int:
        return self.utc_of_us(self._clock.now_us())

    def utc_of_us(self, t_us: int) -> int:
        drift_us = round(1e-6 * self._error.drift_ppm * t_us)
        return self._clock.utc_of_us(t_us) + self._error.offset_us + drift_us
