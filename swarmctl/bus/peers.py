"""The bus as one protocol, the newest path of every peer, and a bus in memory. Pure: no Zenoh, no clock, no thread.

`PeerPaths` judges freshness by the payload, never by the bus, and identity by `swarmctl.bus.senders`. It keeps every
peer's newest path whatever its age; what an old path means for separation is decided in `swarmctl.control`. `LocalHub`
is the bus of lockstep flights.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import NamedTuple, Protocol

import numpy as np

from swarmctl.bus import inboxes
from swarmctl.bus.inboxes import Message
from swarmctl.bus.links import PERFECT, Impairments, Link
from swarmctl.bus.path_messages import decode_path
from swarmctl.bus.peer_clocks import PeerClocks
from swarmctl.bus.reachability import Reachability, TokenView
from swarmctl.bus.refusals import FUTURE, IDENTITY, LATE, MALFORMED, UNKNOWN_PEER, Refusals, RefusedMessage
from swarmctl.bus.senders import Presence, ReceivedMessage, SenderVerifier
from swarmctl.bus.topics import PATH, TOO_LONG, TOPICS, Topic
from swarmctl.core.types import MAX_MARGIN_M, PredictedPath

MAX_AGE_US = 2_000_000
MAX_LEAD_US = 500_000
LEASE_US = 1_500_000  # time after which a `LocalHub` drops tokens that can't be reached, as bus.lease_ms


Subscriptions = Mapping[Topic, Sequence[str] | None]  # senders to receive per topic; None: all but oneself


def agent_name(agent: int) -> str:
    """Return the sender name of an agent on the bus."""
    return f"agent-{agent}"


def peer_verifiers(
    peers: Iterable[int], topic: Topic, rate_hz: float, refusals: Refusals, *, presence: Presence
) -> dict[int, SenderVerifier]:
    """Return a verifier of one topic for every peer; see `SenderVerifier`."""
    return {peer: SenderVerifier(agent_name(peer), topic.name, rate_hz, refusals, presence=presence) for peer in peers}


class Bus(Protocol):
    """Publishes to all subscribers and receives without blocking."""

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Send to all subscribers; a message is dropped rather than queued for long."""

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return (sender, payload) of the messages since the last call, oldest first for each sender.

        There is at most one ring of each sender, and `TOO_LONG` replaces a message that is too long for its topic.
        """

    def refused(self) -> list[RefusedMessage]:
        """Return the messages that were not delivered since the last call; only sealed ones are refused by a bus."""
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


class PeerPaths:
    """Keeps the newest valid path of every peer; refused messages are counted by reason and change nothing.

    Args:
        peers: numbers of the other agents.
        rate_hz, refusals, presence: see `SenderVerifier`.
        max_age_us: a path whose first point is older than this when it arrives is refused.
        max_lead_us: a path whose first point is further in the future than this is refused.
        clocks: by which paths are converted to the own clock; None takes all clocks for equal.

    Attributes:
        heard_utc_us: when a path was accepted last, of whomever.
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
        clocks: PeerClocks | None = None,
    ) -> None:
        self._verifiers = peer_verifiers(peers, PATH, rate_hz, refusals, presence=presence)
        self._max_age_us = max_age_us
        self._max_lead_us = max_lead_us
        self._clocks = clocks
        self._newest: dict[int, PredictedPath] = {}
        self._sorted: tuple[PredictedPath, ...] = ()  # these, by agent number
        self.refusals = refusals
        self.heard_utc_us = 0

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Check one message of the PATH topic, and keep it if it is accepted.

        Args:
            sender: name in the key it arrived on, which the bus guarantees.
            payload: bytes as received.
            utc_us: now, disciplined UTC [us].
        """
        path = self._by_own_clock(decode_path(payload))
        if path is None or (reason := self._refusal(sender, path, utc_us)):
            self.refusals.add(sender, PATH.name, MALFORMED if path is None else reason, utc_us)
            return
        if self._verifiers[path.agent].accepts(
            ReceivedMessage(path.boot_id, path.seq, path.t0_utc_us, payload), utc_us
        ):
            self._newest[path.agent], self.heard_utc_us = path, utc_us
            self._sorted = tuple(self._newest[agent] for agent in sorted(self._newest))

    def _by_own_clock(self, path: PredictedPath | None) -> PredictedPath | None:
        """Return the path at times of the own clock, with room for the error that is left of the peer's."""
        if path is None or self._clocks is None:
            return path
        ahead_us, spread_us = self._clocks.ahead_us(path.agent), self._clocks.spread_us(path.agent)
        if not ahead_us and not spread_us:
            return path
        steps_m = path.pos_ned_m[1:] - path.pos_ned_m[:-1]
        fastest_m_us = math.sqrt(float(np.einsum("kc,kc->k", steps_m, steps_m).max())) / path.dt_us
        margin_m = min(MAX_MARGIN_M, path.margin_m + spread_us * fastest_m_us)
        return replace(path, t0_utc_us=path.t0_utc_us - ahead_us, margin_m=margin_m)

    def latest(self) -> tuple[PredictedPath, ...]:
        """Return the newest path of every peer, whatever its age, sorted by agent number."""
        return self._sorted

    def _refusal(self, sender: str, path: PredictedPath, utc_us: int) -> str:
        if sender != agent_name(path.agent):
            return IDENTITY
        if path.agent not in self._verifiers:
            return UNKNOWN_PEER
        if path.t0_utc_us - utc_us > self._max_lead_us:
            return FUTURE
        return LATE if utc_us - path.t0_utc_us > self._max_age_us else ""


