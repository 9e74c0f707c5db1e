"""The Zenoh bus: a client of the router (`swarmctl.bus.network.router`) that connects agents and operators.

It uses one Unix socket in a private directory, without port or discovery. Samples wait in one ring for each topic and
sender until the tick drains them: no callback and no FIFO could block reception. `swarmctl.bus.peers` judges freshness
from the payload; nothing here looks into a payload.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from swarmctl.bus.bus import DEFAULT_LEASE_MS, Bus
from swarmctl.bus.marked_keys import Inbox, MarkedPublisher, drain
from swarmctl.bus.refusals import MISDELIVERED, MOST_REFUSED, RefusedMessage
from swarmctl.bus.silence import DEAF_S, SilenceWatch
from swarmctl.bus.topics import TOO_LONG, TOPICS, Topic
from swarmctl.errors import ConfigError, StartError

SCHEME = "unixsock-stream/"
NO_BUS = "none"  # endpoint of an agent without a bus
CONNECT_TIMEOUT_MS = 10_000
CLOSE_DEADLINE_S = 2.0
_THREADS = "bus-"  # how names of threads begin that open and close sessions
_MAX_MESSAGE_BYTES = 1 << 20
_ALIVE_RING = 1024
_WHO_IS_THERE_S = 5.0  # longest that a new session asks before it takes over
_LINK_OPEN_TIMEOUT_MS = 5000  # of links between routers: one that was cut is back 0.9 s after (2.0 s: 0.8, 11 s: 3.1)
# A client waits for longer than the router does (accept_timeout, 10 s), because its own time limit may strike when
# half of the opening is done: then it sends and is kept alive, but never reads (Zenoh 1.10.2). A client that got no
# processor for 2 s, as in a launch on a machine under load, was deaf for good.
_CLIENT_OPEN_TIMEOUT_MS = 60_000
_MAX_SOCKET_PATH = 100  # sun_path is 108 bytes

COMMON_SETTINGS: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/unicast/open_timeout": _LINK_OPEN_TIMEOUT_MS,
    "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
    "transport/shared_memory/enabled": False,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Joined:
    """One session, and what it has declared."""

    session: Any
    publishers: Mapping[Topic, MarkedPublisher]
    subscribers: Mapping[Topic, dict[str, Inbox]]  # by topic and sender
    tokens: Any  # subscriber of liveliness tokens
    own_token: Any


class ZenohBus(Bus):
    """A client session, which is replaced when it is deaf.

    Zenoh connects a session again whose link was lost. What it can't mend is a session that sends and is kept alive but
    receives nothing. So where nobody at all is heard for a while, another session is opened in the background, and
    takes over as soon as it is up; the one before goes on until then.

    Args:
        endpoint: the router's, for example `unixsock-stream//tmp/swarm-x/bus.sock`.
        run: name of the run, which separates it from other runs.
        me: own sender name.
        subscriptions: senders to receive, per topic.
        lease_ms: silence of the link after which the router drops this session.
        connect_timeout_ms: longest wait for the router.
        seal_bytes: by how much messages are longer than topics allow, because they are sealed.
        deaf_s: see `SilenceWatch`.

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
    ) -> None:
        self._me, self._seal_bytes = me, seal_bytes
        self._socket, self._prefix = socket_file(endpoint), f"swarm/{run}"
        self._subscriptions = dict(subscriptions)
        self._tokens_key = f"{self._prefix}/*/alive"
        self._join: Callable[[], _Joined] = partial(
            _join, endpoint, self._prefix, me, self._subscriptions, lease_ms, connect_timeout_ms
        )
        self._alive: frozenset[str] = frozenset()
        self._arrivals: Counter[str] = Counter()
        self._refused: list[RefusedMessage] = []
        self._silence = SilenceWatch(deaf_s)
        self._opening: threading.Thread | None = None
        self._next: _Joined | None = None  # up, and not yet in use
        self._reopened = 0
        self._is_closed = False
        self._now = self._join()

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Pass a message to the session; it is dropped when the queue is full or the bus is lost."""
        with contextlib.suppress(zenoh.ZError):
            self._now.publishers[topic].put(payload)

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return (sender, payload) of a topic, oldest first for each sender, at most one ring of each."""
        self._take_over()
        arrived: list[tuple[str, bytes]] = []
        most_bytes = topic.max_bytes + self._seal_bytes
        for sender, inbox in self._now.subscribers.get(topic, {}).items():
            payloads, misdelivered = inbox.take()
            arrived += [(sender, p.to_bytes() if len(p) <= most_bytes else TOO_LONG) for p in payloads]
            if misdelivered and len(self._refused) < MOST_REFUSED:
                self._refused += [RefusedMessage(sender, topic.name, MISDELIVERED)] * misdelivered
        if arrived:
            self._silence.hear()
        if self._silence.is_deaf(time.monotonic()):
            self.reopen()
        return arrived

    def hear(self, topic: Topic, senders: Collection[str]) -> None:
        """Receive a topic from these senders only; what has come from others is dropped."""
        self._subscriptions[topic] = tuple(senders)
        self._subscribe(topic)

    def refused(self) -> list[RefusedMessage]:
        """Return the messages that came under keys of others since the last call."""
        refused, self._refused = self._refused, []
        return refused

    def alive(self) -> frozenset[str]:
        """Return senders whose liveliness token is present; none, not even this one, while the router is lost."""
        self._watch_tokens()
        return self._alive | {self._me} if self._is_linked() else self._alive - {self._me}

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each token has appeared; one that left and returned between two calls counts twice."""
        self._watch_tokens()
        return self._arrivals

    def reopen(self) -> bool:
        """Open another session in the background, unless there is no router; return whether one is being opened."""
        if self._next is not None or (self._opening is not None and self._opening.is_alive()):
            return True
        if self._is_closed or not self._socket.exists():
            return False
        self._opening = threading.Thread(target=self._open_next, name=f"{_THREADS}reopen", daemon=True)
        self._opening.start()
        return True

    def reopened(self) -> int:
        """Return how often another session has taken over."""
        return self._reopened

    def close(self) -> None:
        """Leave the bus; give up after `CLOSE_DEADLINE_S`, since a link without its other end can block."""
        self._is_closed = True
        close_within(self._now.session, CLOSE_DEADLINE_S)
        if self._next is not None:
            close_within(self._next.session, CLOSE_DEADLINE_S)

    def _open_next(self) -> None:
        with contextlib.suppress(StartError, zenoh.ZError):
            joined = self._join()
            # The answers come after those of the token subscriber, which was declared before: nobody is missed.
            for _ in joined.session.liveliness().get(self._tokens_key, timeout=_WHO_IS_THERE_S):
                pass
            if self._is_closed:
                close_within(joined.session, CLOSE_DEADLINE_S)
            else:
                self._next = joined

    def _take_over(self) -> None:
        """Go on with the session that was opened last."""
        if self._next is None:
            return
        before, self._now, self._next = self._now, self._next, None
        for topic in self._now.subscribers:
            self._subscribe(topic)  # what has changed since it was opened
        self._reopened += 1
        known, self._alive = self._alive, frozenset()
        arrivals = self._arrivals.copy()
        self._watch_tokens()
        arrivals.update(self._alive - known)  # who was known has not joined now
        self._arrivals = arrivals
        threading.Thread(target=close_session, args=(before.session,), name=f"{_THREADS}close", daemon=True).start()

    def _subscribe(self, topic: Topic) -> None:
        """Declare the subscribers of a topic that the session lacks, and undeclare those that it has no use for."""
        now, wanted = self._now.subscribers[topic], self._subscriptions[topic]
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            for sender in now.keys() - set(wanted):
                now.pop(sender).undeclare()
            for sender in wanted:
                if sender not in now:
                    now[sender] = Inbox(self._now.session, f"{self._prefix}/{sender}/{topic.name}", topic.ring)

    def _is_linked(self) -> bool:
        """Return whether the session is linked to a router; the own token is not told of where it moves to another."""
        try:
            return bool(list(self._now.session.info.routers_zid()))
        except zenoh.ZError:
            return False  # the session is closed

    def _watch_tokens(self) -> None:
        for sample in drain(self._now.tokens, _ALIVE_RING):
            sender = str(sample.key_expr).split("/")[2]
            if sample.kind != zenoh.SampleKind.PUT:
                self._alive -= {sender}
            elif sender not in self._alive:  # a second process of the same name is no new arrival
                self._alive |= {sender}
                self._arrivals[sender] += 1


def _join(
    endpoint: str,
    prefix: str,
    me: str,
    subscriptions: Mapping[Topic, Sequence[str]],
    lease_ms: int,
    connect_timeout_ms: int,
) -> _Joined:
    """Open a session and declare everything."""
    session = _open_client(endpoint, lease_ms, connect_timeout_ms)
    publishers = {
        topic: MarkedPublisher(session, f"{prefix}/{me}/{topic.name}", reliable=topic.reliable) for topic in TOPICS
    }
    subscribers = {
        topic: {sender: Inbox(session, f"{prefix}/{sender}/{topic.name}", topic.ring) for sender in senders}
        for topic, senders in dict(subscriptions).items()
    }
    ring: Any = zenoh.handlers.RingChannel(_ALIVE_RING)
    return _Joined(
        session=session,
        publishers=publishers,
        subscribers=subscribers,
        tokens=session.liveliness().declare_subscriber(f"{prefix}/*/alive", ring, history=True),
        own_token=session.liveliness().declare_token(f"{prefix}/{me}/alive"),
    )


def socket_file(endpoint: str) -> Path:
    """Return the path of a Unix socket endpoint.

    Raises:
        ConfigError: the endpoint is of another kind.
        StartError: its path is too long for the kernel, as in a long TMPDIR.
    """
    path = endpoint.removeprefix(SCHEME)
    if path == endpoint or not path.startswith("/"):
        raise ConfigError(f"bus endpoint {endpoint!r}", [f"is of another kind; use {SCHEME}/ABSOLUTE/PATH"])
    if len(path.encode()) > _MAX_SOCKET_PATH:
        raise StartError(
            f"bus endpoint {endpoint!r}: path longer than {_MAX_SOCKET_PATH} bytes; set TMPDIR to a shorter directory"
        )
    return Path(path)


def _open_client(endpoint: str, lease_ms: int, timeout_ms: int) -> Any:
    settings = COMMON_SETTINGS | {
        "mode": "client",
        "transport/unicast/open_timeout": _CLIENT_OPEN_TIMEOUT_MS,
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


def close_session(session: Any) -> None:
    """Close a session, however long that takes."""
    with contextlib.suppress(zenoh.ZError):
        session.close()


def is_blocked() -> bool:
    """Return whether a thread of this process still opens or closes a session, as without a router.

    When the interpreter ends, Python unwinds such a thread when it returns. Zenoh's frames abort the process then:
    a launch whose router was lost ended with -6.
    """
    return any(thread.name.startswith(_THREADS) for thread in threading.enumerate())


def close_within(session: Any, deadline_s: float) -> None:
    """Close a session; give up after the deadline, since a link without its other end can block."""
    closer = threading.Thread(target=close_session, args=(session,), name=f"{_THREADS}close", daemon=True)
    closer.start()
    closer.join(deadline_s)
