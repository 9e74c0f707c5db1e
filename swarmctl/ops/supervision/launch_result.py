"""The result of a launch, as its supervisor collects it, and the exit code that follows from it."""

from __future__ import annotations

from dataclasses import dataclass, field

from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION, EXIT_OK, EXIT_START


@dataclass(slots=True, kw_only=True)
class LaunchResult:
    """The result of a launch, collected during the flight."""

    problems: list[str] = field(default_factory=list)
    could_not_start: bool = False
    has_armed: bool = False  # an agent has requested arming
    left: tuple[str, ...] = ()  # vehicles that may still be armed or in the air, in words
    interrupted: bool = False  # a stop request, such as Ctrl-C, has landed all
    landed_by_operator: bool = False  # an order to land has ended the mission of an agent

    @property
    def outcome(self) -> str:
        """Outcome as in summary.json."""
        if self.interrupted:
            return "interrupted"
        if self.problems:
            return "failed"
        return "interrupted" if self.landed_by_operator else "completed"

    def exit_code(self, violated: bool) -> int:
        """Return the exit code of the launch; `violated`: the referee found a violation."""
        if self.left:
            return EXIT_MISSION
        if self.interrupted:
            return EXIT_INTERRUPTED
        if self.could_not_start and not self.has_armed:
            return EXIT_START
        if self.landed_by_operator and not (self.problems or violated):
            return EXIT_INTERRUPTED
        return EXIT_MISSION if self.problems or violated else EXIT_OK


def why_it_failed(outcome: str, last_line: str) -> str:
    """Return why an agent failed: the outcome of its mission, and its last line where that says something else.

    A complete mission, or one that an operator has ended, is not what an agent fails for.
    """
    told = "" if outcome in ("completed", OPERATOR_STOP) else outcome
    if told and told in last_line:
        return told
    return "; ".join(filter(None, (told, last_line))) or "no reason given"
