"""Messages that an agent has refused: counted by reason, reported as events, shown as an alert. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

REPLAYED = "replayed"  # sent before by its sender
LATE = "late"
FUTURE = "future"
MALFORMED = "malformed"
IDENTITY = "identity"  # the name inside differs from that in the key
UNSEALED = "unsealed"  # has no seal, where messages have one: `bus.network.seals`
FORGED = "forged"  # its seal is not by who has this name
MISDELIVERED = "misdelivered"  # the bus has brought it under the key of another message: `bus.zenoh.marked_keys`
UNKNOWN_PEER = "unknown_peer"
UNCONFIRMED = "unconfirmed"  # perhaps a restart; becomes BOOT or SEQUENCE if the accepted stream continues
BOOT = "boot"  # another boot id, while the accepted stream continues
SEQUENCE = "sequence"  # a number beyond the rate, or one number with two contents
STALE_ORDER = "stale_order"
FUTURE_ORDER = "future_order"
SUPERSEDED_ORDER = "superseded_order"  # a newer order has been obeyed

# Caused by networks, restarts or Zenoh alone
HARMLESS = frozenset((REPLAYED, LATE, MISDELIVERED, UNCONFIRMED, SUPERSEDED_ORDER))
MOST_REFUSED = 4096  # kept by a bus until they are asked for
_EVENT_PERIOD_US = 1_000_000
_ALERT_HOLD_US = 5_000_000  # time an alert is shown after the last refusal


class _Kind(NamedTuple):
    sender: str
    topic: str
    reason: str


class RefusedMessage(NamedTuple):
    """Names a message that a bus has not delivered, because who it is said to be from has not sent it so."""

    sender: str
    topic: str
    reason: str  # one of those above


class Refusals:
    """Counts refused messages by sender, topic and reason.

    Args:
        note: is told `refused` with sender, topic, reason and count, at most once a second for each of them.
    """

    def __init__(self, note: Callable[..., None]) -> None:
        self._note = note
        self._counts: Counter[_Kind] = Counter()
        self._reported: dict[_Kind, tuple[int, int]] = {}  # count, and when
        self._alert, self._alert_until_us = "", 0
        self.total = 0

    @property
    def by_reason(self) -> Counter[str]:
        """Return all counts by reason."""
        found: Counter[str] = Counter()
        for kind, count in self._counts.items():
            found[kind.reason] += count
        return +found

    def add(self, sender: str, topic: str, reason: str, utc_us: int) -> int:
        """Count one refused message; returns how many of its kind there have been."""
        self.total += 1
        kind = _Kind(sender, topic, reason)
        self._counts[kind] += 1
        self._raise_alert(sender, topic, reason, utc_us)
        return self._counts[kind]

    def reclassify(self, sender: str, topic: str, reasons: Counter[str], utc_us: int) -> None:
        """Count unconfirmed messages by these reasons instead, after they have been contradicted."""
        self._counts[_Kind(sender, topic, UNCONFIRMED)] -= reasons.total()
        for reason, count in reasons.items():
            self._counts[_Kind(sender, topic, reason)] += count
            self._raise_alert(sender, topic, reason, utc_us)

    def report(self, utc_us: int) -> None:
        """Write the events that are due."""
        for kind, count in self._counts.items():
            reported, reported_us = self._reported.get(kind, (0, 0))
            if count > reported and utc_us - reported_us >= _EVENT_PERIOD_US:
                self._reported[kind] = (count, utc_us)
                self._note("refused", **kind._asdict(), count=count)

    def alert(self, utc_us: int) -> str:
        """Return the alert to show now, or ""."""
        return self._alert if utc_us < self._alert_until_us else ""

    def _raise_alert(self, sender: str, topic: str, reason: str, utc_us: int) -> None:
        if reason not in HARMLESS:
            self._alert, self._alert_until_us = f"{topic} of {sender} refused: {reason}", utc_us + _ALERT_HOLD_US
