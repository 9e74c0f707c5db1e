"""What a supervisor and a station report of the bus itself: messages refused, and sessions that were deaf."""

from __future__ import annotations

import time
from collections.abc import Callable

from swarmctl.bus.peers import Bus
from swarmctl.bus.refusals import HARMLESS, Refusals
from swarmctl.ops.status_table import Display

REOPENED = "bus_reopened"  # event of supervisors, stations and agents


class BusReport:
    """Reports what the bus did not deliver.

    Args:
        bus: whose.
        note: writes events, see `Refusals`.
        display: prints lines.
    """

    def __init__(self, bus: Bus, note: Callable[..., None], display: Display) -> None:
        self._bus, self._note, self._display = bus, note, display
        self._refusals = Refusals(note)
        self._reopened = 0

    def step(self) -> None:
        """Report what is new: refused messages, the first of each kind in words, and another session."""
        utc_us = time.time_ns() // 1000
        for sender, topic, reason in self._bus.refused():
            if self._refusals.add(sender, topic, reason, utc_us) == 1 and reason not in HARMLESS:
                self._display.print_line(f"{topic} in the name of {sender} refused: {reason}")
        self._refusals.report(utc_us)
        reopened = self._bus.reopened()
        if reopened > self._reopened:
            text = "nobody was heard on the bus: its session may have been deaf, another was opened"
            self._note(REOPENED, text=text, count=reopened)
            if not self._reopened:  # while there is nobody, that happens again and again
                self._display.print_line(text)
            self._reopened = reopened
