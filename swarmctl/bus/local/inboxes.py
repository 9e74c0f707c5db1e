"""Where the messages of a bus in memory wait: one inbox for each topic and sender of a participant. Pure."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple


class Message(NamedTuple):
    """Holds a message and the time from which on it has arrived."""

    visible_us: int
    payload: bytes


def enqueue(inbox: deque[Message], message: Message, ring: int, now_us: int) -> None:
    """Queue a message under way, in the order of arrival."""
    place = len(inbox)
    while place and inbox[place - 1].visible_us > message.visible_us:
        place -= 1
    inbox.insert(place, message)  # jitter reorders messages
    trim(inbox, ring, now_us)


def trim(inbox: deque[Message], ring: int, now_us: int) -> None:
    """Keep the newest `ring` messages that have arrived; messages under way do not count."""
    while len(inbox) > ring and inbox[ring].visible_us <= now_us:
        inbox.popleft()