class _Receiver(NamedTuple):
    """One that the messages of a sender on a topic go to."""

    name: str
    link: Link
    inbox: deque[Message] | None  # None: it does not subscribe, but its link draws as if it did


class _Held(NamedTuple):
    """A reliable message that waits until it can pass."""

    sender: str
    topic: Topic
    payload: bytes
    only: frozenset[str] | None  # receivers that miss it; None: all that will be attached


class LocalHub:
    """A bus in memory, on a simulated clock, for agents that tick one after another.

    A message published at `t` arrives at `t + max(1, delay)` or later, so within one step no agent receives what
    another has just published, and the order in which agents tick does not matter. A message under way always arrives.

    Args:
        now_us: the simulated clock.
        seed: seed of all random impairments.
        impairments: of every link.
    """

    def __init__(
        self,
        now_us: Callable[[], int],
        seed: int = 0,
        impairments: Impairments = PERFECT,
    ) -> None:
        self._now_us = now_us
        self._seed = seed
        self._began_us = now_us()
        self._impairments = impairments
        self._links: dict[tuple[str, str], Link] = {}
        self._receivers: dict[tuple[str, Topic], list[_Receiver]] = {}  # of those attached now
        self._attached: dict[str, LocalBus] = {}
        self._views: dict[str, TokenView] = {}
        self._reachability = Reachability()
        self._held: list[_Held] = []

    def fail(self) -> None:
        """Stop delivery, as without a router. Reliable messages wait, the others are lost."""
        self._reachability.failed = True
        self._update_views()

    def recover(self) -> None:
        """Resume delivery; reliable messages that have waited are sent now."""
        self._reachability.failed = False
        self._reconnect()

    def split(self, groups: Iterable[frozenset[str]]) -> None:
        """Separate groups of participants, as of a network in parts; a name in no group still reaches everybody.

        Between groups reliable messages wait and the others are lost; tokens vanish after `LEASE_US`.

        Raises:
            ValueError: a name is in two groups.
        """
        self._reachability.split(groups)
        self._reconnect()

    def heal(self) -> None:
        """Join the groups of a split; reliable messages that have waited are sent now."""
        self.split(())

    def cut(self, sender: str, receiver: str) -> None:
        """Stop messages from one participant to another: reliable ones wait, the others are lost. Tokens stay."""
        self._reachability.cut(sender, receiver)

    def mend(self, sender: str, receiver: str) -> None:
        """Undo a cut; reliable messages that have waited are sent now."""
        self._reachability.mend(sender, receiver)
        self._reconnect()

    def connect(self, name: str, subscriptions: Subscriptions | None = None) -> LocalBus:
        """Join the hub as `name` and return the bus of that participant.

        Args:
            name: sender name, free at the moment.
            subscriptions: senders to receive per topic, None for all but itself; None receives every topic so.
        """
        if name in self._attached:
            raise ValueError(f"{name!r} is connected already")
        bus = LocalBus(self, name, dict.fromkeys(TOPICS) if subscriptions is None else subscriptions)
        self._attached[name] = bus
        self._receivers.clear()
        self._views[name] = TokenView(LEASE_US)
        self._update_views()
        return bus

    def detach(self, name: str) -> None:
        """Detach a participant: it sends and receives nothing more; its messages under way still arrive."""
        self._attached.pop(name, None)
        self._receivers.clear()
        self._views.pop(name, None)
        self._update_views()

    def alive(self, observer: str) -> frozenset[str]:
        """Return the participants whose tokens an attached one sees.

        One that it can't reach stays for `LEASE_US`; on a failed bus that is every one, the observer included.
        """
        return self._views[observer].alive(self._now_us())

    def arrivals(self, observer: str) -> Mapping[str, int]:
        """Return how often an attached participant has seen each token appear, also again after it had vanished."""
        return self._views[observer].arrivals()

    def now_us(self) -> int:
        """Return the simulated time [us]."""
        return self._now_us()

    def is_attached(self, bus: LocalBus) -> bool:
        """Tell whether this very participant is attached, not another one of its name."""
        return self._attached.get(bus.name) is bus

    def carry(self, sender: str, topic: Topic, payload: bytes, only: frozenset[str] | None = None) -> None:
        """Send a message to every receiver that does not lose it, or to those of `only`."""
        if self._reachability.failed:
            if topic.reliable:
                self._held.append(_Held(sender, topic, payload, only))
            return
        now_us, missed = self._now_us(), []
        for name, link, inbox in self._receivers_of(sender, topic):
            if only is not None and name not in only:
                continue
            if not self._reachability.passes(sender, name):
                missed += [name] if inbox is not None else []
                continue
            arrival_us = link.arrival_us(now_us, reliable=topic.reliable)
            if arrival_us is not None and inbox is not None:
                inboxes.enqueue(inbox, Message(arrival_us, payload), topic.ring, now_us)
        if missed and topic.reliable:
            self._held.append(_Held(sender, topic, payload, frozenset(missed)))

    def _receivers_of(self, sender: str, topic: Topic) -> list[_Receiver]:
        """Return the subscribers, and where a link draws for each message, all others: what one hears changes no draw.

        The list is made anew after somebody has joined or left.
        """
        found = self._receivers.get((sender, topic))
        if found is None:
            found = []
            for name, bus in self._attached.items():
                inbox, link = bus.inbox(topic, sender), self._link(sender, name)
                if inbox is not None or (link.draws and name != sender):
                    found.append(_Receiver(name, link, inbox))
            self._receivers[sender, topic] = found
        return found

    def _link(self, sender: str, receiver: str) -> Link:
        link = self._links.get((sender, receiver))
        if link is None:
            link = self._links[sender, receiver] = Link(self._impairments, self._seed, sender, receiver, self._began_us)
        return link

    def _reconnect(self) -> None:
        """Tell of the tokens that can be reached now, and send what has waited; what still can't pass waits on."""
        self._update_views()
        held, self._held = self._held, []
        for message in held:
            self.carry(*message)

    def _update_views(self) -> None:
        now_us = self._now_us()
        for observer, view in self._views.items():
            view.update(self._attached, partial(self._reachability.shows, observer=observer), now_us)


