"""Writes `report.html` of a run: one self-contained page below 1 MB, without scripts or network requests."""

from __future__ import annotations

import html
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.tick_record import CURVES, Curve
from swarmctl.core.types import Array, Mode, Phase
from swarmctl.files import replace_text
from swarmctl.telemetry.attitude import roll_pitch_rad
from swarmctl.telemetry.charts import Ball, Limit, Line, Span, state_bars, time_chart, top_view
from swarmctl.telemetry.palette import MODE_RGB, PHASE_RGB, REFERENCE_RGB, SUM_RGB, agent_rgb, css
from swarmctl.telemetry.referee import Rules, RunData
from swarmctl.telemetry.report_style import STYLE
from swarmctl.telemetry.tracks import (
    Tracks,
    flight_rows,
    merge_tracks,
    mission_start_us,
    track_error,
    tracking_rows,
    true_positions,
)

REPORT = "report.html"
_ALL_POINTS = 42_000  # points of all lines together, 13 bytes each: keeps the page below 1 MB
_DETAILED_AGENTS = 6  # number of agents with attitude charts
_EVENTS_LISTED = 400


def write_report(
    directory: Path, run: RunData, summary: Mapping[str, Any], config_text: str, rules: Rules | None = None
) -> Path:
    """Write the page of a judged run into its folder; returns its path.

    Args:
        directory: the run folder.
        run: the recorded run.
        summary: result of the referee.
        config_text: resolved configuration, shown verbatim.
        rules: limits and obstacles to draw, in addition to those in `summary`.
    """
    page = _Page(run, summary, rules)
    title = html.escape(directory.resolve().name)
    outcome = html.escape(str(summary["outcome"]))
    version = html.escape(str(summary["version"] or "of unknown version"))
    body = "".join(
        [
            f'<h1>{title}<span class="badge {outcome}">{outcome}</span></h1>',
            f"<p class=sub>{summary['agents']} agents, {html.escape(str(summary['mode']))}, "
            f"{_figure(summary['duration_s'], 's', 1)} of mission time. Times count from mission start; "
            f"the shaded band is the mission. Judged by swarmctl {version}.</p>",
            _violations(summary),
            '<div class=cards><div class="card wide">',
            _summary_table(summary, rules),
            "</div>",
            page.seen_from_above(),
            '</div><h2>Flight</h2><div class="cards big">',
            *page.flight(),
            "</div><h2>Position and reference</h2><div class=cards>",
            *page.positions(),
            "</div><h2>Attitude and thrust</h2><div class=cards>",
            *page.attitudes(),
            "</div><h2>Events</h2>",
            page.events(),
            "<h2>Configuration</h2><details class=card><summary>config.toml</summary>",
            f"<pre>{html.escape(config_text)}</pre></details>",
        ]
    )
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>'
    path = directory / REPORT
    page_html = f"<head>{head}<style>{STYLE}</style></head><body><main>{body}</main></body>"
    replace_text(path, f"<!doctype html><html lang=en>{page_html}</html>\n")
    return path


