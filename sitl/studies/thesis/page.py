"""Output of `swarmctl reproduce`: `report.html`, one page without script or request, and `reproduce.json`."""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

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
from swarmctl.files import replace_text
from swarmctl.telemetry.report_style import STYLE

REPORT = "report.html"
ROWS = "reproduce.json"
_ALL_POINTS = 170_000  # of all lines together, 12 bytes each: keeps the page near 2 MB
_MOST_POINTS = 300  # of one line
_NOT_A_NUMBER = "not finite"

_READING = (
    "Every row is an error, a distance from the goal or a time: lower is better. The ratio is ours over the published "
    "figure, below 1 is better than published; there is none where the thesis prints 0. A limit is what this project "
    "asks of itself; no controller can go below the lower bound: three agents that keep r from each other around one "
    "shared point are at best an equilateral triangle, a sum of sqrt(3) r.",
    "Path plant: every controller acts on the plant itself once in 0.02 s, as in the thesis. Path full: agents fly "
    "simulated autopilots over an ideal MAVLink link, without torques, which a MAVLink vehicle does not tell.",
    "Figures carry the numbers of the thesis. Time is in seconds from mission start, NED: z is negative upwards. The "
    "dashed dark line is the reference, or for angles the setpoint of the attitude controllers. Red boxes in figures "
    "90 to 92 are the extent of the obstacle (solid) and of its keep-out (dashed) on that axis, while the reference "
    "leads through them.",
)
_ERRATA = (
    "Gravity enters the sideways acceleration v' with a plus; (1.11) to (1.18) print a minus, (1.7), (1.9) and (3.3) "
    "need the plus.",
    "Table 1 describes the rotational and the translational drag coefficients the wrong way round; the equations have "
    "them right.",
    "For yaw 0 the roll reference is -asin(u_y), as the general form says; (3.33) loses the sign.",
    "Half a period of the fast trajectory is 314 steps, not 214.",
    "An obstacle constrains an agent that is closer than the visibility distance; (4.2) reads as if farther.",
    "Rotors cannot pull down: the published thrust range of -20 to 20 N is kept only for the published presets.",
)


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
    sections = "".join(_sections(flown, extra))
    links = "".join(f'<a href="#{key}">{FLIGHTS[key]}</a>' for key in flown)
    body = "".join(
        [
            "<h1>The thesis, reproduced</h1>",
            "<p class=sub>Development of a distributed model predictive control framework for autonomous unmanned "
            "aerial vehicle swarms, University of West Attica, 2023: its experiments flown again.</p>",
            *(f"<p class=sub>{html.escape(note)}</p>" for note in extra.notes),
            _tiles(rows, flown),
            _missed(rows),
            f"<nav>{links}</nav>" if links else "",
            _rows_table(rows),
            _flights_table(flown),
            '<h2>How to read this</h2><div class="card prose">',
            *(f"<p>{text}</p>" for text in _READING),
            "<p>Where the text of the thesis contradicts itself, the consistent form is built:</p><ul>",
            *(f"<li>{text}</li>" for text in _ERRATA),
            "</ul></div>",
            sections,
        ]
    )
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>reproduce</title>'
    page_html = f"<head>{head}<style>{STYLE}</style></head><body><main>{body}</main></body>"
    path = directory / REPORT
    replace_text(path, f"<!doctype html><html lang=en>{page_html}</html>\n")
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
    broken = [
        f"{key} is {_NOT_A_NUMBER}" for key, value in numbers.items() if value is not None and _finite(value) is None
    ]
    return {
        "name": row.name,
        "published": _finite(row.published),
        "ours": _finite(row.ours),
        "limit": _finite(row.limit),
        "path": row.path,
        "unit": row.unit,
        "note": "; ".join([*([row.note] if row.note else []), *broken]),
        "ratio": ratio(row),
        "least": _finite(row.lower_bound),
        "met": row.met,
    }


def _tiles(rows: Sequence[Row], flown: Mapping[FlightName, Sequence[Trace]]) -> str:
    judged = [row for row in rows if row.met is not None]
    met = sum(bool(row.met) for row in judged)
    ratios = [value for value in map(ratio, rows) if value is not None]
    figures = sum(figure.flight in flown for figure in FIGURES)
    failed = sum(trace.failed for traces in flown.values() for trace in traces)
    tiles = [
        (f"{met} of {len(judged)}", "limits met", "ok" if met == len(judged) else ""),
        (str(len(judged) - met), "limits missed", "bad" if met < len(judged) else ""),
        (f"{sum(value <= 1 for value in ratios)} of {len(ratios)}", "at least as good as published", ""),
        (f"{figures} of {len(FIGURES)}", "figures reproduced", ""),
        (str(failed), "plans that could not be flown", ""),
    ]
    cards = "".join(
        f'<div class=card><b class="{style}">{value}</b><span>{word}</span></div>' for value, word, style in tiles
    )
    return f"<div class=tiles>{cards}</div>"


