"""Counts what one participant sends on the bus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from swarmctl.bus.bus import Bus
from swarmctl.bus.refusals import RefusedMessage
from swarmctl.bus.topics import RELAY, Topic


class CountedBus(Bus):
    """A bus that counts the messages and bytes it is given to publish.

    Args:
        bus: carries them.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._messages: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()

    @property
    def sent(self) -> dict[str, dict[str, int]]:
        """Return `messages` and `bytes` by topic."""
        return {name: {"messages": n, "bytes": self._bytes[name]} for name, n in sorted(self._messages.items())}

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Send to all subscribers."""
        self._messages[topic.name] += 1
        self._bytes[topic.name] += len(payload)
        self._bus.publish(topic, payload)

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return what has come since the last call."""
        return self._bus.receive(topic)

    def hear(self, topic: Topic, senders: Collection[str]) -> None:
        """Receive a topic from these senders only."""
        self._bus.hear(topic, senders)

    def refused(self) -> list[RefusedMessage]:
        """Return the messages that were not delivered."""
        return self._bus.refused()

    def relay(self, agents: Iterable[int]) -> int:
        """Pass on messages of other agents."""
        sent = self._bus.relay(agents)
        if sent:
            self._messages[RELAY.name] += 1
            self._bytes[RELAY.name] += sent
        return sent

    def alive(self) -> frozenset[str]:
        """Return senders attached now."""
        return self._bus.alive()

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each sender has joined."""
        return self._bus.arrivals()

    def reopen(self) -> bool:
        """Open another session in place of this one; return whether one is being opened."""
        return self._bus.reopen()

    def reopened(self) -> int:
        """Return how often another session has taken over."""
        return self._bus.reopened()

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()
