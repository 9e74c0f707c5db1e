"""What an operator should know now: alerts with cause and time, each cleared when its cause is gone.

Pure. Who sees a cause raises its alert again on every tick it lasts; an alert that is not raised again ends by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

_ALERT_LIFETIME_US = 2_000_000  # after its cause: long enough to be read


@dataclass(frozen=True, slots=True)
class Alert:
    """One cause that needs attention."""

    cause: str
    text: str
    since_us: int


class Alerts:
    """Active alerts of one agent; times are monotonic."""

    def __init__(self) -> None:
        self._active: dict[str, Alert] = {}
        self._raised_us: dict[str, int] = {}

    def put(self, cause: str, text: str, now_us: int) -> bool:
        """Note that a cause is there now; returns whether it is new. Its text may change while it lasts."""
        before = self._active.get(cause)
        self._active[cause] = Alert(cause, text, now_us if before is None else before.since_us)
        self._raised_us[cause] = now_us
        return before is None

    def clear(self, cause: str) -> None:
        """Note that a cause is gone."""
        self._active.pop(cause, None)

    def text(self, now_us: int) -> str:
        """Text of the alert that began last, or ""."""
        self._active = {c: a for c, a in self._active.items() if now_us - self._raised_us[c] <= _ALERT_LIFETIME_US}
        newest = max(self._active.values(), key=lambda alert: alert.since_us, default=None)
        return "" if newest is None else newest.text
