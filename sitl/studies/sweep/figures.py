"""Figures of a flight in a sweep: what is taken from the summary, and how flights of one combination are summed up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import pyarrow as pa

from sitl.studies.sweep.points import Axis
from swarmctl.telemetry.evaluation.referee import SUMMED_ERROR

Summary = dict[str, Any]
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One column of the table; `of` returns None where there is nothing to measure."""

    name: str
    text: str
    unit: str
    of: Callable[[Summary], float | None]
    over_seeds: Callable[[Sequence[float]], float] = fmean
    note: str = ""  # how it is computed, where `text` does not say

    @property
    def title(self) -> str:
        """Return what the figure is, with its unit."""
        return f"{self.text} [{self.unit}]" if self.unit else self.text

    @property
    def legend(self) -> str:
        """Return what a column of this name holds."""
        return f"{self.name}: {self.title}" + (f", {self.note}" if self.note else "")


def _agents_mean(name: str) -> Callable[[Summary], float | None]:
    def mean(summary: Summary) -> float | None:
        known = [agent[name] for agent in summary["tracking"]["agents"] if agent[name] is not None]
        return fmean(known) if known else None

    return mean


FIGURES = (
    Figure(
        name="index_m",
        text="summed mean tracking error",
        note=SUMMED_ERROR,
        unit="m",
        of=lambda summary: summary["tracking"]["index_m"],
    ),
    Figure(name="rmse_m", text="tracking RMSE, mean over agents", unit="m", of=_agents_mean("rmse_m")),
    Figure(
        name="steady_rmse_m",
        text="tracking RMSE from 10 s on, mean over agents",
        unit="m",
        of=_agents_mean("steady_rmse_m"),
    ),
    Figure(
        name="min_separation_m",
        text="smallest true distance of two centres",
        unit="m",
        of=lambda summary: summary["separation"]["min_m"],
        over_seeds=min,
    ),
    Figure(
        name="min_clearance_m",
        text="smallest true distance to an obstacle's centre",
        unit="m",
        of=lambda summary: summary["obstacles"]["nearest_m"],
        over_seeds=min,
    ),
    Figure(
        name="plans_failed",
        text="ticks whose solver failed",
        unit="",
        of=lambda summary: summary["solver"]["failed"],
    ),
    Figure(
        name="plans_not_certified",
        text="ticks whose plan was not certified",
        unit="",
        of=lambda summary: summary["solver"]["not_certified"],
    ),
    Figure(
        name="safety_filter_ticks",
        text="ticks in which the safety filter acted",
        unit="",
        of=lambda summary: summary["solver"]["safety_filter_ticks"],
    ),
    Figure(
        name="plan_staleness_p99_ms",
        text="plan staleness, 99th percentile",
        unit="ms",
        of=lambda summary: summary["comms"]["path_age_ms"]["p99"],
    ),
    Figure(name="deadlocks", text="deadlocks", unit="", of=lambda summary: summary["deadlocks"]["count"]),
    Figure(
        name="violations",
        text="violations found by the referee",
        unit="",
        of=lambda summary: len(summary["violations"]),
        over_seeds=sum,
    ),
)
SHOWN = ("index_m", "rmse_m", "min_separation_m", "violations")  # in the terminal, which is narrow


def schema_of(axes: Sequence[Axis]) -> pa.Schema:
    """Return the columns of a sweep's table: the swept keys, the seed, the figures, and who flew it."""
    fields = [
        pa.field(axis.key, pa.float64() if axis.is_number else pa.string(), metadata={"description": "swept key"})
        for axis in axes
    ]
    fields += [pa.field("seed", pa.int64()), pa.field("outcome", pa.string())]
    fields += [
        pa.field(figure.name, pa.float64(), metadata={"unit": figure.unit, "description": figure.text})
        for figure in FIGURES
    ]
    fields += [pa.field("cpu_s", pa.float64(), metadata={"unit": "s", "description": "processor time"})]
    return pa.schema([*fields, pa.field("code", pa.string())])


@dataclass(frozen=True, slots=True, kw_only=True)
class Combination:
    """The flights of one combination of swept values."""

    values: tuple[float | str, ...]  # one for each axis
    flights: int
    completed: int
    figures: dict[str, float | None]  # by name


def combinations(axes: Sequence[Axis], rows: Sequence[Row]) -> list[Combination]:
    """Return one line for each combination that has been flown, in the order of the axes' values."""
    grouped: dict[tuple[float | str, ...], list[Row]] = {}
    for row in rows:
        grouped.setdefault(tuple(row[axis.key] for axis in axes), []).append(row)
    places = [{axis.stored(value): place for place, value in enumerate(axis.values)} for axis in axes]
    asked = [values for values in grouped if all(v in place for v, place in zip(values, places, strict=True))]
    asked.sort(key=lambda values: [place[value] for value, place in zip(values, places, strict=True)])
    return [_combination(values, grouped[values]) for values in asked]


def _combination(values: tuple[float | str, ...], rows: Sequence[Row]) -> Combination:
    figures: dict[str, float | None] = {}
    for figure in FIGURES:
        known = [row[figure.name] for row in rows if row[figure.name] is not None]
        figures[figure.name] = figure.over_seeds(known) if known else None
    completed = sum(row["outcome"] == "completed" for row in rows)
    return Combination(values=values, flights=len(rows), completed=completed, figures=figures)
