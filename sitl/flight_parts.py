"""A lockstep flight in parts: what the agents of one part send to those of others, which another process steps.

Vehicles do not touch each other's states, so all that leaves a part is what its agents, and the operator, publish. A
message arrives 1 us after it was published, or later, as in one process: so parts exchange theirs once a step, after
the ticks, and the flight is the same bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from swarmctl.bus.bus import Bus, ForwardingBus
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.topics import TOPICS, Topic

_NUMBERS = {topic: number for number, topic in enumerate(TOPICS)}


class SentMessage(NamedTuple):
    """A message that one part tells the others of."""

    sender: str
    topic: int  # its number in `TOPICS`
    payload: bytes


class OtherParts(Protocol):
    """The parts of a flight that other processes step, as seen by one part."""

    def begin_step(self) -> None:
        """Have the others tick, too."""

    def exchange(self, sent: Sequence[SentMessage], finished: bool) -> Sequence[SentMessage]:
        """Tell what this part has sent in this step and whether its agents have finished; return what others sent."""

    @property
    def finished(self) -> bool:
        """Whether all agents of the others had finished at the last exchange."""

    def ends_in_s(self) -> float:
        """Return for how long agents of the others do what ends by itself, as `Lockstep.ends_in_s`."""


class NoParts(OtherParts):
    """The others of a flight that one process steps as a whole."""

    def begin_step(self) -> None:
        """Do nothing."""

    def exchange(self, sent: Sequence[SentMessage], finished: bool) -> Sequence[SentMessage]:
        """Return no messages."""
        return ()

    @property
    def finished(self) -> bool:
        """There is nobody who has not."""
        return True

    def ends_in_s(self) -> float:
        """Return that nobody does anything."""
        return 0.0


class OutgoingBus(ForwardingBus):
    """A bus whose messages are noted for the other parts.

    Args:
        bus: carries them within this part.
        sender: its participant.
        sent: list that they are added to.
    """

    def __init__(self, bus: Bus, sender: str, sent: list[SentMessage]) -> None:
        super().__init__(bus)
        self._sender, self._sent = sender, sent

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Send to all subscribers, here and elsewhere."""
        self._sent.append(SentMessage(self._sender, _NUMBERS[topic], payload))
        self._bus.publish(topic, payload)


def carry(hub: LocalHub, messages: Sequence[SentMessage]) -> None:
    """Send what others have sent in this step to their subscribers on this hub, where they are attached by name."""
    for sender, topic, payload in messages:
        hub.carry(sender, TOPICS[topic], payload)
