"""The charts of one run on a common time axis."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.tick_record import CURVES, Curve
from swarmctl.core.types import Array, Mode, Phase, PlanStatus
from swarmctl.telemetry.evaluation.attitude import roll_pitch_rad
from swarmctl.telemetry.evaluation.referee import Rules, RunData
from swarmctl.telemetry.evaluation.tracks import (
    Tracks,
    flight_rows,
    goal_ned_m,
    merge_tracks,
    mission_start_us,
    newest_mission,
    shared_references,
    track_error,
    tracking_rows,
    true_positions,
)
from swarmctl.telemetry.palette import MODE_RGB, PHASE_RGB, PLAN_RGB, SUM_RGB, agent_rgb, css
from swarmctl.telemetry.report.charts import (
    REFERENCE_STYLE,
    Ball,
    Goal,
    Limit,
    Line,
    Span,
    agent_line,
    reference_line,
    state_bars,
    time_chart,
    top_view,
)
from swarmctl.telemetry.report.svg import Figure

DETAILED_AGENTS = 6  # number of agents with attitude charts
_ALL_POINTS = 42_000  # points of all lines together, 13 bytes each: keeps the page below 1 MB
IN_FLIGHT = "from arming on"  # what is counted in a flight: its verdict leaves out what was before
_ALL_REFERENCES = reference_line(np.zeros(0), np.zeros(0))  # for the legend: each is in the colour of its agent


class RunCharts:
    """Draws the charts of one run."""

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
        self._references = shared_references({agent: run.ticks[agent] for agent in self._agents})
        lines = (12 + len(CURVES)) * len(self._agents) + 6 * min(DETAILED_AGENTS, len(self._agents)) + 8
        self._points = int(np.clip(_ALL_POINTS // lines, 40, 600))

    def _seconds(self, rows: NDArray[np.void]) -> Array:
        return np.asarray((rows[self._time_field] - self._start_us) / 1e6, np.float64)

    def _chart(self, title: str, lines: list[Line], **options: Any) -> Figure:
        return time_chart(title, lines, self._range, band=self._band, points=self._points, **options)

    def seen_from_above(self) -> Figure:
        lines, goals = [_ALL_REFERENCES, *(self._reference(agent, 1, 0, width=1.6) for agent in self._references)], []
        for agent in self._agents:
            rows = flight_rows(self._run.ticks[agent])
            pos_ned_m = true_positions(rows, self._run.truth, agent)
            lines.append(agent_line(agent, pos_ned_m[:, 1], pos_ned_m[:, 0], width=1.6, end=f"{agent}"))
        for agent, group in self._references.items():
            place_ned_m = goal_ned_m(newest_mission(self._run.ticks[agent]))
            if place_ned_m is not None:
                name = "goal" if self._is_shared else f"goal {', '.join(map(str, group))}"
                goals.append(Goal(place_ned_m, name, self._color_of(agent)))
        obstacles = [judged.obstacle for judged in self._rules.obstacles] if self._rules else []
        balls = [Ball(obstacle.center_ned_m, obstacle.keep_out_m, "keepout") for obstacle in obstacles]
        return top_view("From above: north up, east right [m]", lines, balls, self._points, goals=goals)

    @property
    def _is_shared(self) -> bool:
        """Whether all agents have one reference."""
        return len(self._references) == 1 and len(self._agents) > 1

    def _color_of(self, agent: int) -> str:
        return str(REFERENCE_STYLE["color"]) if self._is_shared else css(agent_rgb(agent))

    def _reference(self, agent: int, x: int | None, y: int, **style: Any) -> Line:
        """Return the curve of a reference: one component over time (`x` None) or over another."""
        rows = tracking_rows(self._run.ticks[agent])
        across = self._seconds(rows) if x is None else rows["ref_pos_ned_m"][:, x]
        return reference_line(across, rows["ref_pos_ned_m"][:, y], "", color=self._color_of(agent), **style)

    def flight(self) -> Iterator[Figure]:
        yield self._tracking_error()
        yield self._separation()
        yield from filter(None, (self._curve(name, curve) for name, curve in CURVES.items()))
        yield state_bars("Phase of the mission", self._spans("phase", Phase, PHASE_RGB), self._range)
        yield state_bars("What the agent did", self._spans("mode", Mode, MODE_RGB), self._range)
        yield state_bars("What became of its plans", self._spans("plan_status", PlanStatus, PLAN_RGB), self._range)

    def positions(self) -> Iterator[Figure]:
        for k, axis in enumerate(("x north", "y east", "z down")):
            lines = []
            for agent in self._agents:
                rows = flight_rows(self._run.ticks[agent])
                pos_ned_m = true_positions(rows, self._run.truth, agent)
                lines.append(agent_line(agent, self._seconds(rows), pos_ned_m[:, k]))
            lines += [_ALL_REFERENCES, *(self._reference(agent, None, k) for agent in self._references)]
            yield self._chart(f"{axis} [m]", lines)

    def attitudes(self) -> Iterator[Figure]:
        for agent in self._agents[:DETAILED_AGENTS]:
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

    def time_of(self, event: Mapping[str, Any]) -> float | None:
        """Return when an event happened [s], None if it does not say."""
        stamp = event.get(self._time_field)
        return (stamp - self._start_us) / 1e6 if isinstance(stamp, (int, float)) else None

    def _tracking_error(self) -> Figure:
        lines = []
        for agent in self._agents:
            error = track_error(self._run.ticks[agent], self._run.truth, agent)
            if len(error.mission_t_s):
                lines.append(agent_line(agent, error.mission_t_s, error.distance_m))
        if len(lines) > 1:
            total = self.error_sum()
            lines.append(Line(x=total["x"], y=total["y"], color=css(SUM_RGB), label="sum", width=1.8))
        return self._chart("Distance to the reference [m]", lines, from_zero=True)

    def _separation(self) -> Figure:
        required_m = float(self._summary["separation"]["required_m"])
        lines = []
        if len(self._agents) > 1 and len(self._tracks.pos_ned_m):
            pair = self.nearest_pair()
            lines = [Line(x=pair["x"], y=pair["y"], color="var(--nearest)", label="nearest pair", width=1.6)]
        limit = Limit(required_m, f"required {required_m:g} m")
        return self._chart("Smallest distance between two agents [m]", lines, limits=[limit], from_zero=True)

    def error_sum(self) -> dict[str, Array]:
        """Return the distances to the reference summed over agents, `y` (T,) [m] at mission times `x` (T,)."""
        errors = [track_error(self._run.ticks[agent], self._run.truth, agent) for agent in self._agents]
        known = [error for error in errors if len(error.mission_t_s)]
        if not known:
            return {"x": np.zeros(0), "y": np.zeros(0)}
        longest_s = max((error.mission_t_s for error in known), key=len)
        sums = [np.interp(longest_s, e.mission_t_s, e.distance_m, np.nan, np.nan) for e in known]
        return {"x": longest_s, "y": np.sum(sums, axis=0)}

    def nearest_pair(self) -> dict[str, Array]:
        """Return the smallest distance of two agents, `y` (T,) [m] at mission times `x` (T,)."""
        if len(self._agents) < 2 or not len(self._tracks.pos_ned_m):
            return {"x": np.zeros(0), "y": np.zeros(0)}
        return {"x": (self._tracks.t_us - self._start_us) / 1e6, "y": closest_pair_m(self._tracks.pos_ned_m)}

    def curve_of_agents(self, name: str, curve: Curve) -> Iterator[tuple[Array, Array]]:
        """Yield mission times (T,) and values (T,) of one recorded column, agent by agent, while they fly.

        Counts begin at 0, where the verdict's do.
        """
        for agent in self._agents:
            rows = flight_rows(self._run.ticks[agent])
            rows = rows if curve.where is None else rows[curve.where(rows)]
            values = np.asarray(rows[name], np.float64)
            yield self._seconds(rows), values - values[:1] if curve.is_count else values

    def _curve(self, name: str, curve: Curve) -> Figure | None:
        """Return the chart of a column; None where nothing is known of it."""
        drawn = list(self.curve_of_agents(name, curve))
        peaks = [float(np.nanpercentile(y, 99.9)) for _, y in drawn if np.isfinite(y).any()]
        if not peaks:
            return None
        lines = [
            agent_line(agent, x, y, width=1.0, opacity=0.8) for agent, (x, y) in zip(self._agents, drawn, strict=True)
        ]
        return self._chart(
            curve.titled(IN_FLIGHT), lines, from_zero=True, ceiling=None if curve.is_count else 1.5 * max(peaks)
        )

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
