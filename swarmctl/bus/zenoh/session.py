"""A session of Zenoh: a client of the router (`swarmctl.bus.network.router`), for one sender or for several.

It uses one Unix socket in a private directory, without port or discovery. Samples wait in one ring for each topic and
sender until a tick drains them: no callback and no FIFO could block reception. Senders of one process that share a
session hear each other through it, and what comes from elsewhere comes once for all of them.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import zenoh

from swarmctl.bus.bus import DEFAULT_LEASE_MS
from swarmctl.bus.refusals import MISDELIVERED, MOST_REFUSED, RefusedMessage
from swarmctl.bus.silence import DEAF_S, SilenceWatch
from swarmctl.bus.topics import TOO_LONG, TOPICS, Topic
from swarmctl.bus.zenoh.client import (
    CLOSE_DEADLINE_S,
    CONNECT_TIMEOUT_MS,
    THREADS,
    close_session,
    close_within,
    open_client,
    run_within,
    socket_file,
)
from swarmctl.bus.zenoh.marked_keys import Inbox, MarkedPublisher, drain
from swarmctl.errors import StartError

_TOKEN = "alive"  # name of the keys of liveliness tokens
_ALIVE_RING = 1024
_WHO_IS_THERE_S = 5.0  # longest that a new session asks before it takes over


@dataclass(slots=True)
class _Sender:
    """Somebody who publishes and receives by a session.

    Attributes:
        listens: whom it receives, by topic.
        waiting: what has come for it since it has received last, by topic and sender.
        refused: what came under keys of others.
    """

    listens: dict[Topic, Sequence[str]]
    waiting: dict[Topic, dict[str, deque[bytes]]] = field(default_factory=dict)
    refused: list[RefusedMessage] = field(default_factory=list)

    def keep(self, topic: Topic, sender: str, payloads: Iterable[bytes]) -> None:
        """Let messages wait, at most one ring of each sender."""
        kept = self.waiting.setdefault(topic, {})
        if sender in kept:
            kept[sender].extend(payloads)
        else:
            kept[sender] = deque(payloads, topic.ring)

    def refuse(self, topic: Topic, sender: str, count: int) -> None:
        """Note that messages of others came under a sender's key."""
        if len(self.refused) < MOST_REFUSED:
            self.refused += [RefusedMessage(sender, topic.name, MISDELIVERED)] * count


@dataclass(frozen=True, slots=True, kw_only=True)
class _Declared:
    """An open session, and what it has declared."""

    session: Any
    tokens: Any  # subscriber of liveliness tokens
    publishers: dict[str, Mapping[Topic, MarkedPublisher]] = field(default_factory=dict)  # by own sender
    own_tokens: dict[str, Any] = field(default_factory=dict)  # by own sender
    inboxes: dict[Topic, dict[str, Inbox]] = field(default_factory=dict)  # by topic and sender


