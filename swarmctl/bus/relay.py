"""Relaying: agents pass on the newest trajectory messages of others to those that have not heard them lately.

A message arrives unchanged and under the name of its sender, as if it had been under way for longer. What is relayed
therefore says no more and no less than what arrives directly, and is judged alike.

The layout is little-endian: a header, then for each message the number of its agent, its length and its bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence

from swarmctl.bus.bus import Bus, ForwardingBus, agent_name
from swarmctl.bus.topics import RELAY, TOO_LONG, TRAJECTORY, Topic
from swarmctl.core.trajectory_message import TrajectoryMessage

RELAY_VERSION = 1
_RELAY_AFTER_PERIODS = 4  # without a message of the other one, after which a peer is helped: one or two get lost
_HELPED_US = 3_000_000  # a peer that was itself not heard for this long is not
_MAGIC = b"SR"
_HEADER = struct.Struct("<2sBB")  # magic, version, count
_ENTRY = struct.Struct("<II")  # agent, length

Relayed = list[tuple[int, bytes]]  # numbers of agents, and what they have sent


def encode_relay(messages: Sequence[tuple[int, bytes]]) -> bytes:
    """Encode the messages of some agents, the first ones if they are too many or too long."""
    parts, length = list[bytes](), _HEADER.size
    for agent, payload in messages[:255]:
        length += _ENTRY.size + len(payload)
        if length > RELAY.max_bytes:
            break
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

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        """Return what has come since the last call, what was relayed first."""
        arrived = self._bus.receive(topic)
        if topic is not TRAJECTORY:
            return arrived
        found = [*self._relayed(), *arrived]
        self._newest.update((sender, payload) for sender, payload in found if payload != TOO_LONG)
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
        """Return relayed messages that differ from the newest of their agents; one not to be read is its relay's."""
        found = list[tuple[str, bytes]]()
        for sender, payload in self._bus.receive(RELAY):
            messages = decode_relay(payload)
            if messages is None:
                found.append((sender, TOO_LONG))
                continue
            names = [(self._names[agent], carried) for agent, carried in messages if agent in self._names]
            found += [item for item in names if self._newest.get(item[0]) != item[1] and item not in found]
        return found


def missed_by_peers(
    newest: Mapping[int, TrajectoryMessage], utc_us: int, received_utc_us: Mapping[int, int], *, period_us: int
) -> list[int]:
    """Return the agents whose newest message some peer lacks, having heard none of theirs for a while.

    Each peer says when, by its own clock, it has heard whom: neither delay nor clocks matter.

    Args:
        newest: message of each peer.
        utc_us: now.
        received_utc_us: when each of them arrived.
        period_us: of every agent's messages.
    """
    found = set[int]()
    for peer, message in newest.items():
        if utc_us - received_utc_us[peer] > _HELPED_US:
            continue
        for agent, other in newest.items():
            if agent == peer or agent in found:
                continue
            stamp_us, arrival_us = message.heard.get(agent, (0, 0))
            if message.sent_utc_us - arrival_us > _RELAY_AFTER_PERIODS * period_us and other.sent_utc_us > stamp_us:
                found.add(agent)
    return sorted(found)
