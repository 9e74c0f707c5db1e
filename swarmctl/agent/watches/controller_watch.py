"""Tells when an own controller's commands are not flown, when it is not asked any more, and how often it has flown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from swarmctl.core.types import Phase, Plan

_QUIET_TICKS = 25  # in which its plans are flown again, after which an encounter counts as over


class ControllerWatch:
    """Counts the ticks that an own controller has flown, and those that another one had to fly.

    Args:
        name: what the configuration calls the own controller; "" for a built-in one.
        note: is told `controller_failed`, with `begins=True, why=...` at the first of them, and at the end of them
            `begins=False, ticks=...`; and `controller_raised` with the `traceback` of an exception.

    Attributes:
        suspended: why the mission has to end, because the controller is not asked any more; or "".
    """

    def __init__(self, name: str, note: Callable[..., None]) -> None:
        self._name, self._note = name, note
        self._ticks, self._quiet = 0, 0
        self._flown_ticks = self._mission_ticks = 0
        self.suspended = ""

    @property
    def summary(self) -> dict[str, Any]:
        """Return the controller's name, the ticks in which its own plan was flown and those of missions, or nothing."""
        if not self._name:
            return {}
        return {"controller": self._name, "flown_ticks": self._flown_ticks, "mission_ticks": self._mission_ticks}

    def update(self, plan: Plan | None) -> str:
        """Take in the plan of a tick; returns the text of an alert, or ""."""
        failure = "" if plan is None else plan.failure
        if plan is not None and plan.traceback:
            self._note("controller_raised", traceback=plan.traceback)
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

    def count(self, phase: Phase, plan: Plan | None, flown: Plan | None) -> None:
        """Count a tick: what was planned in it, and what is flown."""
        if phase is Phase.TRACK:
            self._mission_ticks += 1
            self._flown_ticks += plan is not None and plan.by_own and flown is plan
