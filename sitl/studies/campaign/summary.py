"""Summary of each cell's rows: counts with exact intervals, times and distances. No formatting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, median

from sitl.studies.campaign.trials import Cell, Row, cell_of, is_flown


@dataclass(frozen=True, slots=True)
class Share:
    """Frequency of an outcome."""

    hits: int
    trials: int

    @property
    def share(self) -> float:
        """Return hits over trials, 0 to 1; 0 without a trial."""
        return self.hits / self.trials if self.trials else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """Exact 95 % interval (Clopper and Pearson); 0..1 without trials."""
        from scipy.stats import binomtest  # imports for a second, needed by reports only

        if not self.trials:
            return 0.0, 1.0
        low, high = binomtest(self.hits, self.trials).proportion_ci(0.95, method="exact")
        return float(low), float(high)


@dataclass(frozen=True, slots=True, kw_only=True)
class CellSummary:
    """One line of the report; None where nothing was measured."""

    cell: Cell
    not_flown: int  # runs that an error ended
    collided: Share  # of the runs that were flown
    arrived: Share  # of all runs in which somebody was expected to
    deadlocked: Share  # of the runs that were flown
    min_separation_m: float | None  # of all runs
    min_clearance_m: float | None
    time_median_s: float | None  # of the runs that arrived
    time_max_s: float | None
    time_relative: float | None  # median of flight time relative to the single-agent time
    sum_relative: float | None  # largest ratio of the sum of goal distances to its theoretical lower bound
    plans_failed: float  # mean per run that was flown
    commits_refused: float
    safety_filter_acted: float
    cpu_s: float


def summaries(rows: Sequence[Row]) -> list[CellSummary]:
    """Return one summary per cell, in the cells' order."""
    grouped: dict[Cell, list[Row]] = {}
    for row in rows:
        grouped.setdefault(cell_of(row), []).append(row)
    return [_summary(cell, grouped[cell]) for cell in sorted(grouped)]


def _summary(cell: Cell, asked: Sequence[Row]) -> CellSummary:
    rows = [row for row in asked if is_flown(row)]
    times = [row["flight_time_s"] for row in rows if row["flight_time_s"] is not None]
    ratios = _ratios(rows, "flight_time_s", "unconstrained_time_s")
    sums = _ratios([row for row in rows if row["arrived"]], "goal_sum_m", "least_sum_m")
    return CellSummary(
        cell=cell,
        not_flown=len(asked) - len(rows),
        collided=_count(asked, "collided"),
        arrived=_count(asked, "arrived"),
        deadlocked=_count(asked, "deadlocked"),
        min_separation_m=_least(rows, "min_separation_m"),
        min_clearance_m=_least(rows, "min_clearance_m"),
        time_median_s=median(times) if times else None,
        time_max_s=max(times, default=None),
        time_relative=median(ratios) if ratios else None,
        sum_relative=max(sums, default=None),
        plans_failed=_mean(rows, "plans_failed"),
        commits_refused=_mean(rows, "commits_refused"),
        safety_filter_acted=_mean(rows, "safety_filter_acted"),
        cpu_s=_mean(rows, "cpu_s"),
    )


def _mean(rows: Sequence[Row], name: str) -> float:
    return fmean(row[name] or 0 for row in rows) if rows else 0.0


def _count(rows: Sequence[Row], name: str) -> Share:
    known = [row[name] for row in rows if row[name] is not None]
    return Share(sum(known), len(known))


def _least(rows: Sequence[Row], name: str) -> float | None:
    return min((row[name] for row in rows if row[name] is not None), default=None)


def _ratios(rows: Sequence[Row], above: str, below: str) -> list[float]:
    return [row[above] / row[below] for row in rows if row[above] is not None and row[below]]
