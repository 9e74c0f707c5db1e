"""The bus as one protocol, and the names of those on it. Pure: no Zenoh, no clock, no thread."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Protocol

from swarmctl.bus.refusals import RefusedMessage
from swarmctl.bus.topics import Topic

DEFAULT_LEASE_MS = 1500  # silence after which who can't be reached vanishes from the bus

Subscriptions = Mapping[Topic, Sequence[str] | None]  # senders to receive per topic; None: all but oneself


def agent_name(agent: int) -> str:
    """Return the sender name of an agent on the bus."""
    return f"agent-{agent}"


class Bus(Protocol):
    """Publishes to all subscribers and receives without blocking."""

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Send to all subscribers; a message is dropped rather than queued for long."""

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return (sender, payload) of the messages since the last call, oldest first for each sender.

        There is at most one ring of each sender, and `TOO_LONG` replaces a message that is too long for its topic.
        """

    def hear(self, topic: Topic, senders: Collection[str]) -> None:
        """Receive a topic from these senders from now on, and from nobody else."""

    def refused(self) -> list[RefusedMessage]:
        """Return what was not delivered since the last call: sealed messages that do not verify, misdelivered ones."""
        return []

    def relay(self, agents: Iterable[int]) -> int:
        """Pass on the newest trajectory messages of other agents, by `RelayingBus` only; return the number of bytes."""
        return 0

    def alive(self) -> frozenset[str]:
        """Return senders attached now, this one included. It shows that a process lives, not that its loop runs."""

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each sender has joined, so that one that left and rejoined at once is noticed."""

    def reopen(self) -> bool:
        """Open another session in place of this one, which may be deaf; return whether one is being opened."""
        return False

    def reopened(self) -> int:
        """Return how often another session has taken the place of a deaf one."""
        return 0

    def close(self) -> None:
        """Leave the bus."""


class ForwardingBus(Bus):
    """A bus that another one carries: all that a subclass does not change is left to that one.

    Args:
        bus: carries the messages.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def publish(self, topic: Topic, payload: bytes) -> None:
        self._bus.publish(topic, payload)

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        return self._bus.receive(topic)

    def hear(self, topic: Topic, senders: Collection[str]) -> None:
        self._bus.hear(topic, senders)

    def refused(self) -> list[RefusedMessage]:
        return self._bus.refused()

    def relay(self, agents: Iterable[int]) -> int:
        return self._bus.relay(agents)

    def alive(self) -> frozenset[str]:
        return self._bus.alive()

    def arrivals(self) -> Mapping[str, int]:
        return self._bus.arrivals()

    def reopen(self) -> bool:
        return self._bus.reopen()

    def reopened(self) -> int:
        return self._bus.reopened()

    def close(self) -> None:
        self._bus.close()
