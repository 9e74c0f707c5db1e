"""Counts what one participant sends and hears on the bus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from swarmctl.bus.bus import Bus, ForwardingBus
from swarmctl.bus.topics import RELAY, Topic


class CountedBus(ForwardingBus):
    """A bus that counts the messages and bytes it is given to publish, and those it delivers.

    Args:
        bus: carries them.

    Attributes:
        heard_bytes: delivered so far.
    """

    def __init__(self, bus: Bus) -> None:
        super().__init__(bus)
        self._messages: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()
        self.heard_bytes = 0

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
        """Return (sender, payload) of the messages since the last call."""
        arrived = self._bus.receive(topic)
        for _, payload in arrived:
            self.heard_bytes += len(payload)
        return arrived

    def relay(self, agents: Iterable[int]) -> int:
        """Pass on messages of other agents."""
        sent = self._bus.relay(agents)
        if sent:
            self._messages[RELAY.name] += 1
            self._bytes[RELAY.name] += sent
        return sent
