"""Publishes and receives under keys of Zenoh, and drops what comes under the key of another message.

Zenoh 1.10.2 has brought messages under the keys of others, dozens in a flight on a busy machine from which an agent was
killed (see also `tools/misdeliveries.py`): a path as that of another agent, a status as a mission. So each message
bears a mark of the key that it was published under as attachment, and is dropped where it comes under another key. What
bears none is delivered.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from hashlib import blake2b
from typing import Any

import zenoh

_MARK_BYTES = 8
_MOST_MARKS = 4096  # that are remembered: clients of a router choose their keys


class MarkedPublisher:
    """Publishes under one key, whose mark every message bears; messages are dropped where the queue is full.

    Args:
        session: of Zenoh.
        key: to publish under.
        reliable: sent again where a link loses it.
    """

    def __init__(self, session: Any, key: str, *, reliable: bool) -> None:
        reliability = zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT
        self._mark = _mark_of(key)
        self._publisher = session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, reliability=reliability
        )

    def put(self, payload: bytes) -> None:
        """Pass a message to the session."""
        self._publisher.put(payload, attachment=self._mark)

    def undeclare(self) -> None:
        """Publish nothing more."""
        self._publisher.undeclare()


class Inbox:
    """Receives what is published under one key.

    Args:
        session: of Zenoh.
        key: to receive.
        ring: newest samples kept.
        hears_own: also what the same session publishes.
    """

    def __init__(self, session: Any, key: str, ring: int, *, hears_own: bool) -> None:
        self._mark, self._ring = _mark_of(key), ring
        origin = zenoh.Locality.ANY if hears_own else zenoh.Locality.REMOTE
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(ring), allowed_origin=origin)

    def take(self) -> tuple[Sequence[Any], int]:
        """Return the payloads that have come, and how many messages were of other keys."""
        samples = drain(self._subscriber, self._ring)
        if not samples:
            return (), 0  # from most senders nothing has come, in most ticks
        payloads = [sample.payload for sample in samples if _bears(sample, self._mark)]
        return payloads, len(samples) - len(payloads)

    def undeclare(self) -> None:
        """Receive nothing more."""
        self._subscriber.undeclare()


def is_misdelivered(sample: Any, key: str) -> bool:
    """Tell whether a sample bears the mark of another key than the one it came under."""
    return not _bears(sample, _mark_of(key))


def _bears(sample: Any, mark: bytes) -> bool:
    attachment = sample.attachment
    return attachment is None or bool(attachment.to_bytes() == mark)


@lru_cache(maxsize=_MOST_MARKS)
def _mark_of(key: str) -> bytes:
    return blake2b(key.encode(), digest_size=_MARK_BYTES).digest()


def drain(subscriber: Any, limit: int) -> list[Any]:
    """Return at most `limit` samples, so that a flood cannot block the caller."""
    samples: list[Any] = []
    try:
        while len(samples) < limit and (sample := subscriber.try_recv()) is not None:
            samples.append(sample)
    except zenoh.ZError:
        return samples  # the session is closed
    return samples
