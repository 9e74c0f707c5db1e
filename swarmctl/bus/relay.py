"""Relaying: agents pass on the newest trajectory messages of others to those that have not heard them lately.

A message arrives unchanged and under the name of its sender, as if it had been under way for longer. What is relayed
therefore says no more and no less than what arrives directly, and is judged alike.

The layout is little-endian: a header, then for each message the number of its agent, its length and its bytes.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

from swarmctl.bus.bus import Bus, ForwardingBus, agent_name
from swarmctl.bus.messages.commitment_messages import HeardTimes
from swarmctl.bus.topics import FAR_TRAJECTORY, RELAY, TOO_LONG, TRAJECTORY, Topic
from swarmctl.core.trajectory_message import TrajectoryMessage

RELAY_VERSION = 1
_RELAY_AFTER_PERIODS = 4  # without a message of the other one, after which a peer is helped: one or two get lost
_HELPED_US = 3_000_000  # a peer that was itself not heard for this long is not
_SUPERSEDED = 32  # messages of each sender before its newest, by which older ones of relays are known
_NEVER = (0, 0)  # stamp and arrival of the newest message of an agent that was never heard
_MAGIC = b"SR"
_HEADER = struct.Struct("<2sBB")  # magic, version, count
_ENTRY = struct.Struct("<II")  # agent, length

Relayed = list[tuple[int, bytes]]  # numbers of agents, and what they have sent


def encode_relay(messages: Sequence[tuple[int, bytes]]) -> bytes:
    """Encode the messages of some agents, the first ones if they are too many; what there is no room for is left out.

    The next ones may be short enough: no agent keeps those of others from being passed on by the length of its own.
    """
    parts, room = list[bytes](), RELAY.max_bytes - _HEADER.size
    for agent, payload in messages[:255]:
        if _ENTRY.size + len(payload) <= room:
            room -= _ENTRY.size + len(payload)
            parts.append(_ENTRY.pack(agent, len(payload)) + payload)
    return _HEADER.pack(_MAGIC, RELAY_VERSION, len(parts)) + b"".join(parts)


def decode_relay(payload: bytes) -> Relayed | None:
    """Decode what somebody relays; None unless magic, version and all lengths are valid."""
    found, at = Relayed(), _HEADER.size
    try:
        magic, version, count = _HEADER.unpack_from(payload)
        for _ in range(count):
            agent, length = _ENTRY.unpack_from(payload, at)
            at += _ENTRY.size + length
            found.append((agent, payload[at - length : at]))
    except struct.error:
        return None
    return found if (magic, version, at) == (_MAGIC, RELAY_VERSION, len(payload)) else None


class RelayingBus(ForwardingBus):
    """A bus whose trajectory messages also arrive by relays.

    It works on messages as they are carried: where they are sealed, what a relay delivers is opened like the rest.

    Args:
        bus: carries the messages.
        peers: numbers of the other agents.
    """

    def __init__(self, bus: Bus, peers: Iterable[int]) -> None:
        super().__init__(bus)
        self._names = {peer: agent_name(peer) for peer in peers}
        self._newest: dict[str, bytes] = {}  # of each sender, as it was carried
        self._superseded: defaultdict[str, deque[bytes]] = defaultdict(partial(deque, maxlen=_SUPERSEDED))

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return what has come since the last call, what was relayed first."""
        arrived = self._bus.receive(topic)
        if topic is TRAJECTORY:
            found = [*self._relayed(), *arrived]
        elif topic is FAR_TRAJECTORY:
            found = arrived
        else:
            return arrived
        for sender, payload in found:
            if payload != TOO_LONG:
                if (before := self._newest.get(sender, payload)) != payload:
                    self._superseded[sender].append(before)
                self._newest[sender] = payload
        return found

    def relay(self, agents: Iterable[int]) -> int:
        """Send the newest messages of other agents to all, and return the number of bytes."""
        known = [(i, self._newest[self._names[i]]) for i in agents if self._names[i] in self._newest]
        if not known:
            return 0
        payload = encode_relay(known)
        self._bus.publish(RELAY, payload)
        return len(payload)

    def _relayed(self) -> list[tuple[str, bytes]]:
        """Return relayed messages that are no older ones of their agents; one not to be read is its relay's.

        An older one would be passed on in place of the newest, which nobody may have any more. Sealed ones tell no age.
        """
        found = list[tuple[str, bytes]]()
        for sender, payload in self._bus.receive(RELAY):
            messages = decode_relay(payload)
            if messages is None:
                found.append((sender, TOO_LONG))
                continue
            names = [(self._names[agent], carried) for agent, carried in messages if agent in self._names]
            found += [item for item in names if not self._is_known(*item) and item not in found]
        return found

    def _is_known(self, sender: str, payload: bytes) -> bool:
        return self._newest.get(sender) == payload or payload in self._superseded[sender]