class ZenohSession:
    """A client session, which is replaced when it is deaf.

    Zenoh connects a session again whose link was lost. What it can't mend is a session that sends and is kept alive but
    receives nothing. So where nobody at all is heard for a while, another session is opened in the background, and
    takes over as soon as it is up; the one before goes on until then.

    One thread receives; senders may leave in others.

    Args:
        endpoint: the router's, for example `unixsock-stream//tmp/swarm-x/bus.sock`.
        run: name of the run, which separates it from other runs.
        lease_ms: silence of the link after which the router drops this session.
        connect_timeout_ms: longest wait for the router.
        seal_bytes: by how much messages are longer than topics allow, because they are sealed.
        deaf_s: see `SilenceWatch`.
        is_shared: its senders hear each other, and it stays open when the last one has left.

    Raises:
        StartError: the router does not answer in time.
    """

    def __init__(
        self,
        endpoint: str,
        run: str,
        *,
        lease_ms: int = DEFAULT_LEASE_MS,
        connect_timeout_ms: int = CONNECT_TIMEOUT_MS,
        seal_bytes: int = 0,
        deaf_s: float = DEAF_S,
        is_shared: bool = False,
    ) -> None:
        self._socket, self._prefix = socket_file(endpoint), f"swarm/{run}"
        self._open: Callable[[], Any] = partial(open_client, endpoint, lease_ms, connect_timeout_ms)
        self._seal_bytes, self._is_shared = seal_bytes, is_shared
        self._lock = threading.Lock()  # of senders, and of what is declared for them
        self._senders: dict[str, _Sender] = {}
        self._listeners: dict[Topic, dict[str, tuple[_Sender, ...]]] = {}  # by topic and sender
        self._alive: frozenset[str] = frozenset()
        self._arrivals: Counter[str] = Counter()
        self._silence = SilenceWatch(deaf_s)
        self._opening: threading.Thread | None = None
        self._next: _Declared | None = None  # up, and not yet in use
        self._reopened = 0
        self._is_closed = False
        self._now = self._begun()

    def join(self, me: str, subscriptions: Mapping[Topic, Sequence[str]]) -> None:
        """Publish and receive under a name from now on; its token says so to everybody."""
        with self._lock:
            self._senders = {**self._senders, me: _Sender(dict(subscriptions))}
        self._declare()

    def leave(self, me: str) -> None:
        """Withdraw a sender, and close the session after the last one, unless it is shared."""
        with self._lock:
            if me not in self._senders:
                return
            self._senders = {name: own for name, own in self._senders.items() if name != me}
        if self._senders or self._is_shared:
            run_within(self._declare, CLOSE_DEADLINE_S)
        else:
            self.close()

    def close(self) -> None:
        """Leave the bus; give up after `CLOSE_DEADLINE_S`, since a link without its other end can block."""
        self._is_closed = True
        close_within(self._now.session, CLOSE_DEADLINE_S)
        if self._next is not None:
            close_within(self._next.session, CLOSE_DEADLINE_S)

    def publish(self, me: str, topic: Topic, payload: bytes) -> None:
        """Pass a message to the session; it is dropped when the queue is full or the bus is lost."""
        publishers = self._now.publishers.get(me)
        if publishers is not None:
            with contextlib.suppress(zenoh.ZError):
                publishers[topic].put(payload)

    def receive(self, me: str, topic: Topic) -> list[tuple[str, bytes]]:
        """Return (sender, payload) of a topic, oldest first for each sender, at most one ring of each."""
        self._take_over()
        own = self._senders.get(me)
        if own is None:
            return []
        self._collect(topic)
        if self._silence.is_deaf(time.monotonic()):
            self.reopen()
        waiting = own.waiting.pop(topic, None)
        return [(sender, payload) for sender, kept in waiting.items() for payload in kept] if waiting else []

    def hear(self, me: str, topic: Topic, senders: Collection[str]) -> None:
        """Receive a topic from these senders only; what has come from others is dropped."""
        own = self._senders.get(me)
        if own is None:
            return
        with self._lock:
            own.listens[topic] = tuple(senders)
        kept = own.waiting.get(topic, {})
        for sender in kept.keys() - set(senders):
            del kept[sender]
        self._declare(topic)

    def refused(self, me: str) -> list[RefusedMessage]:
        """Return the messages that came under keys of others since the last call."""
        own = self._senders.get(me)
        if own is None:
            return []
        refused, own.refused = own.refused, []
        return refused

    def alive(self) -> frozenset[str]:
        """Return senders whose liveliness token is present; none of the own ones while the router is lost."""
        self._watch_tokens()
        own = self._senders.keys()
        return self._alive | own if self._is_linked() else self._alive - own

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
        self._opening = threading.Thread(target=self._open_next, name=f"{THREADS}reopen", daemon=True)
        self._opening.start()
        return True

    def reopened(self) -> int:
        """Return how often another session has taken over."""
        return self._reopened

    def _begun(self) -> _Declared:
        """Open a session, and declare everything; the own tokens last."""
        session = self._open()
        ring: Any = zenoh.handlers.RingChannel(_ALIVE_RING)
        tokens = session.liveliness().declare_subscriber(self._key("*", _TOKEN), ring, history=True)
        begun = _Declared(session=session, tokens=tokens)
        self._declare_for(begun, TOPICS)
        return begun

    def _declare(self, *topics: Topic) -> None:
        """Declare what senders need for some topics, or for all, and undeclare the rest."""
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            for unused in self._declare_for(self._now, topics or TOPICS):
                unused.undeclare()

    def _declare_for(self, declared: _Declared, topics: Sequence[Topic]) -> list[Any]:
        """Declare what a session lacks, and return what it has no use for.

        Whoever undeclares that may have to wait, and a tick has not: what it looks through is replaced, not changed.
        """
        with self._lock:
            unused: list[Any] = [inbox for topic in topics for inbox in self._declare_inboxes(declared, topic)]
            left = [name for name in declared.publishers if name not in self._senders]
            unused += [publisher for name in left for publisher in declared.publishers.pop(name).values()]
            for name in self._senders.keys() - declared.publishers.keys():
                declared.publishers[name] = {
                    topic: MarkedPublisher(declared.session, self._key(name, topic.name), reliable=topic.reliable)
                    for topic in TOPICS
                }
                declared.own_tokens[name] = declared.session.liveliness().declare_token(self._key(name, _TOKEN))
            tokens = [declared.own_tokens.pop(name, None) for name in left]
            return [*(token for token in tokens if token is not None), *unused]

    def _declare_inboxes(self, declared: _Declared, topic: Topic) -> list[Inbox]:
        """Declare the inboxes of a topic that a session lacks, and return those that it has no use for."""
        listeners: dict[str, tuple[_Sender, ...]] = {}
        for own in self._senders.values():
            for sender in own.listens.get(topic, ()):
                listeners[sender] = (*listeners.get(sender, ()), own)
        before, wanted = declared.inboxes.get(topic, {}), dict[str, Inbox]()
        for sender in listeners:
            known, key = before.get(sender), self._key(sender, topic.name)
            wanted[sender] = known or Inbox(declared.session, key, topic.ring, hears_own=self._is_shared)
        declared.inboxes[topic] = wanted
        self._listeners = {**self._listeners, topic: listeners}
        return [inbox for sender, inbox in before.items() if sender not in wanted]

    def _key(self, sender: str, name: str) -> str:
        return f"{self._prefix}/{sender}/{name}"

    def _collect(self, topic: Topic) -> None:
        """Hand out what has come of a topic to those who listen to its senders."""
        listeners, most_bytes = self._listeners.get(topic, {}), topic.max_bytes + self._seal_bytes
        for sender, inbox in self._now.inboxes.get(topic, {}).items():
            samples, misdelivered = inbox.take()
            if not samples and not misdelivered:
                continue  # from most senders nothing has come, in most ticks
            payloads = [p.to_bytes() if len(p) <= most_bytes else TOO_LONG for p in samples]
            if payloads and sender not in self._senders:
                self._silence.hear()
            for own in listeners.get(sender, ()):
                own.keep(topic, sender, payloads)
                own.refuse(topic, sender, misdelivered)

    def _open_next(self) -> None:
        with contextlib.suppress(StartError, zenoh.ZError):
            begun = self._begun()
            # The answers come after those of the token subscriber, which was declared before: nobody is missed.
            for _ in begun.session.liveliness().get(self._key("*", _TOKEN), timeout=_WHO_IS_THERE_S):
                pass
            if self._is_closed:
                close_within(begun.session, CLOSE_DEADLINE_S)
            else:
                self._next = begun

    def _take_over(self) -> None:
        """Go on with the session that was opened last."""
        if self._next is None:
            return
        before, self._now, self._next = self._now, self._next, None
        self._declare()  # what has changed since it was opened
        self._reopened += 1
        known, self._alive = self._alive, frozenset()
        arrivals = self._arrivals.copy()
        self._watch_tokens()
        arrivals.update(self._alive - known)  # who was known has not joined now
        self._arrivals = arrivals
        threading.Thread(target=close_session, args=(before.session,), name=f"{THREADS}close", daemon=True).start()

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


class SharedSession:
    """Opens one session for all senders of a process, and the same again for each."""

    def __init__(self) -> None:
        self._session: ZenohSession | None = None

    def __call__(self, endpoint: str, run: str, **options: Any) -> ZenohSession:
        """Return the session; arguments as of `ZenohSession`, the same from everybody.

        Raises:
            StartError: the router does not answer in time.
        """
        if self._session is None:
            self._session = ZenohSession(endpoint, run, is_shared=True, **options)
        return self._session

    def close(self) -> None:
        """Leave the bus, after every sender has left."""
        if self._session is not None:
            self._session.close()