def _missed(rows: Sequence[Row]) -> str:
    items = "".join(
        f"<li>{html.escape(row.name)}: {_number(row.ours)} {html.escape(row.unit)}, limit {_number(row.limit)}</li>"
        for row in rows
        if row.met is False
    )
    return f"<ul class=violations>{items}</ul>" if items else ""


def _rows_table(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    names = ("", "published", "ours", "ratio", "limit", "lower bound", "unit", "path", "", "note")
    head = "".join(f'<th class="{"n" if 0 < k < 6 else ""}">{name}</th>' for k, name in enumerate(names))
    parts = []
    for key, title in [*FLIGHTS.items(), (None, "Other")]:
        group = [row for row in rows if flight_of(row.name) == key]
        if group:
            parts.append(f"<tr><th class=group colspan={len(names)}>{title}</th></tr>")
            parts += map(_row, group)
    return f'<h2>Published and ours</h2><div class="card wide"><table><tr>{head}</tr>{"".join(parts)}</table></div>'


def _row(row: Row) -> str:
    share = ratio(row)
    numbers = (_number(row.published), _number(row.ours), "" if share is None else f"{share:.2f}", _number(row.limit))
    cells = "".join(f"<td class=n>{number}</td>" for number in (*numbers, _number(row.lower_bound)))
    verdict = {None: "", True: '<span class="ok">met</span>', False: '<span class="bad">missed</span>'}[row.met]
    return (
        f"<tr><td>{html.escape(row.name)}</td>{cells}<td>{html.escape(row.unit)}</td><td>{row.path}</td>"
        f"<td>{verdict}</td><td class=note>{html.escape(row.note)}</td></tr>"
    )


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if math.isfinite(value) else _NOT_A_NUMBER


def _count(value: int | None) -> str:
    return "-" if value is None else str(value)


def _flights_table(flown: Mapping[FlightName, Sequence[Trace]]) -> str:
    rows = "".join(
        f"<tr><td>{FLIGHTS[key]}</td><td>{html.escape(trace.name)}</td><td>{trace.path}</td>"
        f"<td class=n>{trace.pos_ned_m.shape[1]}</td><td class=n>{trace.t_s[-1] if len(trace.t_s) else 0:.1f}</td>"
        f"<td class=n>{trace.failed}</td><td class=n>{_count(trace.terminal_missed)}</td></tr>"
        for key, traces in flown.items()
        for trace in traces
    )
    head = (
        "<tr><th>flight</th><th>trace</th><th>path</th><th class=n>agents</th><th class=n>seconds</th>"
        "<th class=n>plans not flyable</th><th class=n>terminal condition missed</th></tr>"
    )
    if not flown:
        return ""
    count = sum(map(len, flown.values()))
    table = f"<div class=wide><table>{head}{rows}</table></div>"
    return f"<h2>Flights</h2><details class=card><summary>{count} flights drawn below</summary>{table}</details>"


def _sections(flown: Mapping[FlightName, Sequence[Trace]], extra: Extra) -> Iterator[str]:
    lines = sum(len(flown.get(figure.flight, ())) + 1 for figure in FIGURES) + 12 * len(flown)
    points = max(60, min(_MOST_POINTS, _ALL_POINTS // lines))
    for key, traces in flown.items():
        own = [figure for figure in FIGURES if figure.flight == key]
        yield f'<h2 id="{key}">{FLIGHTS[key]}: {_span([figure.number for figure in own])}</h2>'
        yield f'<div class="cards {"big" if key == "open_loop" else "halves"}">'
        yield from (_anchored(f.number, draw(f, traces, points)) for f in own if f.drawn in ("space", "states"))
        yield from _further(key, traces, extra, points)
        yield '</div><div class="cards small">'
        yield from (_anchored(f.number, draw(f, traces, points)) for f in own if f.drawn not in ("space", "states"))
        yield "</div>"
    if extra.index:
        yield '<h2 id="index">Tracking index and constraint radius</h2>'
        yield f'<div class="cards halves">{index_chart(extra.index)}</div>'


def _further(key: FlightName, traces: Sequence[Trace], extra: Extra, points: int) -> Iterator[str]:
    """Draw the charts that the thesis does not have."""
    if traces[0].obstacles:
        yield above_chart(traces[0], points)
    if key != "open_loop":
        yield error_chart(key, traces, extra.separation_m, points)
    if key in SWARMS:
        yield separation_chart(key, traces, extra.separation_m, points)
    if traces[0].obstacles:
        yield obstacle_chart(traces, points)


def _anchored(number: int, drawing: str) -> str:
    return drawing.replace("<figure>", f'<figure id="figure-{number}">', 1)


def _span(numbers: Sequence[int]) -> str:
    return f"figures {numbers[0]} to {numbers[-1]}" if len(numbers) > 1 else f"figure {numbers[0]}"
