"""`report.html` of a sweep: a chart of every figure over the first swept key, and the table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from sitl.studies.sweep.figures import FIGURES, Combination, Figure
from sitl.studies.sweep.points import Axis
from swarmctl.files import replace_text
from swarmctl.telemetry.report.charts import agent_line, time_chart
from swarmctl.telemetry.report.pages import render

REPORT = "report.html"
_MAX_LINES = 20
_ROOM_01 = 0.02  # of the axis beside the first and last value, for their dots


def write_page(
    directory: Path, axes: Sequence[Axis], found: Sequence[Combination], code: str, *, config_text: str
) -> Path:
    """Write the report of all combinations into the sweep's folder and return its path."""
    path = directory / REPORT
    page = render(
        __package__,
        "sweep.html",
        name=directory.resolve().name,
        axes=axes,
        found=found,
        flights=sum(one.flights for one in found),
        figures=[figure for figure in FIGURES if any(one.figures[figure.name] is not None for one in found)],
        charts=charts(axes, found),
        cell=cell_text,
        code=code,
        config_text=config_text,
    )
    replace_text(path, page)
    return path


def charts(axes: Sequence[Axis], found: Sequence[Combination]) -> list[Markup]:
    """Return a chart of each figure that differs, a line for each combination of the keys that are not across."""
    across = next((k for k, axis in enumerate(axes) if axis.is_number and len(axis.values) > 1), 0)
    drawn = []
    for figure in FIGURES:
        known = {one.figures[figure.name] for one in found} - {None}
        if len(known) > 1:
            drawn.append(_chart(figure, axes, across, found))
    return drawn


def _chart(figure: Figure, axes: Sequence[Axis], across: int, found: Sequence[Combination]) -> Markup:
    axis = axes[across]
    stored = [axis.stored(value) for value in axis.values]
    place = {value: float(value) if axis.is_number else float(k) for k, value in enumerate(stored)}
    grouped: dict[str, list[Combination]] = {}
    for one in found:
        grouped.setdefault(_others(axes, across, one), []).append(one)
    lines = []
    for number, (label, ones) in enumerate(list(grouped.items())[:_MAX_LINES]):
        points = sorted((place[one.values[across]], one.figures[figure.name]) for one in ones)
        x, y = np.array([[at, math.nan if value is None else value] for at, value in points], np.float64).T
        lines.append(agent_line(number, x, y, label=label, marks=True))
    words = "" if axis.is_number else " (" + ", ".join(f"{k}: {value}" for k, value in enumerate(axis.values)) + ")"
    low, high = min(place.values()), max(place.values())
    shown = (low - _ROOM_01 * (high - low), high + _ROOM_01 * (high - low))
    return time_chart(f"{figure.title} over {axis.key}{words}", lines, shown, x_unit="")


def _others(axes: Sequence[Axis], across: int, one: Combination) -> str:
    """Return the values of the keys that are not on the horizontal axis and have several, in words."""
    swept = [k for k, axis in enumerate(axes) if k != across and len(axis.values) > 1]
    return ", ".join(f"{axes[k].key} = {cell_text(one.values[k])}" for k in swept)


def cell_text(value: float | str | None) -> str:
    """Return a value as it is in tables."""
    return "-" if value is None else value if isinstance(value, str) else f"{value:.4g}"
