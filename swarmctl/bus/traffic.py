"""Counts what one participant sends on the bus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from swarmctl.bus.bus import Bus, ForwardingBus
from swarmctl.bus.topics import RELAY, Topic


class CountedBus(ForwardingBus):
    """A bus that counts the messages and bytes it is given to publish.

    Args:
        bus: carries them.
    """

    def __init__(self, bus: Bus) -> None:
        super().__init__(bus)
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

    def relay(self, agents: Iterable[int]) -> int:
        """Pass on messages of other agents."""
        sent = self._bus.relay(agents)
        if sent:
            self._messages[RELAY.name] += 1
            self._bytes[RELAY.name] += sent
        return sent