class _Page:
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

    def _chart(self, title: str, lines: list[Line], **options: Any) -> str:
        return time_chart(title, lines, self._range, band=self._band, points=self._points, **options)

    def seen_from_above(self) -> str:
        lines = []
        for agent in self._agents:
            rows = tracking_rows(self._run.ticks[agent])
            if len(rows) and agent == self._agents[0]:
                ref = rows["ref_pos_ned_m"]
                lines.append(
                    Line(x=ref[:, 1], y=ref[:, 0], color=css(REFERENCE_RGB), label="reference", dash="4 4", width=2.0)
                )
        for agent in self._agents:
            rows = flight_rows(self._run.ticks[agent])
            pos_ned_m = true_positions(rows, self._run.truth, agent)
            lines.append(
                Line(
                    x=pos_ned_m[:, 1], y=pos_ned_m[:, 0], color=css(agent_rgb(agent)), label=f"agent {agent}", width=1.6
                )
            )
        obstacles = self._rules.obstacles if self._rules else ()
        balls = [Ball(obstacle.center_ned_m, obstacle.keep_out_m, "keepout") for obstacle in obstacles]
        return top_view("From above: north up, east right [m]", lines, balls, self._points)

    def flight(self) -> Iterator[str]:
        yield self._tracking_error()
        yield self._separation()
        yield from (self._curve(name, curve) for name, curve in CURVES.items())
        yield state_bars("Phase of the mission", self._spans("phase", Phase, PHASE_RGB), self._range)
        yield state_bars("What the agent did", self._spans("mode", Mode, MODE_RGB), self._range)

    def positions(self) -> Iterator[str]:
        for k, axis in enumerate(("x north", "y east", "z down")):
            lines = []
            for agent in self._agents:
                rows = flight_rows(self._run.ticks[agent])
                pos_ned_m = true_positions(rows, self._run.truth, agent)
                lines.append(self._line(agent, rows, pos_ned_m[:, k], f"agent {agent}"))
            shown: dict[bytes, tuple[int, NDArray[np.void]]] = {}  # different references only, one if all share it
            for agent in self._agents:
                rows = tracking_rows(self._run.ticks[agent])
                shown.setdefault(np.round(rows["ref_pos_ned_m"][-1:, k], 1).tobytes(), (agent, rows))
            lines += [
                Line(
                    x=self._seconds(rows),
                    y=rows["ref_pos_ned_m"][:, k],
                    color="#334155",
                    label="reference",
                    dash="4 3",
                    width=1.1,
                )
                for _, rows in shown.values()
                if len(rows)
            ][:4]
            yield self._chart(f"{axis} [m]", lines)

    def attitudes(self) -> Iterator[str]:
        for agent in self._agents[:_DETAILED_AGENTS]:
            rows = flight_rows(self._run.ticks[agent])
            asked_rad, had_rad = roll_pitch_rad(rows["setpoint_q_nb"]), roll_pitch_rad(rows["q_nb"])
            for k, name in enumerate(("roll", "pitch")):
                lines = [
                    self._line(agent, rows, np.degrees(had_rad[:, k]), "measured"),
                    self._setpoint(rows, np.degrees(asked_rad[:, k]), "setpoint"),
                ]
                yield self._chart(f"Agent {agent}: {name} [deg]", lines, height=140)
            lines = [
                self._line(agent, rows, np.asarray(rows["setpoint_thrust_01"], np.float64), "setpoint"),
                self._setpoint(rows, np.asarray(rows["hover_thrust_01"], np.float64), "hover estimate"),
            ]
            yield self._chart(f"Agent {agent}: thrust [0..1]", lines, height=140)

    def events(self) -> str:
        rows = []
        offset_us = self._start_us if self._time_field == "utc_us" else None
        for event in self._run.events[:_EVENTS_LISTED]:
            stamp = event.get("utc_us" if offset_us is not None else "t_us")
            at = f"{(stamp - self._start_us) / 1e6:.2f}" if isinstance(stamp, (int, float)) else ""
            rest = ", ".join(f"{k}={v}" for k, v in event.items() if k not in ("utc_us", "t_us", "source", "event"))
            cells = (at, str(event.get("source", "")), str(event.get("event", "")), rest[:300])
            number, *words = (html.escape(cell) for cell in cells)
            rows.append(f"<tr><td class=n>{number}</td>" + "".join(f"<td>{word}</td>" for word in words) + "</tr>")
        hidden = len(self._run.events) - len(rows)
        more = f"<p class=sub>{hidden} more in events.jsonl</p>" if hidden > 0 else ""
        head = "<tr><th class=n>s</th><th>source</th><th>event</th><th></th></tr>"
        return f'<div class="card scroll"><table>{head}{"".join(rows)}</table>{more}</div>'

    def _line(self, agent: int, rows: NDArray[np.void], values: Array, label: str) -> Line:
        return Line(x=self._seconds(rows), y=values, color=css(agent_rgb(agent)), label=label)

    def _setpoint(self, rows: NDArray[np.void], values: Array, label: str) -> Line:
        return Line(x=self._seconds(rows), y=values, color="#334155", label=label, dash="3 3", width=1.0)

    def _tracking_error(self) -> str:
        lines, errors = [], []
        for agent in self._agents:
            error = track_error(self._run.ticks[agent], self._run.truth, agent)
            if len(error.mission_t_s):
                errors.append(error)
                lines.append(
                    Line(x=error.mission_t_s, y=error.distance_m, color=css(agent_rgb(agent)), label=f"agent {agent}")
                )
        if len(errors) > 1:
            longest = max(errors, key=lambda error: len(error.mission_t_s)).mission_t_s
            sums = [np.interp(longest, e.mission_t_s, e.distance_m, np.nan, np.nan) for e in errors]
            lines.append(Line(x=longest, y=np.sum(sums, axis=0), color=css(SUM_RGB), label="sum", width=1.8))
        return self._chart("Distance to the reference [m]", lines, from_zero=True)

    def _separation(self) -> str:
        required_m = float(self._summary["separation"]["required_m"])
        pos = self._tracks.pos_ned_m  # (T, agents, 3)
        lines = []
        if len(pos) and pos.shape[1] > 1:
            least_m = np.full(len(pos), np.inf)
            for i in range(pos.shape[1] - 1):
                apart_m = np.linalg.norm(pos[:, i + 1 :] - pos[:, i : i + 1], axis=2)
                least_m = np.fmin(least_m, np.fmin.reduce(apart_m, axis=1))
            least_m[~np.isfinite(least_m)] = np.nan
            lines = [
                Line(
                    x=(self._tracks.t_us - self._start_us) / 1e6,
                    y=least_m,
                    color="#0f766e",
                    label="nearest pair",
                    width=1.6,
                )
            ]
        limit = Limit(required_m, f"required {required_m:g} m")
        return self._chart("Smallest distance between two agents [m]", lines, limits=[limit], from_zero=True)

    def _curve(self, name: str, curve: Curve) -> str:
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


