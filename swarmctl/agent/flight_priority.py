"""The real-time priority of a process of agents: asked for before it flies, given up while it leaves others no time.

Between its ticks such a process sleeps. One that hardly does computes more than its processor can, and with that
priority nobody else would get any: neither shells, nor the launcher that could land its vehicles.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from swarmctl.process_priority import leave_realtime, request_realtime

_LOOK_US = 500_000  # a process that was paused, and so did not sleep, does so in one look
_LOOKS = 4  # in succession, after which the priority is given up, or asked for again
_LEAST_SPARE_01 = 0.25  # of a processor that the simulator, the bus and the launcher need, too
_ENOUGH_SPARE_01 = 0.4


class PacingClock(Protocol):
    """Operations that are needed of the clock of this host."""

    def now_us(self) -> int:
        """Return the monotonic time."""

    def sleep_until(self, t_us: int) -> None:
        """Wait until a monotonic time."""


class FlightPriority:
    """Asks for the priority, and paces the ticks of the process.

    Args:
        clock: time of this host.
        note: records an event of every agent of the process, given its name and fields.
    """

    def __init__(self, clock: PacingClock, note: Callable[..., None]) -> None:
        self._clock, self._note = clock, note
        self._is_granted = self._is_realtime = False  # whether it is permitted; whether the process has it now
        self._since_us = self._slept_us = self._unlike_looks = 0

    def ask(self) -> None:
        """Ask for real-time priority for this process, and record whether it was granted."""
        self._is_granted = self._is_realtime = request_realtime()
        self._since_us, self._slept_us = self._clock.now_us(), 0
        self._note("realtime", granted=self._is_realtime, start_up_s=round(time.process_time(), 3))

    def sleep_until(self, due_us: int) -> None:
        """Wait until a monotonic time; give the priority up if little time is left for that, until there is more."""
        began_us = self._clock.now_us()
        self._clock.sleep_until(due_us)
        if self._is_granted:
            self._look_at(self._clock.now_us(), began_us)

    def _look_at(self, now_us: int, slept_since_us: int) -> None:
        self._slept_us += now_us - slept_since_us
        passed_us = now_us - self._since_us
        if passed_us < _LOOK_US:
            return
        spare_01 = self._slept_us / passed_us
        self._since_us, self._slept_us = now_us, 0
        wanted = spare_01 >= (_LEAST_SPARE_01 if self._is_realtime else _ENOUGH_SPARE_01)
        self._unlike_looks = self._unlike_looks + 1 if wanted is not self._is_realtime else 0
        if self._unlike_looks == _LOOKS:
            self._unlike_looks = 0
            self._change(wanted, spare_01)

    def _change(self, wanted: bool, spare_01: float) -> None:
        if wanted:
            self._is_granted = self._is_realtime = request_realtime()
        else:
            self._is_realtime = False
            leave_realtime()
        self._note("realtime", granted=self._is_realtime, spare_01=round(spare_01, 3))
