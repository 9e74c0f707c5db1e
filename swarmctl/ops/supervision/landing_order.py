"""The order to land that a supervisor gives to all agents: since when, until when, and who obeys it."""

from __future__ import annotations

from swarmctl.core.types import Phase
from swarmctl.ops.supervision.status_table import AgentView

_REPEAT_S = 0.5
_LANDING_S = 300.0  # for those that are heard landing: from 90 m it takes more than a minute


class LandingOrder:
    """Holds the times of the order, by the monotonic clock."""

    def __init__(self) -> None:
        self._given_s: float | None = None
        self._said_s = self._until_s = 0.0

    @property
    def is_given(self) -> bool:
        """Return whether all were ordered to land."""
        return self._given_s is not None

    def give(self, now_s: float, timeout_s: float) -> bool:
        """Give the order, which is to be obeyed within a time; return whether it is the first one."""
        if self._given_s is not None:
            self._until_s = min(self._until_s, now_s + timeout_s)
            return False
        self._given_s, self._until_s = now_s, now_s + timeout_s
        return True

    def since_s(self, now_s: float) -> float:
        """Return for how long it has been given."""
        return 0.0 if self._given_s is None else now_s - self._given_s

    def is_to_be_said(self, now_s: float) -> bool:
        """Return whether it is time to repeat it, and count it as repeated."""
        if self._given_s is None or now_s - self._said_s < _REPEAT_S:
            return False
        self._said_s = now_s
        return True

    def is_overdue(self, now_s: float) -> bool:
        """Return whether all should have landed by now."""
        return self._given_s is not None and now_s > self._until_s

    def is_obeyed(self, view: AgentView, now_s: float) -> bool:
        """Return whether an agent is heard landing, and has the time that this takes."""
        status = view.status
        if status is None or not is_landing(view) or view.note == "silent":
            return False
        return status.phase < Phase.DONE and self.since_s(now_s) <= _LANDING_S


def is_landing(view: AgentView) -> bool:
    """Return whether an agent shows that it lands, or has."""
    status = view.status
    return status is not None and status.phase >= Phase.GOTO_LAND and not status.held
