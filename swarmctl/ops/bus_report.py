"""What a supervisor and a station report of the bus itself: messages refused, and sessions that were deaf."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from swarmctl.bus.json_messages import StatusMessage, decode_status
from swarmctl.bus.peers import Bus, agent_name
from swarmctl.bus.refusals import HARMLESS, IDENTITY, MALFORMED, Refusals
from swarmctl.bus.topics import STATUS
from swarmctl.ops.status_table import Display

REOPENED = "bus_reopened"  # event of supervisors, stations and agents


class BusReport:
    """Takes statuses from the bus, and reports what was not one, and what the bus did not deliver.

    Args:
        bus: whose.
        note: writes events, see `Refusals`.
        display: prints lines.
    """

    def __init__(self, bus: Bus, note: Callable[..., None], display: Display) -> None:
        self._bus, self._note, self._display = bus, note, display
        self._refusals = Refusals(note)
        self._reopened = 0

    def statuses(self) -> Iterator[StatusMessage]:
        """Yield the statuses that have arrived, each by the agent it is of; the others are refused."""
        for sender, payload in self._bus.receive(STATUS):
            status = decode_status(payload)
            if status is not None and sender == agent_name(status.agent):
                yield status
            else:
                self._refuse(sender, STATUS.name, MALFORMED if status is None else IDENTITY)

    def step(self) -> None:
        """Report what is new: refused messages, the first of each kind in words, and another session."""
        for message in self._bus.refused():
            self._refuse(*message)
        self._refusals.report(time.time_ns() // 1000)
        reopened = self._bus.reopened()
        if reopened > self._reopened:
            text = "another session of the bus has taken over: the one before may have been deaf"
            self._note(REOPENED, text=text, count=reopened)
            if not self._reopened:  # while there is nobody, that happens again and again
                self._display.print_line(text)
            self._reopened = reopened

    def _refuse(self, sender: str, topic: str, reason: str) -> None:
        if self._refusals.add(sender, topic, reason, time.time_ns() // 1000) == 1 and reason not in HARMLESS:
            self._display.print_line(f"{topic} in the name of {sender} refused: {reason}")
