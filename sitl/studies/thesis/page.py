"""Output of `swarmctl reproduce`: `report.html`, one page without script or request, and `reproduce.json`."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from markupsafe import Markup

from sitl.studies.thesis.figures import (
    FIGURES,
    FLIGHTS,
    SWARMS,
    Extra,
    FlightName,
    above_chart,
    draw,
    error_chart,
    index_chart,
    obstacle_chart,
    separation_chart,
)
from sitl.studies.thesis.trace import Row, Trace
from sitl.studies.thesis.verdicts import MEANING, counted, counts_text, preset_differences, verdict_of
from swarmctl.files import replace_text
from swarmctl.telemetry.report.pages import render

REPORT = "report.html"
ROWS = "reproduce.json"
_ALL_POINTS = 170_000  # of all lines together, 12 bytes each: keeps the page near 2 MB
_MOST_POINTS = 300  # of one line
_NOT_A_NUMBER = "not finite"


def write_page(
    directory: Path,
    rows: Sequence[Row],
    traces: Mapping[str, Sequence[Trace]],
    extra: Extra | None = None,
) -> Path:
    """Write the page and return its path; flights without traces leave their figures out.

    Args:
        directory: exists.
        rows: results, grouped by the flight in their names, see `flight_of`.
        traces: by key of `FLIGHTS`; of each the published preset on the plant first.
        extra: constraint radii, points of Table 19, notes.

    Raises:
        ValueError: a flight is not known.
        OSError: the disk refuses; an earlier page is untouched.
    """
    unknown = sorted(set(traces) - set(FLIGHTS))
    if unknown:
        raise ValueError(f"traces: unknown flights {unknown}; known are {list(FLIGHTS)}")
    extra = extra or Extra()
    flown: dict[FlightName, Sequence[Trace]] = {key: traces[key] for key in FLIGHTS if traces.get(key)}
    lines = sum(len(flown.get(figure.flight, ())) + 1 for figure in FIGURES) + 12 * len(flown)
    points = max(60, min(_MOST_POINTS, _ALL_POINTS // lines))
    path = directory / REPORT
    page = render(
        __package__,
        "reproduce.html",
        rows=rows,
        flights=FLIGHTS,
        figures=FIGURES,
        flown=flown,
        notes=extra.notes,
        draw=partial(draw, points=points),
        further=partial(_further, extra=extra, points=points),
        index_chart=index_chart(extra.index) if extra.index else None,
        flight_of=flight_of,
        ratio=ratio,
        counts=counted(rows),
        counts_text=counts_text(counted(rows)),
        meaning=MEANING,
        verdict_of=verdict_of,
        presets=preset_differences(rows),
        number=_number,
    )
    replace_text(path, page)
    return path


def write_json(directory: Path, rows: Sequence[Row]) -> Path:
    """Write `{"rows": [...]}`; a number that is none or not finite is null, and the note says so.

    Raises:
        OSError: the disk refuses; an earlier file is untouched.
    """
    path = directory / ROWS
    replace_text(path, json.dumps({"rows": [_json_row(row) for row in rows]}, indent=1, allow_nan=False) + "\n")
    return path


def ratio(row: Row) -> float | None:
    """Return ours over published; None where the thesis has no figure or prints 0."""
    if row.published is None or row.published == 0.0:
        return None
    return _finite(row.ours / row.published)


def flight_of(name: str) -> FlightName | None:
    """Return the flight in a row's name: all words of its key occur, in any order; the longest key wins."""
    words = set(re.split(r"[^a-z0-9]+", name.lower()))
    spoken: list[FlightName] = [key for key in FLIGHTS if words.issuperset(key.split("_"))]
    return max(spoken, key=len, default=None)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _json_row(row: Row) -> dict[str, Any]:
    numbers = {"published": row.published, "ours": row.ours, "limit": row.limit, "least": row.lower_bound}
    known = {key: _finite(value) for key, value in numbers.items()}
    broken = [f"{key} is {_NOT_A_NUMBER}" for key, value in numbers.items() if value != known[key]]
    least = known.pop("least")
    note = "; ".join([*([row.note] if row.note else []), *broken])
    texts = {"path": row.path, "unit": row.unit, "note": note}
    return {
        "name": row.name,
        **known,
        **texts,
        "ratio": ratio(row),
        "least": least,
        "least_source": row.bound_source,
        "met": row.met,
        "out_of_reach": row.out_of_reach,
        "beside": row.beside,
        "preset": row.preset,
        "differs": list(row.differs),
    }


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if math.isfinite(value) else _NOT_A_NUMBER


def _further(key: FlightName, traces: Sequence[Trace], extra: Extra, points: int) -> Iterator[Markup]:
    """Draw the charts that the thesis does not have."""
    if traces[0].obstacles:
        yield above_chart(traces[0])
    if key != "open_loop":
        yield error_chart(key, traces, extra.separation_m, points)
    if key in SWARMS:
        yield separation_chart(key, traces, extra.separation_m, points)
    if traces[0].obstacles:
        yield obstacle_chart(traces, points)
