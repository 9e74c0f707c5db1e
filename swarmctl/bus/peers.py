"""The bus as one protocol, the newest path of every peer, and a bus in memory. Pure: no Zenoh, no clock, no thread.

`PeerPaths` judges freshness by the payload, never by the bus, and identity by `swarmctl.bus.senders`. It keeps every
peer's newest path whatever its age; what an old path means for separation is decided in `swarmctl.control`. `LocalHub`
is the bus of lockstep flights.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol

from swarmctl.bus.links import Impairments, Link
from swarmctl.bus.path_messages import decode_path
from swarmctl.bus.refusals import FUTURE, IDENTITY, LATE, MALFORMED, UNKNOWN_PEER, Refusals
from swarmctl.bus.senders import Presence, ReceivedMessage, SenderVerifier
from swarmctl.bus.topics import PATH, TOO_LONG, TOPICS, Topic
from swarmctl.core.types import PredictedPath

MAX_AGE_US = 2_000_000
MAX_LEAD_US = 500_000
LEASE_US = 1_500_000  # time after which a failed `LocalHub` drops all tokens, as bus.lease_ms


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

    def alive(self) -> frozenset[str]:
        """Return senders attached now, this one included. It shows that a process lives, not that its loop runs."""

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each sender has joined, so that one that left and rejoined at once is noticed."""

    def close(self) -> None:
        """Leave the bus."""


class PeerPaths:
    """Keeps the newest valid path of every peer; refused messages are counted by reason and change nothing.

    Args:
        peers: numbers of the other agents.
        rate_hz, refusals, presence: see `SenderVerifier`.
        max_age_us: a path whose first point is older than this when it arrives is refused.
        max_lead_us: a path whose first point is further in the future than this is refused.
    """

    def __init__(
        self,
        peers: Iterable[int],
        rate_hz: float,
        refusals: Refusals,
        presence: Presence,
        *,
        max_age_us: int = MAX_AGE_US,
        max_lead_us: int = MAX_LEAD_US,
    ) -> None:
        names = {agent: agent_name(agent) for agent in peers}
        self._verifiers = {
            a: SenderVerifier(name, PATH.name, rate_hz, refusals, presence=presence) for a, name in names.items()
        }
        self._max_age_us = max_age_us
        self._max_lead_us = max_lead_us
        self._newest: dict[int, PredictedPath] = {}
        self.refusals = refusals

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Check one message of the PATH topic, and keep it if it is accepted.

        Args:
            sender: name in the key it arrived on, which the bus guarantees.
            payload: bytes as received.
            utc_us: now, disciplined UTC [us].
        """
        path = decode_path(payload)
        if path is None or (reason := self._refusal(sender, path, utc_us)):
            self.refusals.add(sender, PATH.name, MALFORMED if path is None else reason, utc_us)
            return
        if self._verifiers[path.agent].accepts(
            ReceivedMessage(path.boot_id, path.seq, path.t0_utc_us, payload), utc_us
        ):
            self._newest[path.agent] = path

    def latest(self) -> tuple[PredictedPath, ...]:
        """Return the newest path of every peer, whatever its age, sorted by agent number."""
        return tuple(self._newest[agent] for agent in sorted(self._newest))

    def _refusal(self, sender: str, path: PredictedPath, utc_us: int) -> str:
        if sender != agent_name(path.agent):
            return IDENTITY
        if path.agent not in self._verifiers:
            return UNKNOWN_PEER
        if path.t0_utc_us - utc_us > self._max_lead_us:
            return FUTURE
        return LATE if utc_us - path.t0_utc_us > self._max_age_us else ""


class _Message(NamedTuple):
    visible_us: int
    payload: bytes


class LocalHub:
    """A bus in memory, on a simulated clock, for agents that tick one after another.

    A message published at `t` arrives at `t + max(1, delay_us)` or later, so within one step no agent receives what
    another has just published, and the order in which agents tick does not matter.

    Args:
        now_us: the simulated clock.
        seed: seed of all random impairments.
        delay_us, loss_01, burst_01, burst_s, jitter_us: see `Impairments`.
    """

    def __init__(
        self,
        now_us: Callable[[], int],
        seed: int = 0,
        delay_us: int = 0,
        loss_01: float = 0.0,
        *,
        burst_01: float = 0.0,
        burst_s: float = 2.0,
        jitter_us: int = 0,
    ) -> None:
        self._now_us = now_us
        self._seed = seed
        self._began_us = now_us()
        self._impairments = Impairments(
            delay_us=delay_us, loss_01=loss_01, burst_01=burst_01, burst_s=burst_s, jitter_us=jitter_us
        )
        self._links: dict[tuple[str, str], Link] = {}
        self._attached: dict[str, LocalBus] = {}
        self._alive: frozenset[str] = frozenset()  # as last reported
        self._arrivals: Counter[str] = Counter()
        self._joined: set[str] = set()  # while it had failed
        self._failed_since_us: int | None = None
        self._held: list[tuple[str, Topic, bytes]] = []  # reliable messages published while it has failed

    def fail(self) -> None:
        """Stop delivery, as without a router. Reliable messages wait, the others are lost."""
        self._failed_since_us = self._now_us()
        self._joined = set()

    def recover(self) -> None:
        """Resume delivery; reliable messages that have waited are sent now."""
        joined = set(self._attached) if self._has_lost_tokens() else self._joined & self._attached.keys()
        held, self._held, self._failed_since_us = self._held, [], None
        self._arrivals.update(joined)
        self._alive = frozenset(self._attached)
        for sender, topic, payload in held:
            self.carry(sender, topic, payload)

    def connect(self, name: str, subscriptions: Mapping[Topic, Sequence[str]] | None = None) -> LocalBus:
        """Join the hub as `name` and return the bus of that participant.

        Args:
            name: sender name, free at the moment.
            subscriptions: senders to receive per topic; None receives all but the own messages.
        """
        if name in self._attached:
            raise ValueError(f"{name!r} is connected already")
        bus = LocalBus(self, name, subscriptions)
        self._attached[name] = bus
        self._update_presence(joined=name)
        return bus

    def detach(self, name: str) -> None:
        """Detach a participant: it sends and receives nothing more; its messages under way still arrive."""
        self._attached.pop(name, None)
        self._update_presence()

    def alive(self) -> frozenset[str]:
        """Return all participants; on a failed bus those of before, and none, not even the caller, after `LEASE_US`."""
        return frozenset() if self._has_lost_tokens() else self._alive

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each has joined; all join once more after a failed bus had dropped them."""
        return self._arrivals

    def _has_lost_tokens(self) -> bool:
        return self._failed_since_us is not None and self._now_us() - self._failed_since_us >= LEASE_US

    def _update_presence(self, joined: str = "") -> None:
        if self._failed_since_us is not None:
            self._joined |= {joined} - {""}
            return
        self._alive = frozenset(self._attached)
        self._arrivals.update([joined] if joined else [])

    def now_us(self) -> int:
        """Return the simulated time [us]."""
        return self._now_us()

    def is_attached(self, bus: LocalBus) -> bool:
        """Tell whether this very participant is attached, not another one of its name."""
        return self._attached.get(bus.name) is bus

    def carry(self, sender: str, topic: Topic, payload: bytes) -> None:
        """Send a message to every receiver that does not lose it."""
        if self._failed_since_us is not None:
            if topic.reliable:
                self._held.append((sender, topic, payload))
            return
        now_us = self._now_us()
        for name, bus in self._attached.items():
            if not bus.subscribes_to(topic, sender):
                continue
            arrival_us = self._link(sender, name).arrival_us(now_us, reliable=topic.reliable)
            if arrival_us is not None:
                bus.accept(topic, sender, _Message(arrival_us, payload), now_us)

    def _link(self, sender: str, receiver: str) -> Link:
        link = self._links.get((sender, receiver))
        if link is None:
            link = self._links[sender, receiver] = Link(self._impairments, self._seed, sender, receiver, self._began_us)
        return link


