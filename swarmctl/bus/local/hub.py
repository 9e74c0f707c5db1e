"""A bus in memory, of lockstep flights and of an agent without a router, with impairments that a seed repeats. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from operator import itemgetter
from typing import NamedTuple

from swarmctl.bus.bus import DEFAULT_LEASE_MS, Bus, Subscriptions
from swarmctl.bus.local import inboxes
from swarmctl.bus.local.inboxes import Message
from swarmctl.bus.local.links import PERFECT, Impairments, Link
from swarmctl.bus.local.reachability import Reachability, TokenView
from swarmctl.bus.topics import TOO_LONG, TOPICS, Topic


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
        lease_us: time after which the token of a participant that can't be reached vanishes.
    """

    def __init__(
        self,
        now_us: Callable[[], int],
        seed: int = 0,
        impairments: Impairments = PERFECT,
        *,
        lease_us: int = 1000 * DEFAULT_LEASE_MS,
    ) -> None:
        self._now_us = now_us
        self._seed = seed
        self._began_us = now_us()
        self._impairments, self._lease_us = impairments, lease_us
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

        Between groups reliable messages wait and the others are lost; tokens vanish after the lease.

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
        self._views[name] = TokenView(self._lease_us)
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

        One that it can't reach stays for the lease; on a failed bus that is every one, the observer included.
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

    def forget_receivers(self, topic: Topic, senders: Collection[str]) -> None:
        """Find out anew who receives a topic of these senders: somebody has changed what it hears."""
        for sender in senders:
            self._receivers.pop((sender, topic), None)

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
        self._subscriptions = dict(subscriptions)
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
            if not inbox or inbox[0].visible_us > now_us:
                continue
            inboxes.trim(inbox, topic.ring, now_us)
            while inbox and inbox[0].visible_us <= now_us:
                message = inbox.popleft()
                payload = message.payload if len(message.payload) <= topic.max_bytes else TOO_LONG
                arrived.append((message.visible_us, sender, payload))
        if len(arrived) > 1:
            arrived.sort(key=itemgetter(0, 1))  # stable: keeps the order of each sender
        return [(sender, payload) for _, sender, payload in arrived]

    def hear(self, topic: Topic, senders: Collection[str]) -> None:
        self._subscriptions[topic] = tuple(senders)
        inboxes_of_topic = self._inboxes.setdefault(topic, {})
        changed = inboxes_of_topic.keys() ^ set(senders)  # who has an inbox is heard; the others have sent nothing
        for sender in inboxes_of_topic.keys() - set(senders):
            del inboxes_of_topic[sender]
        self._hub.forget_receivers(topic, changed)

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
