"""How long ticks took, and how many missed their deadline: of all agents together, and of the worst one. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.telemetry.evaluation.run_counts import percentiles
from swarmctl.telemetry.evaluation.tracks import flight_rows

LEAST_DUE = 500  # ticks of an agent that is judged by itself, 10 s at 50 Hz: one stall of 2 s is no fifth of them


@dataclass(frozen=True, slots=True, kw_only=True)
class Lateness:
    """Holds how many ticks were due, and how many of them missed their deadline."""

    due: int
    late: int

    @property
    def late_01(self) -> float:
        """Return the fraction that is late."""
        return self.late / self.due if self.due else 0.0

    def above(self, limit_01: float) -> str:
        """Return in words that more than a limit are late; "" if not."""
        if self.late <= limit_01 * self.due:
            return ""
        return f"{self.late_01:.1%} above {limit_01:.1%} ({self.late} of {self.due} due)"


def lateness_of(flights: Sequence[NDArray[np.void]]) -> Lateness:
    """Count over the flights of agents, from arming to the end of landing.

    Of the deadlines missed between two ticks at most one belongs to a flown tick; the others were due but skipped.
    """
    steps = [np.maximum(np.diff(rows["deadline_misses"].astype(np.int64)), 0) for rows in flights]
    skipped = sum(int(np.maximum(step - 1, 0).sum()) for step in steps)
    return Lateness(due=sum(map(len, flights)) + skipped, late=sum(int(step.sum()) for step in steps))


def evaluate_timing(
    ticks: Mapping[int, NDArray[np.void]], limit_01: float, speed_factor: float | None
) -> tuple[dict[str, Any], list[str]]:
    """Summarise tick times, solve times and deadline misses between arming and the end of landing.

    Many punctual agents would hide a late one, so the worst is judged by the same limit where it has flown for a while.

    Args:
        ticks: by agent, rows of TICK_DTYPE.
        limit_01: largest fraction of deadlines missed.
        speed_factor: simulated seconds per wall second.

    Returns:
        the section of the summary, and violations.
    """
    flights = {agent: flight_rows(rows) for agent, rows in ticks.items()}
    together = lateness_of(list(flights.values()))
    each = {agent: lateness_of([rows]) for agent, rows in flights.items()}
    worst = max(each, key=lambda agent: each[agent].late_01, default=None)
    timing = {
        "ticks": sum(map(len, flights.values())),
        "due_ticks": together.due,
        "late_ticks": together.late,
        "worst_agent": None
        if worst is None or not each[worst].late
        else {"id": worst, "due_ticks": each[worst].due, "late_ticks": each[worst].late},
        "tick_ms": percentiles([rows["tick_ms"] for rows in flights.values()]),
        "solve_ms": percentiles([rows["solve_ms"][rows["iterations"] > 0] for rows in flights.values()]),
        "speed_factor": speed_factor,
    }
    if said := together.above(limit_01):
        return timing, [f"deadline misses {said}"]
    judged = {agent: found for agent, found in each.items() if found.due >= LEAST_DUE and found.above(limit_01)}
    if not judged:
        return timing, []
    latest = max(judged, key=lambda agent: judged[agent].late_01)
    more = f", and of {len(judged) - 1} more agents" if judged.keys() - {latest} else ""
    return timing, [f"deadline misses of agent {latest} {judged[latest].above(limit_01)}{more}"]
