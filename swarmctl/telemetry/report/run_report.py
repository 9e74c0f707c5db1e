"""Writes `report.html` of a run: one self-contained page below 1 MB, without scripts or network requests."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from swarmctl.files import replace_bytes, replace_text
from swarmctl.telemetry.evaluation.punctuality import LEAST_DUE
from swarmctl.telemetry.evaluation.referee import SUMMED_ERROR, Rules, RunData
from swarmctl.telemetry.evaluation.station_clock import corrected_text
from swarmctl.telemetry.palette import agent_rgb, css
from swarmctl.telemetry.report.event_table import event_rows
from swarmctl.telemetry.report.moments import ordinal
from swarmctl.telemetry.report.pages import render
from swarmctl.telemetry.report.png import png_of
from swarmctl.telemetry.report.run_charts import IN_FLIGHT, RunCharts
from swarmctl.telemetry.report.svg import Figure

REPORT = "report.html"
FIGURES = "figures"
_EVENTS_LISTED = 400


def write_report(
    directory: Path, run: RunData, summary: Mapping[str, Any], config_text: str, *, rules: Rules | None = None
) -> Path:
    """Write the page of a judged run into its folder; returns its path.

    Args:
        directory: the run folder.
        run: the recorded run.
        summary: result of the referee.
        config_text: resolved configuration, shown verbatim.
        rules: limits and obstacles to draw, in addition to those in `summary`.
    """
    charts, path = RunCharts(run, summary, rules), directory / REPORT
    events = list(event_rows(charts.events, charts.time_of))
    missions, tracked_s = charts.flown_missions()
    page = render(
        __package__,
        "report.html",
        name=directory.resolve().name,
        summary=summary,
        flown=_flown(summary, missions, tracked_s),
        time_zero="the start of the first mission" if missions > 1 else charts.time_zero,
        has_moments=bool(charts.moments),
        rows=summary_rows(summary, rules),
        arrivals=arrival_texts(summary["goals"]),
        seen_from_above=charts.seen_from_above(),
        sections=_sections(charts),
        events=events[:_EVENTS_LISTED],
        events_hidden=max(0, len(events) - _EVENTS_LISTED),
        config_text=config_text,
        agent_css=lambda agent: css(agent_rgb(agent)),
        number=_figure,
    )
    replace_text(path, page)
    return path


def write_figures(
    directory: Path, run: RunData, summary: Mapping[str, Any], *, rules: Rules | None = None, png: bool = False
) -> Path:
    """Write every figure of a judged run as SVG, and as PNG too, into `figures/` of its folder; returns that folder.

    Raises:
        StartError: PNG was asked for, and its library is not installed.
    """
    charts, folder = RunCharts(run, summary, rules), directory / FIGURES
    folder.mkdir(exist_ok=True)
    for number, figure in enumerate([charts.seen_from_above(), *itertools.chain(*_sections(charts).values())], 1):
        words = re.sub(r"[^a-z0-9]+", "-", re.sub(r"\[.*?\]", "", figure.heading).lower()).strip("-")
        document, path = figure.as_file(), folder / f"{number:02}-{words}.svg"
        replace_text(path, document)
        if png:
            replace_bytes(path.with_suffix(".png"), png_of(document))
    return folder


def _sections(charts: RunCharts) -> dict[str, Iterator[Figure]]:
    return {
        "Flight": charts.flight(),
        "Position and reference": charts.positions(),
        "Attitude and thrust": charts.attitudes(),
    }


class SummaryRow(NamedTuple):
    """A line of the summary; `good` is None where nothing is judged."""

    name: str
    value: str
    limit: str = ""
    good: bool | None = None
    number: float | None = None  # to compare it with that of another run
    note: str = ""  # what it is


def _flown(summary: Mapping[str, Any], missions: int, tracked_s: float) -> str:
    """Return for how long the mission was flown; of several, the newest and all together."""
    duration = _figure(summary["duration_s"], "s", 1)
    if missions < 2:
        return f"{duration} of mission time"
    return f"{duration} of the {ordinal(missions)} mission, {tracked_s:.1f} s in TRACK"


def summary_rows(summary: Mapping[str, Any], rules: Rules | None) -> Iterator[SummaryRow]:
    """Yield the rows of the table; of those with a limit also whether it is kept."""
    separation, obstacles, timing = summary["separation"], summary["obstacles"], summary["timing"]
    yield _least("smallest separation", separation["min_m"], separation["required_m"])
    if obstacles["min_clearance_m"] is not None:
        yield _least("nearest to an obstacle's centre", obstacles["min_clearance_m"], obstacles["required_m"])
    if corrected := corrected_text(summary.get("clocks")):
        yield SummaryRow("clocks that were corrected", corrected, note="by when ticks arrived at the station")
    yield from _goal_rows(summary.get("goals"))
    due = timing.get("due_ticks") or timing["ticks"]
    share = timing["late_ticks"] / due if due else None
    most = rules.deadline_misses_01 if rules else None
    good = None if share is None or most is None else share <= most
    late = f"{timing['late_ticks']} of {due}"
    limit = "" if most is None else f"{100 * most:.3g}%"
    yield SummaryRow(f"deadline misses {IN_FLIGHT}", late, limit, good, timing["late_ticks"])
    if (worst := timing.get("worst_agent")) and summary["agents"] > 1:
        late, due = f"{worst['late_ticks']} of {worst['due_ticks']}, agent {worst['id']}", worst["due_ticks"]
        good = None if most is None or due < LEAST_DUE else worst["late_ticks"] <= most * due
        yield SummaryRow("the most of one agent", late, limit, good, worst["late_ticks"])
    named = (
        ("summed mean tracking error", "index_m", SUMMED_ERROR),
        ("the same after 10 s", "index_after_10s_m", "without the first 10 s in TRACK"),
    )
    for name, key, note in named:
        error_m = summary["tracking"][key]
        yield SummaryRow(name, _figure(error_m, "m", 3), number=error_m, note=note)
    for name, key in (("tick time", "tick_ms"), ("solve time", "solve_ms")):
        values = " / ".join(_figure(timing[key][part], "", 2) for part in ("p50", "p99", "max"))
        yield SummaryRow(f"{name}, median / p99 / max", f"{values} ms", number=timing[key]["p50"])
    for own in summary.get("own_controllers") or ():
        flown = f"{own['flown_ticks']} of {own['mission_ticks']}"
        yield SummaryRow(f"mission ticks flown by {own['name']}", flown, number=own["flown_ticks"])
    solver, comms = summary["solver"], summary["comms"]
    solvers = " and ".join(dict.fromkeys(filter(None, (solver["name"], solver.get("retry")))))
    yield SummaryRow(f"solver ({solvers}) failures", str(solver["failed"]))
    yield SummaryRow("plans refused by their certificate", str(solver["not_certified"]))
    if (deadlocks := summary.get("deadlocks") or {}).get("count"):
        yield SummaryRow("deadlocks, the longest", f"{deadlocks['count']}, {_figure(deadlocks['longest_s'], 's', 1)}")
    yield SummaryRow("ticks in which the safety filter acted", str(solver.get("safety_filter_ticks", 0)))
    yield SummaryRow("largest residual of a flown plan", _figure(solver["max_residual_m"], "m", 5))
    ages = " / ".join(_figure(comms["path_age_ms"][part], "", 1) for part in ("p50", "p99"))
    yield SummaryRow("plan staleness, median / p99", f"{ages} ms", note="age of the oldest of the peers' newest paths")
    refused = ", ".join(f"{reason} {count}" for reason, count in comms["rejected"].items()) or "none"
    yield SummaryRow("bus messages refused", refused)
    if (unresponsive := comms.get("unresponsive") or {}).get("count"):
        lasted = _figure(unresponsive["longest_s"], "s", 1)
        yield SummaryRow(
            "peers there but unresponsive, the longest",
            f"{unresponsive['count']}, agent-{unresponsive['agent']} {lasted}",
        )
    if timing["speed_factor"] is not None:
        yield SummaryRow("speed", f"{timing['speed_factor']:.3g} x real time")


def _goal_rows(goals: Mapping[str, Any] | None) -> Iterator[SummaryRow]:
    """Yield how many agents have reached their goals; nothing of a mission without goals."""
    if goals is not None:
        times_s = [row["reached_at_s"] for row in goals["agents"] if row["reached_at_s"] is not None]
        note = f"the last after {max(times_s):.1f} s" if times_s else ""
        yield SummaryRow("goals reached", f"{goals['reached']} of {goals['of']}", number=goals["reached"], note=note)


def arrival_texts(goals: Mapping[str, Any] | None) -> dict[int, str]:
    """Return when each agent has reached its goal, or how far it is from there; empty without goals."""
    return {} if goals is None else {row["id"]: _arrival_text(row) for row in goals["agents"]}


def _arrival_text(row: Mapping[str, Any]) -> str:
    if row["reached_at_s"] is not None:
        return f"{row['reached_at_s']:.1f} s"
    return "never began" if row["left_m"] is None else f"{row['left_m']:.2f} m away"


def _least(name: str, value: float | None, limit: float) -> SummaryRow:
    good = None if value is None else value >= limit
    return SummaryRow(name, _figure(value, "m", 3), f"{limit:.3g} m", good, value)


def _figure(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()
