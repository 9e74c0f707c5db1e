"""The Zenoh bus: a client of the router (`swarmctl.bus.network.router`) that connects agents and operators.

It uses one Unix socket in a private directory, without port or discovery. Samples wait in one ring for each topic and
sender until the tick drains them: no callback and no FIFO could block reception. `swarmctl.bus.peers` judges freshness
from the payload; nothing here looks into a payload.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import zenoh

from swarmctl.bus.refusals import RefusedMessage
from swarmctl.bus.topics import TOO_LONG, TOPICS, Topic
from swarmctl.errors import StartError

SCHEME = "unixsock-stream/"
NO_BUS = "none"  # endpoint of an agent without a bus
CONNECT_TIMEOUT_MS = 10_000
CLOSE_DEADLINE_S = 2.0
_MAX_MESSAGE_BYTES = 1 << 20
_ALIVE_RING = 1024
_OPEN_TIMEOUT_MS = 2000
_MAX_SOCKET_PATH = 100  # sun_path is 108 bytes

COMMON_SETTINGS: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/unicast/open_timeout": _OPEN_TIMEOUT_MS,
    "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
    "transport/shared_memory/enabled": False,
}


class ZenohBus:
    """Implements `swarmctl.bus.peers.Bus` by a client session.

    Args:
        endpoint: the router's, for example `unixsock-stream//tmp/swarm-x/bus.sock`.
        run: name of the run, which separates it from other runs.
        me: own sender name.
        subscriptions: senders to receive, per topic.
        lease_ms: silence of the link after which the router drops this session.
        connect_timeout_ms: longest wait for the router.
        seal_bytes: by how much messages are longer than topics allow, because they are sealed.

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
        lease_ms: int = 1500,
        connect_timeout_ms: int = CONNECT_TIMEOUT_MS,
        seal_bytes: int = 0,
    ) -> None:
        self._seal_bytes = seal_bytes
        self._session = _open_client(endpoint, lease_ms, connect_timeout_ms)
        prefix = f"swarm/{run}"
        self._publishers = {topic: self._publisher(f"{prefix}/{me}/{topic.name}", topic) for topic in TOPICS}
        self._subscribers = {
            topic: [(sender, self._subscriber(f"{prefix}/{sender}/{topic.name}", topic)) for sender in senders]
            for topic, senders in subscriptions.items()
        }
        self._alive: frozenset[str] = frozenset()
        self._arrivals: Counter[str] = Counter()
        self._token_samples = self._session.liveliness().declare_subscriber(
            f"{prefix}/*/alive", zenoh.handlers.RingChannel(_ALIVE_RING), history=True
        )
        self._token = self._session.liveliness().declare_token(f"{prefix}/{me}/alive")

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Pass a message to the session; it is dropped when the queue is full or the bus is lost."""
        with contextlib.suppress(zenoh.ZError):
            self._publishers[topic].put(payload)

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return (sender, payload) of a topic, oldest first for each sender, at most one ring of each."""
        arrived: list[tuple[str, bytes]] = []
        for sender, subscriber in self._subscribers.get(topic, ()):
            if samples := _drain(subscriber, topic.ring):  # there is nothing from most, in most ticks
                payloads, most_bytes = (sample.payload for sample in samples), topic.max_bytes + self._seal_bytes
                arrived += [(sender, p.to_bytes() if len(p) <= most_bytes else TOO_LONG) for p in payloads]
        return arrived

    def refused(self) -> list[RefusedMessage]:
        """Return nothing: whether a message is its sender's is not judged here."""
        return []

    def relay(self, agents: Iterable[int]) -> int:
        """Pass on nothing: a `RelayingBus` round this one does."""
        return 0

    def alive(self) -> frozenset[str]:
        """Return senders whose liveliness token is present; none, not even this one, while the router is lost."""
        self._watch_tokens()
        return self._alive

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each token has appeared; one that left and returned between two calls counts twice."""
        self._watch_tokens()
        return self._arrivals

    def close(self) -> None:
        """Leave the bus; give up after `CLOSE_DEADLINE_S`, since a link without its other end can block."""
        close_within(self._session, CLOSE_DEADLINE_S)

    def _watch_tokens(self) -> None:
        for sample in _drain(self._token_samples, _ALIVE_RING):
            sender = str(sample.key_expr).split("/")[2]
            if sample.kind != zenoh.SampleKind.PUT:
                self._alive -= {sender}
            elif sender not in self._alive:  # a second process of the same name is no new arrival
                self._alive |= {sender}
                self._arrivals[sender] += 1

    def _publisher(self, key: str, topic: Topic) -> Any:
        reliability = zenoh.Reliability.RELIABLE if topic.reliable else zenoh.Reliability.BEST_EFFORT
        return self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, reliability=reliability
        )

    def _subscriber(self, key: str, topic: Topic) -> Any:
        return self._session.declare_subscriber(
            key, zenoh.handlers.RingChannel(topic.ring), allowed_origin=zenoh.Locality.REMOTE
        )


def socket_file(endpoint: str) -> Path:
    """Return the path of a Unix socket endpoint.

    Raises:
        StartError: the endpoint is of another kind, or its path too long for the kernel.
    """
    path = endpoint.removeprefix(SCHEME)
    if path == endpoint or not path.startswith("/"):
        raise StartError(f"bus endpoint {endpoint!r}: use {SCHEME}/ABSOLUTE/PATH")
    if len(path.encode()) > _MAX_SOCKET_PATH:
        raise StartError(
            f"bus endpoint {endpoint!r}: path longer than {_MAX_SOCKET_PATH} bytes; set TMPDIR to a shorter directory"
        )
    return Path(path)


def _open_client(endpoint: str, lease_ms: int, timeout_ms: int) -> Any:
    settings = COMMON_SETTINGS | {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": timeout_ms,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        "transport/link/tx/lease": lease_ms,
    }
    try:
        return open_session(settings)
    except zenoh.ZError as error:
        raise StartError(
            f"bus endpoint {endpoint!r}: no router answers within {timeout_ms / 1000:.1f} s. "
            f"Start one with: python -m swarmctl.bus.network.router {endpoint}"
        ) from error


def open_session(settings: Mapping[str, Any]) -> Any:
    """Open a session of Zenoh with these settings.

    Raises:
        zenoh.ZError: it can't be opened.
    """
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _drain(subscriber: Any, limit: int) -> list[Any]:
    """Return at most `limit` samples, so that a flood cannot block the caller."""
    samples: list[Any] = []
    try:
        while len(samples) < limit and (sample := subscriber.try_recv()) is not None:
            samples.append(sample)
    except zenoh.ZError:
        return samples  # the session is closed
    return samples


def close_within(session: Any, deadline_s: float) -> None:
    """Close a session; give up after the deadline, since a link without its other end can block."""

    def close() -> None:
        with contextlib.suppress(zenoh.ZError):
            session.close()

    closer = threading.Thread(target=close, name="bus-close", daemon=True)
    closer.start()
    closer.join(deadline_s)