class LocalBus:
    """A participant of a `LocalHub`."""

    def __init__(self, hub: LocalHub, name: str, subscriptions: Mapping[Topic, Sequence[str]] | None) -> None:
        self._hub = hub
        self.name = name
        self._subscriptions = (
            None if subscriptions is None else {topic: frozenset(names) for topic, names in subscriptions.items()}
        )
        self._inboxes: dict[Topic, dict[str, deque[_Message]]] = {topic: {} for topic in TOPICS}

    def publish(self, topic: Topic, payload: bytes) -> None:
        if self._hub.is_attached(self):
            self._hub.carry(self.name, topic, payload)

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        if not self._hub.is_attached(self):
            return []
        now_us = self._hub.now_us()
        arrived: list[tuple[int, str, bytes]] = []
        for sender, inbox in self._inboxes.get(topic, {}).items():
            _trim(inbox, topic.ring, now_us)
            while inbox and inbox[0].visible_us <= now_us:
                message = inbox.popleft()
                payload = message.payload if len(message.payload) <= topic.max_bytes else TOO_LONG
                arrived.append((message.visible_us, sender, payload))
        arrived.sort(key=lambda item: item[:2])  # stable: keeps the order of each sender
        return [(sender, payload) for _, sender, payload in arrived]

    def alive(self) -> frozenset[str]:
        return self._hub.alive()

    def arrivals(self) -> Mapping[str, int]:
        return self._hub.arrivals()

    def close(self) -> None:
        if self._hub.is_attached(self):
            self._hub.detach(self.name)

    def subscribes_to(self, topic: Topic, sender: str) -> bool:
        """Tell whether messages of a sender are received."""
        if self._subscriptions is None:
            return sender != self.name
        return sender in self._subscriptions.get(topic, ())

    def accept(self, topic: Topic, sender: str, message: _Message, now_us: int) -> None:
        """Queue a message under way, in the order of arrival."""
        inbox = self._inboxes.setdefault(topic, {}).setdefault(sender, deque())
        place = len(inbox)
        while place and inbox[place - 1].visible_us > message.visible_us:
            place -= 1
        inbox.insert(place, message)  # jitter reorders messages
        _trim(inbox, topic.ring, now_us)


def _trim(inbox: deque[_Message], ring: int, now_us: int) -> None:
    """Keep the newest `ring` messages that have arrived; messages under way do not count."""
    while len(inbox) > ring and inbox[ring].visible_us <= now_us:
        inbox.popleft()
