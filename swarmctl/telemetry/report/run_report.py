"""Writes `report.html` of a run: one self-contained page below 1 MB, without scripts or network requests."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.tick_record import CURVES, Curve
from swarmctl.core.types import Array, Mode, Phase
from swarmctl.files import replace_text
from swarmctl.telemetry.evaluation.attitude import roll_pitch_rad
from swarmctl.telemetry.evaluation.referee import SUMMED_ERROR, Rules, RunData
from swarmctl.telemetry.evaluation.tracks import (
    Tracks,
    flight_rows,
    merge_tracks,
    mission_start_us,
    track_error,
    tracking_rows,
    true_positions,
)
from swarmctl.telemetry.palette import MODE_RGB, PHASE_RGB, REFERENCE_RGB, SUM_RGB, agent_rgb, css
from swarmctl.telemetry.report.charts import (
    Ball,
    Limit,
    Line,
    Span,
    agent_line,
    reference_line,
    state_bars,
    time_chart,
    top_view,
)
from swarmctl.telemetry.report.pages import render

REPORT = "report.html"
_ALL_POINTS = 42_000  # points of all lines together, 13 bytes each: keeps the page below 1 MB
_DETAILED_AGENTS = 6  # number of agents with attitude charts
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
    charts = _Charts(run, summary, rules)
    path = directory / REPORT
    page = render(
        __package__,
        "report.html",
        name=directory.resolve().name,
        summary=summary,
        rows=_summary_rows(summary, rules),
        seen_from_above=charts.seen_from_above(),
        sections={
            "Flight": charts.flight(),
            "Position and reference": charts.positions(),
            "Attitude and thrust": charts.attitudes(),
        },
        events=charts.event_rows(),
        events_hidden=max(0, len(run.events) - _EVENTS_LISTED),
        config_text=config_text,
        agent_css=lambda agent: css(agent_rgb(agent)),
        number=_figure,
    )
    replace_text(path, page)
    return path


class _Row(NamedTuple):
    """A line of the summary; `good` is None where nothing is judged."""

    name: str
    value: str
    limit: str = ""
    good: bool | None = None


class _Charts:
    """Draws the charts of one run on a common time axis."""

    def __init__(self, run: RunData, summary: Mapping[str, Any], rules: Rules | None) -> None:
        self._run = run
        self._summary = summary
        self._rules = rules
        agents = int(summary["agents"])
        self._tracks: Tracks = merge_tracks(run.ticks, run.truth, agents)
        self._time_field = "t_us" if len(run.truth) else "utc_us"
        start_us = mission_start_us(run.ticks, self._time_field)
        first_us = min((int(rows[self._time_field][0]) for rows in run.ticks.values() if len(rows)), default=0)
        self._start_us = first_us if start_us is None else start_us
        ends = [self._seconds(rows[[0, -1]]) for rows in run.ticks.values() if len(rows)]
        self._range = (min(e[0] for e in ends), max(e[1] for e in ends)) if ends else (0.0, 1.0)
        missions = [self._seconds(rows[[0, -1]]) for rows in map(tracking_rows, run.ticks.values()) if len(rows)]
        self._band = (min(m[0] for m in missions), max(m[1] for m in missions)) if missions else None
        self._agents = sorted(agent for agent in run.ticks if agent < agents)
        lines = (9 + len(CURVES)) * len(self._agents) + 6 * min(_DETAILED_AGENTS, len(self._agents)) + 8
        self._points = int(np.clip(_ALL_POINTS // lines, 40, 600))

    def _seconds(self, rows: NDArray[np.void]) -> Array:
        return np.asarray((rows[self._time_field] - self._start_us) / 1e6, np.float64)

    def _chart(self, title: str, lines: list[Line], **options: Any) -> Markup:
        return time_chart(title, lines, self._range, band=self._band, points=self._points, **options)

    def seen_from_above(self) -> Markup:
        lines = []
        for agent in self._agents:
            rows = tracking_rows(self._run.ticks[agent])
            if len(rows) and agent == self._agents[0]:
                ref = rows["ref_pos_ned_m"]
                lines.append(reference_line(ref[:, 1], ref[:, 0], dash="4 4", width=2.0, color=css(REFERENCE_RGB)))
        for agent in self._agents:
            rows = flight_rows(self._run.ticks[agent])
            pos_ned_m = true_positions(rows, self._run.truth, agent)
            lines.append(agent_line(agent, pos_ned_m[:, 1], pos_ned_m[:, 0], width=1.6))
        obstacles = [judged.obstacle for judged in self._rules.obstacles] if self._rules else []
        balls = [Ball(obstacle.center_ned_m, obstacle.keep_out_m, "keepout") for obstacle in obstacles]
        return top_view("From above: north up, east right [m]", lines, balls, self._points)

    def flight(self) -> Iterator[Markup]:
        yield self._tracking_error()
        yield self._separation()
        yield from (self._curve(name, curve) for name, curve in CURVES.items())
        yield state_bars("Phase of the mission", self._spans("phase", Phase, PHASE_RGB), self._range)
        yield state_bars("What the agent did", self._spans("mode", Mode, MODE_RGB), self._range)

    def positions(self) -> Iterator[Markup]:
        for k, axis in enumerate(("x north", "y east", "z down")):
            lines = []
            for agent in self._agents:
                rows = flight_rows(self._run.ticks[agent])
                pos_ned_m = true_positions(rows, self._run.truth, agent)
                lines.append(agent_line(agent, self._seconds(rows), pos_ned_m[:, k]))
            shown: dict[bytes, tuple[int, NDArray[np.void]]] = {}  # different references only, one if all share it
            for agent in self._agents:
                rows = tracking_rows(self._run.ticks[agent])
                shown.setdefault(np.round(rows["ref_pos_ned_m"][-1:, k], 1).tobytes(), (agent, rows))
            lines += [
                reference_line(self._seconds(rows), rows["ref_pos_ned_m"][:, k])
                for _, rows in shown.values()
                if len(rows)
            ][:4]
            yield self._chart(f"{axis} [m]", lines)

    def attitudes(self) -> Iterator[Markup]:
        for agent in self._agents[:_DETAILED_AGENTS]:
            rows = flight_rows(self._run.ticks[agent])
            flown = partial(agent_line, agent, self._seconds(rows))
            asked = partial(reference_line, self._seconds(rows), dash="3 3", width=1.0)
            asked_rad, had_rad = roll_pitch_rad(rows["setpoint_q_nb"]), roll_pitch_rad(rows["q_nb"])
            for k, name in enumerate(("roll", "pitch")):
                lines = [
                    flown(np.degrees(had_rad[:, k]), "measured"),
                    asked(np.degrees(asked_rad[:, k]), "setpoint"),
                ]
                yield self._chart(f"Agent {agent}: {name} [deg]", lines, height=140)
            lines = [
                flown(rows["setpoint_thrust_01"], "setpoint"),
                asked(rows["hover_thrust_01"], "hover estimate"),
            ]
            yield self._chart(f"Agent {agent}: thrust [0..1]", lines, height=140)

    def event_rows(self) -> Iterator[tuple[str, object, object, str]]:
        """Yield seconds, source, name and fields of the first events."""
        offset_us = self._start_us if self._time_field == "utc_us" else None
        for event in self._run.events[:_EVENTS_LISTED]:
            stamp = event.get("utc_us" if offset_us is not None else "t_us")
            at = f"{(stamp - self._start_us) / 1e6:.2f}" if isinstance(stamp, (int, float)) else ""
            rest = ", ".join(f"{k}={v}" for k, v in event.items() if k not in ("utc_us", "t_us", "source", "event"))
            yield at, event.get("source", ""), event.get("event", ""), rest[:300]

    def _tracking_error(self) -> Markup:
        lines, errors = [], []
        for agent in self._agents:
            error = track_error(self._run.ticks[agent], self._run.truth, agent)
            if len(error.mission_t_s):
                errors.append(error)
                lines.append(agent_line(agent, error.mission_t_s, error.distance_m))
        if len(errors) > 1:
            longest = max(errors, key=lambda error: len(error.mission_t_s)).mission_t_s
            sums = [np.interp(longest, e.mission_t_s, e.distance_m, np.nan, np.nan) for e in errors]
            lines.append(Line(x=longest, y=np.sum(sums, axis=0), color=css(SUM_RGB), label="sum", width=1.8))
        return self._chart("Distance to the reference [m]", lines, from_zero=True)

    def _separation(self) -> Markup:
        required_m = float(self._summary["separation"]["required_m"])
        lines = []
        if len(self._tracks.pos_ned_m) and self._tracks.pos_ned_m.shape[1] > 1:
            seconds, least_m = (self._tracks.t_us - self._start_us) / 1e6, closest_pair_m(self._tracks.pos_ned_m)
            lines = [Line(x=seconds, y=least_m, color="#0f766e", label="nearest pair", width=1.6)]
        limit = Limit(required_m, f"required {required_m:g} m")
        return self._chart("Smallest distance between two agents [m]", lines, limits=[limit], from_zero=True)

    def _curve(self, name: str, curve: Curve) -> Markup:
        lines, peaks = [], []
        for agent in self._agents:
            rows = flight_rows(self._run.ticks[agent])
            rows = rows if curve.where is None else rows[curve.where(rows)]
            lines.append(
                Line(
                    x=self._seconds(rows),
                    y=np.asarray(rows[name], np.float64),
                    color=css(agent_rgb(agent)),
                    label=f"agent {agent}",
                    width=1.0,
                    opacity=0.8,
                )
            )
            peaks += [float(np.nanpercentile(rows[name], 99.9))] if np.isfinite(rows[name]).any() else []
        ceiling = 1.5 * max(peaks) if peaks and not curve.is_count else None
        return self._chart(curve.title, lines, from_zero=True, ceiling=ceiling)

    def _spans(self, name: str, kind: Any, colors: Mapping[str, tuple[int, int, int]]) -> list[tuple[str, list[Span]]]:
        result = []
        for agent in self._agents:
            rows = self._run.ticks[agent]
            seconds, values = self._seconds(rows), rows[name]
            edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(rows)] if len(rows) else [0]
            spans = []
            for first, last in itertools.pairwise(edges):
                word = kind(int(values[first])).name if int(values[first]) in list(kind) else str(values[first])
                end = float(seconds[min(last, len(rows) - 1)])
                spans.append(Span(float(seconds[first]), end, word, css(colors.get(word, SUM_RGB))))
            result.append((f"agent {agent}", spans))
        return result


def _summary_rows(summary: Mapping[str, Any], rules: Rules | None) -> Iterator[_Row]:
    """Yield the rows of the table; of those with a limit also whether it is kept."""
    separation, obstacles, timing = summary["separation"], summary["obstacles"], summary["timing"]
    yield _least("smallest separation", separation["min_m"], separation["required_m"])
    if obstacles["min_clearance_m"] is not None:
        yield _least("nearest to an obstacle's centre", obstacles["min_clearance_m"], obstacles["required_m"])
    due = timing.get("due_ticks") or timing["ticks"]
    share = timing["late_ticks"] / due if due else None
    most = rules.deadline_misses_01 if rules else None
    good = None if share is None or most is None else share <= most
    late = f"{timing['late_ticks']} of {due}"
    yield _Row("deadline misses", late, "" if most is None else f"{most:.0%}", good)
    yield _Row(f"summed mean tracking error ({SUMMED_ERROR})", _figure(summary["tracking"]["index_m"], "m", 3))
    yield _Row("the same after 10 s", _figure(summary["tracking"]["index_after_10s_m"], "m", 3))
    for name, key in (("tick time", "tick_ms"), ("solve time", "solve_ms")):
        values = " / ".join(_figure(timing[key][part], "", 2) for part in ("p50", "p99", "max"))
        yield _Row(f"{name}, median / p99 / max", f"{values} ms")
    solver, comms = summary["solver"], summary["comms"]
    yield _Row(f"solver ({solver['name']}) failures", str(solver["failed"]))
    yield _Row("plans refused by their certificate", str(solver["not_certified"]))
    if (deadlocks := summary.get("deadlocks") or {}).get("count"):
        yield _Row("deadlocks, the longest", f"{deadlocks['count']}, {_figure(deadlocks['longest_s'], 's', 1)}")
    yield _Row("ticks in which the safety filter acted", str(solver.get("safety_filter_ticks", 0)))
    yield _Row("largest residual of a flown plan", _figure(solver["max_residual_m"], "m", 5))
    ages = " / ".join(_figure(comms["path_age_ms"][part], "", 1) for part in ("p50", "p99"))
    yield _Row("age of peers' paths, median / p99", f"{ages} ms")
    refused = ", ".join(f"{reason} {count}" for reason, count in comms["rejected"].items()) or "none"
    yield _Row("bus messages refused", refused)
    if (unresponsive := comms.get("unresponsive") or {}).get("count"):
        lasted = _figure(unresponsive["longest_s"], "s", 1)
        yield _Row(
            "peers there but unresponsive, the longest",
            f"{unresponsive['count']}, agent-{unresponsive['agent']} {lasted}",
        )
    if timing["speed_factor"] is not None:
        yield _Row("speed", f"{timing['speed_factor']:.1f} x real time")


def _least(name: str, value: float | None, limit: float) -> _Row:
    return _Row(name, _figure(value, "m", 3), f"{limit:.3g} m", None if value is None else value >= limit)


def _figure(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()