def _violations(summary: Mapping[str, Any]) -> str:
    items = "".join(f"<li>{html.escape(str(text))}</li>" for text in summary["violations"])
    return f"<ul class=violations>{items}</ul>" if items else ""


def _summary_table(summary: Mapping[str, Any], rules: Rules | None) -> str:
    rows = "".join(_summary_rows(summary, rules))
    agents = "".join(
        f'<tr><td><span class=dot style="background:{css(agent_rgb(int(row["id"])))}"></span>agent {row["id"]}</td>'
        f"<td class=n>{_figure(row['mean_distance_m'], '', 4)}</td><td class=n>{_figure(row['rmse_m'], '', 4)}</td>"
        f"<td class=n>{_figure(row['steady_rmse_m'], '', 4)}</td>"
        f"<td class=n>{' / '.join(_figure(v, '', 5) for v in row['mse_m2'])}</td></tr>"
        for row in summary["tracking"]["agents"]
    )
    names = ("mean [m]", "RMSE [m]", "after 10 s [m]", "MSE x / y / z [m2]")
    head = "<tr><th></th>" + "".join(f"<th class=n>{name}</th>" for name in names) + "</tr>"
    return (
        f"<table><tr><th></th><th class=n>value</th><th class=n>limit</th><th></th></tr>{rows}</table>"
        f"<table>{head}{agents}</table>"
    )


def _summary_rows(summary: Mapping[str, Any], rules: Rules | None) -> Iterator[str]:
    separation, obstacles, timing = summary["separation"], summary["obstacles"], summary["timing"]
    yield _least("smallest separation", separation["min_m"], separation["required_m"])
    if obstacles["min_clearance_m"] is not None:
        yield _least("nearest to an obstacle's centre", obstacles["min_clearance_m"], obstacles["required_m"])
    due = timing.get("due_ticks") or timing["ticks"]
    share = timing["late_ticks"] / due if due else None
    most = rules.deadline_misses_01 if rules else None
    good = None if share is None or most is None else share <= most
    late = f"{timing['late_ticks']} of {due}"
    yield _row("deadline misses", late, "" if most is None else f"{most:.0%}", good)
    yield _row("summed mean tracking error", _figure(summary["tracking"]["index_m"], "m", 3))
    yield _row("the same after 10 s", _figure(summary["tracking"]["index_after_10s_m"], "m", 3))
    for name, key in (("tick time", "tick_ms"), ("solve time", "solve_ms")):
        values = " / ".join(_figure(timing[key][part], "", 2) for part in ("p50", "p99", "max"))
        yield _row(f"{name}, median / p99 / max", f"{values} ms")
    solver, comms = summary["solver"], summary["comms"]
    yield _row(f"solver ({solver['name']}) failures", str(solver["failed"]))
    yield _row("plans refused by their certificate", str(solver["not_certified"]))
    if (deadlocks := summary.get("deadlocks") or {}).get("count"):
        yield _row("deadlocks, the longest", f"{deadlocks['count']}, {_figure(deadlocks['longest_s'], 's', 1)}")
    yield _row("ticks in which the safety filter acted", str(solver.get("safety_filter_ticks", 0)))
    yield _row("largest residual of a flown plan", _figure(solver["max_residual_m"], "m", 5))
    ages = " / ".join(_figure(comms["path_age_ms"][part], "", 1) for part in ("p50", "p99"))
    yield _row("age of peers' paths, median / p99", f"{ages} ms")
    refused = ", ".join(f"{reason} {count}" for reason, count in comms["rejected"].items()) or "none"
    yield _row("bus messages refused", refused)
    if (unheard := comms.get("unheard") or {}).get("count"):
        lasted = _figure(unheard["longest_s"], "s", 1)
        yield _row("peers there but unheard, the longest", f"{unheard['count']}, agent-{unheard['agent']} {lasted}")
    if timing["speed_factor"] is not None:
        yield _row("speed", f"{timing['speed_factor']:.1f} x real time")


def _least(name: str, value: float | None, limit: float) -> str:
    return _row(name, _figure(value, "m", 3), f"{limit:.3g} m", None if value is None else value >= limit)


def _row(name: str, value: str, limit: str = "", good: bool | None = None) -> str:
    verdict = "" if good is None else '<span class="ok">pass</span>' if good else '<span class="bad">fail</span>'
    return (
        f"<tr><td>{html.escape(name)}</td><td class=n>{html.escape(value)}</td>"
        f"<td class=n>{html.escape(limit)}</td><td>{verdict}</td></tr>"
    )


def _figure(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()
