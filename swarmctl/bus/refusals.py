"""What an agent's bus has refused: counted by reason, told as events, shown as an alert. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

REPLAYED = "replayed"  # what its sender has said before
LATE = "late"
FUTURE = "future"
MALFORMED = "malformed"
IDENTITY = "identity"  # another name inside than that of the key it came by
UNKNOWN_PEER = "unknown_peer"
UNCONFIRMED = "unconfirmed"  # perhaps a restart; becomes one of the next two if the believed stream goes on
BOOT = "boot"  # another boot id, while the believed one goes on
SEQUENCE = "sequence"  # a number that time does not allow, or one number with two contents
STALE_ORDER = "stale_order"
FUTURE_ORDER = "future_order"
SUPERSEDED_ORDER = "superseded_order"  # a newer one has been obeyed

HARMLESS = frozenset((REPLAYED, LATE, UNCONFIRMED, SUPERSEDED_ORDER))  # what a network, or a restart, does by itself
_EVENT_EVERY_US = 1_000_000
_ALERT_US = 5_000_000  # shown for so long after the last


class _Kind(NamedTuple):
    sender: str
    topic: str
    reason: str


class Refusals:
    """See the module.

    Args:
        note: is told `refused` with sender, topic, reason and count so far, once a second for each of these at most.
    """

    def __init__(self, note: Callable[..., None]) -> None:
        self._note = note
        self._counts: Counter[_Kind] = Counter()
        self._told: dict[_Kind, tuple[int, int]] = {}  # count, and when
        self._alert, self._alert_until_us = "", 0
        self.total = 0

    @property
    def by_reason(self) -> Counter[str]:
        """All so far."""
        found: Counter[str] = Counter()
        for kind, count in self._counts.items():
            found[kind.reason] += count
        return +found

    def add(self, sender: str, topic: str, reason: str, utc_us: int) -> None:
        """One more."""
        self.total += 1
        self._counts[_Kind(sender, topic, reason)] += 1
        self._warn(sender, topic, reason, utc_us)

    def turn(self, sender: str, topic: str, reasons: Counter[str], utc_us: int) -> None:
        """What was unconfirmed has been contradicted: it is counted by these reasons from now on."""
        self._counts[_Kind(sender, topic, UNCONFIRMED)] -= reasons.total()
        for reason, count in reasons.items():
            self._counts[_Kind(sender, topic, reason)] += count
            self._warn(sender, topic, reason, utc_us)

    def tell(self, utc_us: int) -> None:
        """Write the events that are due."""
        for kind, count in self._counts.items():
            told, told_us = self._told.get(kind, (0, 0))
            if count > told and utc_us - told_us >= _EVENT_EVERY_US:
                self._told[kind] = (count, utc_us)
                self._note("refused", **kind._asdict(), count=count)

    def alert(self, utc_us: int) -> str:
        """What an operator should know of it now, or ""."""
        return self._alert if utc_us < self._alert_until_us else ""

    def _warn(self, sender: str, topic: str, reason: str, utc_us: int) -> None:
        if reason not in HARMLESS:
            self._alert, self._alert_until_us = f"{topic} of {sender} refused: {reason}", utc_us + _ALERT_US
