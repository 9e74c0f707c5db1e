"""Tells when an own controller's commands are not flown, and when it is not asked any more."""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.core.types import Plan

_QUIET_TICKS = 25  # in which its plans are flown again, after which an encounter counts as over


class ControllerWatch:
    """Counts the ticks that another controller had to fly.

    Args:
        note: is told `controller_failed`, with `begins=True, why=...` at the first of them, and at the end of them
            `begins=False, ticks=...`.

    Attributes:
        suspended: why the mission has to end, because the controller is not asked any more; or "".
    """

    def __init__(self, note: Callable[..., None]) -> None:
        self._note = note
        self._ticks, self._quiet = 0, 0
        self.suspended = ""

    def update(self, plan: Plan | None) -> str:
        """Take in the plan of a tick; returns the text of an alert, or ""."""
        failure = "" if plan is None else plan.failure
        if plan is not None and plan.suspended and not self.suspended:
            self.suspended = failure
            self._note("controller_failed", begins=True, why=failure)
        elif failure and not self._ticks:
            self._note("controller_failed", begins=True, why=failure)
        if failure:
            self._ticks, self._quiet = self._ticks + 1, 0
        elif self._ticks:
            self._quiet += 1
            if self._quiet >= _QUIET_TICKS:
                self._note("controller_failed", begins=False, ticks=self._ticks)
                self._ticks = 0
        return f"{failure}: the built-in one flies" if failure else ""