class LocalBus(Bus):
    """A participant of a `LocalHub`."""

    def __init__(self, hub: LocalHub, name: str, subscriptions: Subscriptions) -> None:
        self._hub = hub
        self.name = name
        self._subscriptions = subscriptions
        self._inboxes: dict[Topic, dict[str, deque[Message]]] = {topic: {} for topic in subscriptions}

    def publish(self, topic: Topic, payload: bytes) -> None:
        if self._hub.is_attached(self):
            self._hub.carry(self.name, topic, payload)

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        if not self._hub.is_attached(self):
            return []
        now_us = self._hub.now_us()
        arrived: list[tuple[int, str, bytes]] = []
        for sender, inbox in self._inboxes.get(topic, {}).items():
            inboxes.trim(inbox, topic.ring, now_us)
            while inbox and inbox[0].visible_us <= now_us:
                message = inbox.popleft()
                payload = message.payload if len(message.payload) <= topic.max_bytes else TOO_LONG
                arrived.append((message.visible_us, sender, payload))
        if len(arrived) > 1:
            arrived.sort(key=itemgetter(0, 1))  # stable: keeps the order of each sender
        return [(sender, payload) for _, sender, payload in arrived]

    def alive(self) -> frozenset[str]:
        return self._hub.alive(self.name) if self._hub.is_attached(self) else frozenset()

    def arrivals(self) -> Mapping[str, int]:
        return self._hub.arrivals(self.name) if self._hub.is_attached(self) else {}

    def close(self) -> None:
        if self._hub.is_attached(self):
            self._hub.detach(self.name)

    def inbox(self, topic: Topic, sender: str) -> deque[Message] | None:
        """Return where messages of a sender wait to be received; None for those that are not subscribed to."""
        if topic not in self._subscriptions:
            return None
        senders = self._subscriptions[topic]
        hears = sender != self.name if senders is None else sender in senders
        return self._inboxes[topic].setdefault(sender, deque()) if hears else None
