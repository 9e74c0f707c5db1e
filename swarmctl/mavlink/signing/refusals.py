"""Frames that a signed link has refused: counted by reason, shown as an alert. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

UNSIGNED = "unsigned"
WRONG_SIGNATURE = "wrong signature"  # another key, or changed by somebody
DAMAGED = "damaged"  # by noise: its checksum is wrong, too
OLD = "old"  # perhaps from before this program has started
REPLAYED = "replayed"  # not newer than the newest frame of its sender
FUTURE = "future"

HARMLESS = frozenset((DAMAGED, OLD, REPLAYED))  # caused by reboots, links and networks alone
_EVENT_PERIOD_US = 1_000_000
_ALERT_HOLD_US = 5_000_000  # time an alert is shown after the last refusal


def in_words(counts: Mapping[str, int]) -> str:
    """Return counts by reason as text, or ""."""
    return ", ".join(f"{count} {reason}" for reason, count in counts.items())


class FrameRefusals:
    """Counts refused frames of one link."""

    def __init__(self) -> None:
        self.by_reason: Counter[str] = Counter()
        self._alert, self._alert_until_us = "", 0
        self._reported: Counter[str] = Counter()
        self._reported_us = 0

    def add(self, reason: str, utc_us: int) -> None:
        """Count one refused frame."""
        self.by_reason[reason] += 1
        if reason not in HARMLESS:
            self._alert, self._alert_until_us = f"frames of the vehicle refused: {reason}", utc_us + _ALERT_HOLD_US

    def alert(self, utc_us: int) -> str:
        """Return the alert to show now, or ""."""
        return self._alert if utc_us < self._alert_until_us else ""

    def report(self, utc_us: int, note: Callable[..., None]) -> None:
        """Tell `note` of each reason whose count has grown, at most once a second."""
        if self.by_reason == self._reported or utc_us - self._reported_us < _EVENT_PERIOD_US:
            return
        for reason, count in self.by_reason.items():
            if count > self._reported[reason]:
                note("frames_refused", reason=reason, count=count)
        self._reported, self._reported_us = self.by_reason.copy(), utc_us