def missed_by_peers(
    own: int,
    newest: Mapping[int, TrajectoryMessage],
    telling: Mapping[int, TrajectoryMessage],
    received_us: Mapping[int, int],
    utc_us: int,
    *,
    peer_count: int,
    period_us: int,
    far_us: int,
    lacked_us: Callable[[TrajectoryMessage, int, int], int],
) -> list[int]:
    """Return the agents whose newest message this one has to pass on, since some peer has not heard them for a while.

    A peer is helped if, by its own clock, nothing of the other one has arrived for a while (however slow links are),
    and what it lacks was sent a while before it said so (an agent that was held up itself is not missed). The while is
    longer where one of the two is far from the other, or the other one has nothing to say but to all.
    Of all who have what it lacks, two help at once, those that it hears first. Each further pair waits two periods
    longer, so that there is help whatever the first ones know, and messages do not grow with the number of agents:
    helpers that all help at once keep each other from hearing in time, and so from ever ending it.

    Args:
        own: number of this agent.
        newest: message of each peer.
        telling: the newest of each peer that says what it has heard.
        received_us: when the newest arrived here.
        utc_us: now.
        peer_count: how many peers every agent has, heard or not.
        period_us: of every agent's messages.
        far_us: of those that the far ones hear, too; 0: all hear all.
        lacked_us: returns for how long, by its newest message, a peer has lacked what another sent after a stamp.
    """
    found, near_us = set[int](), _RELAY_AFTER_PERIODS * period_us
    rare_us = max(near_us, _RELAY_AFTER_PERIODS * far_us)
    for peer, message in telling.items():
        if utc_us - received_us[peer] > (period_us if far_us else _HELPED_US) or message is not newest[peer]:
            continue  # where not every message says what was heard, each is looked at once
        far = message.reach.far
        has_heard_all = len(message.heard) >= peer_count - len(far)
        if has_heard_all and _heard_lately(message, rare_us if own in far else near_us):
            continue  # as nearly always
        heard = dict(message.heard.items())
        excluded = message.exclusions.promised  # of these nothing counts any more, nor is it said what was heard
        for agent in newest.keys() - (far - heard.keys()) if far else newest:  # of far ones, those it mentions
            if agent in excluded:
                continue
            other, (stamp_us, arrival_us) = newest[agent], heard.get(agent, _NEVER)
            silent_us = message.sent_utc_us - arrival_us
            if silent_us <= near_us or other.sent_utc_us <= stamp_us or agent == peer or agent in found:
                continue
            is_rare = agent in far or peer in other.reach.far or not other.is_committed
            least_us = rare_us if is_rare else near_us
            waited_us = min(silent_us, lacked_us(message, agent, stamp_us) + period_us)
            if waited_us <= least_us:
                continue
            if waited_us > least_us + 2 * period_us * (_rank(own, peer, agent, telling, least_us) // 2):
                found.add(agent)
    return sorted(found)


def _heard_lately(message: TrajectoryMessage, least_us: int) -> bool:
    """Return whether the sender of a message has heard everybody it mentions within a while."""
    heard = message.heard
    oldest_us = heard.oldest_us if isinstance(heard, HeardTimes) else min((at for _, at in heard.values()), default=0)
    return message.sent_utc_us - oldest_us <= least_us


def _rank(own: int, peer: int, agent: int, telling: Mapping[int, TrajectoryMessage], least_us: int) -> int:
    """Return how many others are to help a peer before this agent: they have what it lacks, and it hears them.

    All come to the same order without a word, and to another one for each agent (rendezvous hashing, D. Thaler and
    C. Ravishankar 1996).
    """
    message = telling[peer]
    stamp_us = message.heard.get(agent, _NEVER)[0]

    def order(helper: int) -> tuple[bool, int]:
        is_heard = message.sent_utc_us - message.heard.get(helper, _NEVER)[1] <= least_us
        return not is_heard, zlib.crc32(struct.pack("<II", helper, agent))

    able = (i for i, said in telling.items() if i not in (peer, agent) and said.heard.get(agent, _NEVER)[0] > stamp_us)
    own_order = order(own)
    return sum(order(helper) < own_order for helper in able)
