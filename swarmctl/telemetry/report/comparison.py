"""Writes a page that sets runs beside each other: their figures, how they differ in configuration, and their charts."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmctl.core.recorded.tick_record import CURVES, Curve
from swarmctl.core.text import told_apart
from swarmctl.core.types import Array
from swarmctl.files import replace_text
from swarmctl.telemetry.evaluation.referee import Rules, RunData
from swarmctl.telemetry.palette import agent_rgb, css
from swarmctl.telemetry.report.charts import Limit, Line, time_chart
from swarmctl.telemetry.report.pages import render
from swarmctl.telemetry.report.run_charts import IN_FLIGHT, RunCharts
from swarmctl.telemetry.report.run_report import summary_rows
from swarmctl.telemetry.report.svg import Figure

_MOST_TEXT = 120  # characters of a value of the configuration
_BINS = 300  # of a curve, each with the worst value of any agent


class JudgedRun(NamedTuple):
    """A finished run, as it is compared."""

    name: str
    run: RunData
    summary: Mapping[str, Any]
    rules: Rules
    config_text: str


def write_comparison(path: Path, runs: Sequence[JudgedRun]) -> Path:
    """Write the page of two or more runs; returns its path."""
    charts = [RunCharts(judged.run, judged.summary, judged.rules) for judged in runs]
    page = render(
        __package__,
        "comparison.html",
        names=[judged.name for judged in runs],
        summaries=[judged.summary for judged in runs],
        colors=[css(agent_rgb(k)) for k in range(len(runs))],
        rows=list(_figures(runs)),
        differences=list(differences([judged.config_text for judged in runs])),
        charts=list(_charts(runs, charts)),
        from_above=[chart.seen_from_above() for chart in charts],
    )
    replace_text(path, page)
    return path


class _Compared(NamedTuple):
    """A figure of every run, "-" where one has none, and by how much the last differs from the first."""

    name: str
    values: list[str]
    change: str


def _figures(runs: Sequence[JudgedRun]) -> Iterator[_Compared]:
    tables = [{row.name: row for row in summary_rows(judged.summary, judged.rules)} for judged in runs]
    for name in dict.fromkeys(name for table in tables for name in table):
        rows = [table.get(name) for table in tables]
        first, last = (None if row is None else row.number for row in (rows[0], rows[-1]))
        change = f"{last / first - 1.0:+.1%}" if first and last is not None else ""
        yield _Compared(name, ["-" if row is None else row.value for row in rows], change)


def differences(texts: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield every key whose value is not the same in all configurations (TOML), and its values, "" where it is not."""
    trees = [dict(_flat("", tomllib.loads(text))) for text in texts]
    for key in sorted({key for tree in trees for key in tree}):
        values = [tree.get(key, "") for tree in trees]
        if len(set(values)) > 1:
            yield key, told_apart(values, _MOST_TEXT)


def _flat(prefix: str, tree: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(f"{prefix}{key}.", value)
        else:
            yield f"{prefix}{key}", str(value)


def _charts(runs: Sequence[JudgedRun], charts: Sequence[RunCharts]) -> Iterator[Figure]:
    sums = [chart.error_sum() for chart in charts]
    yield _chart("Distances to the reference, summed over agents [m]", runs, sums)
    limits = {judged.rules.required_separation_m for judged in runs}
    lines = [chart.nearest_pair() for chart in charts]
    title = "Smallest distance between two agents [m]"
    yield _chart(title, runs, lines, [Limit(limit_m, f"required {limit_m:g} m") for limit_m in sorted(limits)])
    for name, curve in CURVES.items():
        worst = [_worst(chart, name, curve) for chart in charts]
        if any(len(line["x"]) for line in worst):
            yield _chart(f"{curve.titled(IN_FLIGHT)}, {curve.worst} of all agents", runs, worst)


def _chart(title: str, runs: Sequence[JudgedRun], lines: Sequence[Mapping[str, Array]], limits: Any = ()) -> Figure:
    drawn = [
        Line(x=line["x"], y=line["y"], color=css(agent_rgb(k)), label=judged.name, width=1.6)
        for k, (judged, line) in enumerate(zip(runs, lines, strict=True))
    ]
    ends = [float(value) for line in drawn if len(line.x) for value in line.x[[0, -1]]]
    return time_chart(title, drawn, (min(ends), max(ends)) if ends else (0.0, 1.0), limits=limits, from_zero=True)


def _worst(chart: RunCharts, name: str, curve: Curve) -> dict[str, Array]:
    """Return the worst value of any agent, `y` (B,) in parts of the flight that begin at mission times `x` (B,)."""
    drawn = list(chart.curve_of_agents(name, curve))
    x, y = (np.concatenate([np.zeros(0), *(part[k] for part in drawn)]) for k in range(2))
    x, y = x[np.isfinite(y)], y[np.isfinite(y)]
    if not len(x):
        return {"x": x, "y": y}
    sign = 1.0 if curve.worst == "largest" else -1.0
    edges = np.linspace(x.min(), x.max(), _BINS + 1)
    worst = np.full(_BINS, -np.inf)
    np.maximum.at(worst, np.clip(np.searchsorted(edges, x, side="right") - 1, 0, _BINS - 1), sign * y)
    return {"x": edges[:-1], "y": np.where(np.isfinite(worst), sign * worst, np.nan)}
