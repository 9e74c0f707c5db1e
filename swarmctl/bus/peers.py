"""What an agent knows of its peers, and the bus as one protocol. Pure: no zenoh, no clock, no thread.

`PeerPaths` judges freshness by what the payload says, never by the bus, and identity by `links.speakers`. It keeps
every peer's newest path whatever its age; what an old path means for separation is decided in `swarmctl.control`.
`LocalHub` is the bus of lockstep.
"""

from __future__ import annotations

import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from swarmctl.bus.refusals import FUTURE, IDENTITY, LATE, MALFORMED, UNKNOWN_PEER, Refusals
from swarmctl.bus.senders import Attendance, ReceivedMessage, SenderVerifier
from swarmctl.bus.topics import PATH, TOO_LONG, TOPICS, Topic, decode_path
from swarmctl.core.types import PredictedPath

MAX_AGE_US = 2_000_000
MAX_LEAD_US = 500_000
LEASE_US = 1_500_000  # after which a silent link of the bus in memory is taken for dead, as bus.lease_ms
_LOSS = 1  # purpose of the random stream


def agent_name(agent: int) -> str:
    """Sender name of an agent on the bus."""
    return f"agent-{agent}"


class Bus(Protocol):
    """Publish to everybody, receive without ever blocking."""

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Send to all who listen to this sender; dropped, never queued for long."""

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """(sender, payload) of what is kept since the last call, oldest first for each sender.

        At most a ring of each sender, and `TOO_LONG` instead of every message that is longer than its topic allows.
        """

    def alive(self) -> frozenset[str]:
        """Senders that are attached now, this one included. Advisory: it proves a process, not a control loop."""

    def arrivals(self) -> Mapping[str, int]:
        """How often each sender has been seen to come, so that one that left and came back at once is noticed."""

    def close(self) -> None:
        """Leave the bus."""


class PeerPaths:
    """Newest good path of every peer; what is refused is counted by reason and leaves the known path untouched.

    Args:
        peers: agent numbers that are listened to, without the own one.
        rate_hz, refusals, attendance: see `SenderVerifier`.
        max_age_us: a path whose first point is older than this when it arrives is refused.
        max_lead_us: a path whose first point is further in the future than this is refused.
    """

    def __init__(
        self,
        peers: Iterable[int],
        rate_hz: float,
        refusals: Refusals,
        attendance: Attendance,
        max_age_us: int = MAX_AGE_US,
        max_lead_us: int = MAX_LEAD_US,
    ) -> None:
        names = {agent: agent_name(agent) for agent in peers}
        self._verifiers = {
            a: SenderVerifier(name, PATH.name, rate_hz, refusals, attendance) for a, name in names.items()
        }
        self._max_age_us = max_age_us
        self._max_lead_us = max_lead_us
        self._newest: dict[int, PredictedPath] = {}
        self.refusals = refusals

    def offer(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Judge one message of the PATH topic.

        Args:
            sender: name of the key it arrived on, which the bus vouches for.
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
        """Newest path of every peer ever heard, whatever its age, by agent number."""
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
    """A bus in memory, on a simulated clock, for agents that are ticked one after another.

    What is published at `t` is visible to others from `t + max(1, delay_us)` on, so within one step nobody sees what
    somebody else has just said, and the order in which agents are ticked does not matter.

    Args:
        now_us: the simulated clock.
        seed: of the losses.
        delay_us: travel time.
        loss_01: probability that one receiver misses one message of an unreliable topic.
    """

    def __init__(self, now_us: Callable[[], int], seed: int = 0, delay_us: int = 0, loss_01: float = 0.0) -> None:
        self._now_us = now_us
        self._seed = seed
        self._travel_us = max(1, delay_us)
        self._loss_01 = loss_01
        self._attached: dict[str, LocalBus] = {}
        self._alive: frozenset[str] = frozenset()  # as the router last told
        self._arrivals: Counter[str] = Counter()
        self._came: set[str] = set()  # while it was mute
        self._streams: dict[tuple[str, str], np.random.Generator] = {}
        self._mute_since_us: int | None = None
        self._held: list[tuple[str, Topic, bytes]] = []  # reliable messages said while it is mute

    def mute(self) -> None:
        """The bus falls apart: nobody hears anybody. Reliable messages wait, the others are lost."""
        self._mute_since_us = self._now_us()
        self._came = set()

    def unmute(self) -> None:
        """It is whole again; what has waited is under way from now on."""
        came = set(self._attached) if self._has_lost_tokens() else self._came & self._attached.keys()
        held, self._held, self._mute_since_us = self._held, [], None
        self._arrivals.update(came)
        self._alive = frozenset(self._attached)
        for sender, topic, payload in held:
            self.carry(sender, topic, payload)

    def attach(self, name: str, listen: Mapping[Topic, Sequence[str]] | None = None) -> LocalBus:
        """Join as `name`.

        Args:
            name: sender name, free at the moment.
            listen: senders heard per topic; None hears everybody but itself.
        """
        if name in self._attached:
            raise ValueError(f"{name!r} is attached already")
        bus = LocalBus(self, name, listen)
        self._attached[name] = bus
        self._tell(came=name)
        return bus

    def detach(self, name: str) -> None:
        """Leave, or die: nothing more is sent or received; what is under way still arrives."""
        self._attached.pop(name, None)
        self._tell()

    def alive(self) -> frozenset[str]:
        """Everybody; as it was when the bus became mute, and nobody, not even oneself, after `LEASE_US` of that."""
        return frozenset() if self._has_lost_tokens() else self._alive

    def arrivals(self) -> Mapping[str, int]:
        """How often each has come; once more for everybody after a mute bus had lost them."""
        return self._arrivals

    def _has_lost_tokens(self) -> bool:
        return self._mute_since_us is not None and self._now_us() - self._mute_since_us >= LEASE_US

    def _tell(self, came: str = "") -> None:
        if self._mute_since_us is not None:
            self._came |= {came} - {""}
            return
        self._alive = frozenset(self._attached)
        self._arrivals.update([came] if came else [])

    def now_us(self) -> int:
        return self._now_us()

    def is_attached(self, bus: LocalBus) -> bool:
        return self._attached.get(bus.name) is bus

    def carry(self, sender: str, topic: Topic, payload: bytes) -> None:
        """Put a message under way to every receiver that does not lose it."""
        if self._mute_since_us is not None:
            if topic.reliable:
                self._held.append((sender, topic, payload))
            return
        now_us = self._now_us()
        message = _Message(now_us + self._travel_us, payload)
        for bus in self._attached.values():
            if bus.hears(topic, sender) and not self._is_lost(sender, bus.name, topic):
                bus.accept(topic, sender, message, now_us)

    def _is_lost(self, sender: str, receiver: str, topic: Topic) -> bool:
        if topic.reliable or self._loss_01 <= 0.0:
            return False
        stream = self._streams.get((sender, receiver))
        if stream is None:  # one stream per link: its draws depend on the sender's messages only
            key = [self._seed, zlib.crc32(sender.encode()), zlib.crc32(receiver.encode()), _LOSS]
            stream = self._streams[(sender, receiver)] = np.random.default_rng(key)
        return bool(stream.random() < self._loss_01)


class LocalBus:
    """One participant of a `LocalHub`."""

    def __init__(self, hub: LocalHub, name: str, listen: Mapping[Topic, Sequence[str]] | None) -> None:
        self._hub = hub
        self.name = name
        self._listen = None if listen is None else {topic: frozenset(names) for topic, names in listen.items()}
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
        arrived.sort(key=lambda item: item[:2])  # stable: a sender's own order stays
        return [(sender, payload) for _, sender, payload in arrived]

    def alive(self) -> frozenset[str]:
        return self._hub.alive()

    def arrivals(self) -> Mapping[str, int]:
        return self._hub.arrivals()

    def close(self) -> None:
        if self._hub.is_attached(self):
            self._hub.detach(self.name)

    def hears(self, topic: Topic, sender: str) -> bool:
        if self._listen is None:
            return sender != self.name
        return sender in self._listen.get(topic, ())

    def accept(self, topic: Topic, sender: str, message: _Message, now_us: int) -> None:
        inbox = self._inboxes.setdefault(topic, {}).setdefault(sender, deque())
        inbox.append(message)
        _trim(inbox, topic.ring, now_us)


def _trim(inbox: deque[_Message], ring: int, now_us: int) -> None:
    """Keep the newest `ring` of the messages that have arrived; those under way do not push anything out yet."""
    while len(inbox) > ring and inbox[ring].visible_us <= now_us:
        inbox.popleft()
