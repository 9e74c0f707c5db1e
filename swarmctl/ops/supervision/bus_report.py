"""What a supervisor and a station report of the bus itself: messages refused, and sessions that were deaf."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import EndedMessage, StatusMessage, decode_status
from swarmctl.bus.peers.vouched_ends import VouchedEnds
from swarmctl.bus.refusals import HARMLESS, IDENTITY, MALFORMED, Refusals
from swarmctl.bus.silence import SessionWatch
from swarmctl.bus.topics import ENDED, EVENT, STATUS
from swarmctl.ops.supervision.status_table import Display
from swarmctl.telemetry.recording.shared_events import taken_event
from swarmctl.wall_clock import monotonic_us

_REOPENED = "another session of the bus has taken over: the one before may have been deaf"


class BusReport:
    """Takes statuses and ends from the bus, and reports what was neither, and what the bus did not deliver.

    Args:
        bus: whose.
        note: writes events, see `Refusals`.
        display: prints lines.
    """

    def __init__(self, bus: Bus, note: Callable[..., None], display: Display) -> None:
        self._bus, self._display = bus, display
        self._refusals = Refusals(note)
        self._sessions = SessionWatch(bus, partial(note, text=_REOPENED))
        self._has_told_reopened = False

    def statuses(self) -> Iterator[StatusMessage]:
        """Yield the statuses that have arrived, each by the agent it is of; the others are refused."""
        for sender, payload in self._bus.receive(STATUS):
            status = decode_status(payload)
            if status is not None and sender == agent_name(status.agent):
                yield status
            else:
                self.refuse(sender, STATUS.name, MALFORMED if status is None else IDENTITY)

    def ends(self, vouched: VouchedEnds) -> Iterator[EndedMessage]:
        """Yield the ends of agents' processes that are news, as those say who run them; what others say is refused."""
        for sender, payload in self._bus.receive(ENDED):
            ended, refusal = vouched.take(sender, payload)
            if refusal:
                self.refuse(sender, ENDED.name, refusal)
            if ended is not None:
                yield ended

    def events(self) -> Iterator[tuple[str, bytes]]:
        """Yield the events of agents that have arrived, each with its sender and as it is recorded."""
        for sender, payload in self._bus.receive(EVENT):
            taken = taken_event(sender, payload)
            if taken.refusal:
                self.refuse(sender, EVENT.name, taken.refusal)
            else:
                yield sender, taken.line

    def step(self, *, anybody: bool = True) -> None:
        """Report what is new: refused messages, the first of each kind in words, and another session.

        Silence tells nothing of a session where `anybody` is false: nobody is left who could be heard.
        """
        for message in self._bus.refused():
            self.refuse(*message)
        self._refusals.report(monotonic_us())
        if not anybody:
            self._sessions.excuse()
        if self._sessions.step() and not self._has_told_reopened:  # while there is nobody, it happens again and again
            self._has_told_reopened = True
            self._display.print_line(_REOPENED)

    def refuse(self, sender: str, topic: str, reason: str) -> None:
        """Count a message that is not taken, and say the first of its kind."""
        if self._refusals.add(sender, topic, reason, monotonic_us()) == 1 and reason not in HARMLESS:
            self._display.print_line(f"{topic} in the name of {sender} refused: {reason}")
