"""Alerts for the operator, each with its cause and start time, cleared when the cause is gone.

Pure. The code that detects a cause raises its alert again on every tick the cause lasts; an alert that is not raised
again expires.
"""

from __future__ import annotations

from dataclasses import dataclass

_ALERT_LIFETIME_US = 2_000_000  # time an alert stays visible after its cause has gone, long enough to be read


@dataclass(frozen=True, slots=True)
class Alert:
    """One cause that needs the operator's attention."""

    text: str
    since_us: int


class Alerts:
    """Keeps the active alerts of one agent; times are monotonic."""

    def __init__(self) -> None:
        self._active: dict[str, Alert] = {}
        self._raised_us: dict[str, int] = {}

    def put(self, cause: str, text: str, now_us: int) -> bool:
        """Raise or refresh the alert of a cause; returns whether it is new. The text may change while it lasts."""
        before = self._active.get(cause)
        self._active[cause] = Alert(text, now_us if before is None else before.since_us)
        self._raised_us[cause] = now_us
        return before is None

    def clear(self, cause: str) -> None:
        """Remove the alert of a cause that is gone."""
        self._active.pop(cause, None)

    def newest(self, now_us: int) -> Alert | None:
        """Return the active alert that began last, or None."""
        self._active = {c: a for c, a in self._active.items() if now_us - self._raised_us[c] <= _ALERT_LIFETIME_US}
        return max(self._active.values(), key=lambda alert: alert.since_us, default=None)
