"""The charts of one run on a common time axis."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.recorded.tick_record import CURVES, NOT_RECORDED, Curve
from swarmctl.core.types import Array, ControlMode, Mode, Phase, PlanStatus
from swarmctl.telemetry.evaluation.attitude import roll_pitch_rad
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, Rules, RunData
from swarmctl.telemetry.evaluation.station_clock import by_station_clock
from swarmctl.telemetry.evaluation.tracks import (
    Tracks,
    flight_rows,
    goal_ned_m,
    merge_tracks,
    missions,
    newest_mission,
    shared_references,
    time_zero,
    track_error,
    tracking_rows,
    true_positions,
    unbroken_mission_t_s,
)
from swarmctl.telemetry.palette import CONTROL_RGB, MODE_RGB, PHASE_RGB, PLAN_RGB, SUM_RGB, agent_rgb, css
from swarmctl.telemetry.report.charts import (
    REFERENCE_STYLE,
    Ball,
    Limit,
    Line,
    Mark,
    Span,
    agent_line,
    reference_line,
    state_bars,
    time_chart,
)
from swarmctl.telemetry.report.from_above import Place, top_view
from swarmctl.telemetry.report.moments import moments, who
from swarmctl.telemetry.report.svg import Figure, Stroke

DETAILED_AGENTS = 6  # number of agents with attitude charts
_ALL_POINTS = 42_000  # points of all lines together, 13 bytes each: keeps the page below 1 MB
IN_FLIGHT = "from arming on"  # what is counted in a flight: its verdict leaves out what was before
_ALL_REFERENCES = reference_line(np.zeros(0), np.zeros(0))  # for the legend: each is in the colour of its agent
_NEAR_M = 0.5  # how far beside what was flown the way of an obstacle is drawn
_TRANSIT: dict[str, Any] = {"width": 1.2, "opacity": 0.45}  # to the mission and back
_LEGEND_ABOVE = (
    _ALL_REFERENCES,
    Stroke(color="var(--soft)", label="mission"),
    Stroke(color="var(--soft)", label="way out and back", opacity=_TRANSIT["opacity"]),
)


class RunCharts:
    """Draws the charts of one run."""

    def __init__(self, run: RunData, summary: Mapping[str, Any], rules: Rules | None) -> None:
        clocked = by_station_clock(run.ticks, run.events, run.cut)
        self._run = run = replace(run, ticks=clocked.ticks, events=clocked.events(run.events))
        self.events = run.events  # those of agents by the station's clock
        self._summary = summary
        self._rules = rules
        agents = int(summary["agents"])
        known = clocked.known or run.ticks  # of older recordings no clock is known
        self._tracks: Tracks = merge_tracks(known, run.truth, agents)
        self._time_field = "t_us" if len(run.truth) else "utc_us"
        self._start_us, self.time_zero = time_zero(known, self._tracks)
        ends = [self._seconds(rows[[0, -1]]) for rows in run.ticks.values() if len(rows)]
        self._range = (min(e[0] for e in ends), max(e[1] for e in ends)) if ends else (0.0, 1.0)
        flown = [self._seconds(rows[[0, -1]]) for rows in map(tracking_rows, run.ticks.values()) if len(rows)]
        self._band = (min(m[0] for m in flown), max(m[1] for m in flown)) if flown else None
        self._agents = sorted(agent for agent in run.ticks if agent < agents)
        self._references = shared_references({agent: run.ticks[agent] for agent in self._agents})
        lines = (12 + len(CURVES)) * len(self._agents) + 6 * min(DETAILED_AGENTS, len(self._agents)) + 8
        self._points = int(np.clip(_ALL_POINTS // lines, 40, 600))
        self.moments = moments(run.events, {k: run.ticks[k] for k in self._agents}, self.time_of, self._seconds)

    def _seconds(self, rows: NDArray[np.void]) -> Array:
        return np.asarray((rows[self._time_field] - self._start_us) / 1e6, np.float64)

    def _chart(self, title: str, lines: list[Line], **options: Any) -> Figure:
        uprights = [moment.at_s for moment in self.moments]
        return time_chart(title, lines, self._range, band=self._band, points=self._points, uprights=uprights, **options)

    def flown_missions(self) -> tuple[int, float]:
        """Return how many missions an agent has flown one after the other, at most, and for how long together [s]."""
        flown = [self._run.ticks[agent] for agent in self._agents]
        times_s = [unbroken_mission_t_s(tracking_rows(rows)) for rows in flown]
        counts = (len(missions(rows)) for rows in flown)
        return max(counts, default=0), max((float(t_s[-1]) for t_s in times_s if len(t_s)), default=0.0)

    def seen_from_above(self) -> Figure:
        lines = [self._reference(agent, 1, 0, width=1.6) for agent in self._references]
        places, flown = list[Place](), list[Array]()
        for agent in self._agents:
            rows = flight_rows(self._run.ticks[agent])
            pos_ned_m = true_positions(rows, self._run.truth, agent)
            in_mission = rows["phase"] == Phase.TRACK
            for drawn, style in ((~in_mission, {"label": "", **_TRANSIT}), (in_mission, {"width": 1.8})):
                part_ned_m = np.where(drawn[:, None], pos_ned_m, np.nan)
                lines.append(agent_line(agent, part_ned_m[:, 1], part_ned_m[:, 0], **style))
            flown.append(pos_ned_m[np.isfinite(pos_ned_m).all(axis=1)])
            places += [Place(end_ned_m, f"end {agent}", css(agent_rgb(agent)), "dot") for end_ned_m in flown[-1][-1:]]
        for agent, group in self._references.items():
            place_ned_m = goal_ned_m(newest_mission(self._run.ticks[agent]))
            if place_ned_m is not None:
                name = "goal" if self._is_shared else f"goal {', '.join(map(str, group))}"
                places.append(Place(place_ned_m, name, self._color_of(agent), "ring"))
        obstacles = self._rules.obstacles if self._rules else ()
        balls = [Ball(judged.obstacle.center_ned_m, judged.obstacle.keep_out_m, "keepout") for judged in obstacles]
        balls += [Ball(judged.obstacle.center_ned_m, judged.obstacle.radius_m, "obstacle") for judged in obstacles]
        lines += self._ways(obstacles, np.concatenate([np.zeros((0, 3)), *flown]))
        return top_view("From above: north up, east right [m]", lines, balls, places=places, legend=_LEGEND_ABOVE)

    def _ways(self, obstacles: Iterable[JudgedObstacle], flown_ned_m: Array) -> Iterator[Line]:
        """Yield the ways of moving obstacles from where they are drawn, while they are near what was flown (T, 3)."""
        utc_us = [int(rows["utc_us"][end]) for rows in self._run.ticks.values() if len(rows) for end in (0, -1)]
        label = "way of an obstacle"
        for judged in obstacles:
            if not (judged.obstacle.moves and utc_us and len(flown_ned_m)):
                continue
            begin_us = min(utc_us) if judged.since_utc_us is None else judged.since_utc_us
            end_us = max(utc_us) if judged.until_utc_us is None else judged.until_utc_us
            elapsed_s = np.linspace(0.0, max(0.0, (end_us - begin_us) * 1e-6), 500)
            way_ned_m = judged.obstacle.center_after(elapsed_s[:, None])
            near = way_ned_m > flown_ned_m.min(axis=0) - _NEAR_M
            near &= way_ned_m < flown_ned_m.max(axis=0) + _NEAR_M
            way_ned_m[~near[:, :2].all(axis=1)] = np.nan
            yield Line(x=way_ned_m[:, 1], y=way_ned_m[:, 0], color="var(--danger)", label=label, width=1.6)
            label = ""

    @property
    def _is_shared(self) -> bool:
        """Whether all agents have one reference."""
        return len(self._references) == 1 and len(self._agents) > 1

    def _color_of(self, agent: int) -> str:
        return str(REFERENCE_STYLE["color"]) if self._is_shared else css(agent_rgb(agent))

    def _reference(self, agent: int, x: int | None, y: int, **style: Any) -> Line:
        """Return the curve of a reference: one component over time (`x` None) or over another."""
        flown = missions(self._run.ticks[agent])
        rows = np.concatenate(flown)  # none, if there was no mission
        ref_pos_ned_m = rows["ref_pos_ned_m"].copy()
        ref_pos_ned_m[np.cumsum([len(mission) for mission in flown[:-1]], dtype=np.intp)] = np.nan  # each by itself
        across = self._seconds(rows) if x is None else ref_pos_ned_m[:, x]
        return reference_line(across, ref_pos_ned_m[:, y], "", color=self._color_of(agent), **style)

    def flight(self) -> Iterator[Figure]:
        yield self._tracking_error()
        yield self._separation()
        yield from filter(None, (self._curve(name, curve) for name, curve in CURVES.items()))
        yield state_bars("Phase of the mission", self._spans("phase", Phase, PHASE_RGB), self._range)
        yield self._control()
        yield state_bars("What became of its plans", self._spans("plan_status", PlanStatus, PLAN_RGB), self._range)

    def _control(self) -> Figure:
        """Return what the agents did in the words of the operator's table, or in their modes where those lack."""
        recorded = any((self._run.ticks[agent]["control"] != NOT_RECORDED).any() for agent in self._agents)
        spans = self._spans("control", ControlMode, CONTROL_RGB) if recorded else self._spans("mode", Mode, MODE_RGB)
        rows = {agent: row for row, agent in enumerate(self._agents)}
        marks = [
            Mark(at_s, words + who(agents, len(rows)), [rows[agent] for agent in agents])
            for at_s, words, agents in self.moments
        ]
        return state_bars("What the agent did", spans, self._range, marks=marks)

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
