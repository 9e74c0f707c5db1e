"""The Zenoh bus: how one agent or operator publishes and receives by a session (`swarmctl.bus.zenoh.session`).

`swarmctl.bus.peers.paths` judges freshness from the payload; nothing here looks into a payload.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

from swarmctl.bus.bus import DEFAULT_LEASE_MS, Bus
from swarmctl.bus.refusals import RefusedMessage
from swarmctl.bus.silence import DEAF_S
from swarmctl.bus.topics import Topic
from swarmctl.bus.zenoh.client import CONNECT_TIMEOUT_MS
from swarmctl.bus.zenoh.session import ZenohSession


class ZenohBus(Bus):
    """One sender on a session, by default its own.

    Args:
        endpoint, run, lease_ms, connect_timeout_ms, seal_bytes, deaf_s: see `ZenohSession`.
        me: own sender name.
        subscriptions: senders to receive, per topic.
        opens: opens the session.

    Raises:
        StartError: the router does not answer in time.
    """

    def __init__(
        self,
        endpoint: str,
        run: str,
        me: str,
        subscriptions: Mapping[Topic, Sequence[str]],
        *,
        lease_ms: int = DEFAULT_LEASE_MS,
        connect_timeout_ms: int = CONNECT_TIMEOUT_MS,
        seal_bytes: int = 0,
        deaf_s: float = DEAF_S,
        opens: Callable[..., ZenohSession] = ZenohSession,
    ) -> None:
        self._me = me
        self._session = opens(
            endpoint,
            run,
            lease_ms=lease_ms,
            connect_timeout_ms=connect_timeout_ms,
            seal_bytes=seal_bytes,
            deaf_s=deaf_s,
        )
        self._session.join(me, subscriptions)

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Pass a message to the session; it is dropped when the queue is full or the bus is lost."""
        self._session.publish(self._me, topic, payload)

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return (sender, payload) of a topic, oldest first for each sender, at most one ring of each."""
        return self._session.receive(self._me, topic)

    def hear(self, topic: Topic, senders: Collection[str]) -> None:
        """Receive a topic from these senders only; what has come from others is dropped."""
        self._session.hear(self._me, topic, senders)

    def refused(self) -> list[RefusedMessage]:
        """Return the messages that came under keys of others since the last call."""
        return self._session.refused(self._me)

    def alive(self) -> frozenset[str]:
        """Return senders whose liveliness token is present; none, not even this one, while the router is lost."""
        return self._session.alive()

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each token has appeared; one that left and returned between two calls counts twice."""
        return self._session.arrivals()

    def reopen(self) -> bool:
        """Open another session in the background, unless there is no router; return whether one is being opened."""
        return self._session.reopen()

    def reopened(self) -> int:
        """Return how often another session has taken over."""
        return self._session.reopened()

    def close(self) -> None:
        """Leave the bus."""
        self._session.leave(self._me)
