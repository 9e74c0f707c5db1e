"""A bus whose messages are sealed: what others say arrives only if they have said it (`swarmctl.bus.network.seals`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from swarmctl.bus.bus import Bus, ForwardingBus
from swarmctl.bus.network.seals import Sealer, SealVerifier
from swarmctl.bus.peers.clocks import MOST_APART_US
from swarmctl.bus.refusals import MOST_REFUSED, REPLAYED, RefusedMessage
from swarmctl.bus.topics import ENDED, FAR_PATH, OBSTACLES, PATH, STATUS, TOO_LONG, TRAJECTORY, Topic

_FOR_LISTS_US = 60_000_000
FOR_AGENTS_US: Mapping[str, int] = MappingProxyType(
    {topic.name: MOST_APART_US for topic in (PATH, FAR_PATH, STATUS, ENDED, TRAJECTORY)}
    | {OBSTACLES.name: _FOR_LISTS_US}
)
# An operator has to understand agents whatever its clock: it stamps orders by what their statuses say.
FOR_OPERATORS_US: Mapping[str, int] = MappingProxyType(dict.fromkeys((ENDED.name, OBSTACLES.name), _FOR_LISTS_US))


class SealedBus(ForwardingBus):
    """Seals what is published, and delivers what verifies.

    Args:
        bus: carries the sealed messages.
        sealer: seals the own ones.
        verifier: opens those of others.
        utc_us: own clock.
    """

    def __init__(self, bus: Bus, sealer: Sealer, verifier: SealVerifier, utc_us: Callable[[], int]) -> None:
        super().__init__(bus)
        self._sealer, self._verifier, self._utc_us = sealer, verifier, utc_us
        self._refused: list[RefusedMessage] = []

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Seal and send to all subscribers."""
        self._bus.publish(topic, self._sealer.seal(topic.stream, payload, self._utc_us()))

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return what others have said since the last call; one that is too long is delivered as such."""
        arrived = self._bus.receive(topic)
        if not arrived:
            return arrived
        utc_us, opened, stream = self._utc_us(), list[tuple[str, bytes]](), topic.stream
        for sender, sealed in arrived:
            if sealed == TOO_LONG:
                opened.append((sender, sealed))
                continue
            payload, reason = self._verifier.open(sender, stream, sealed, utc_us)
            if reason == REPLAYED and stream == TRAJECTORY.name:
                continue  # relays are slower than others
            if not reason:
                opened.append((sender, payload))
            elif len(self._refused) < MOST_REFUSED:
                self._refused.append(RefusedMessage(sender, topic.name, reason))
        return opened

    def refused(self) -> list[RefusedMessage]:
        """Return the messages refused since the last call."""
        refused, self._refused = self._refused, []
        return refused + self._bus.refused()
