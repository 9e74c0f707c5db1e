"""All result figures of the thesis, as a table, and how each is drawn from flights.

A flight is given as several traces: the first is the published preset, further ones are alternatives (another preset,
the full MAVLink loop) and are drawn beside it. Swarm figures show the agents of the first trace only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from markupsafe import Markup
from scipy.spatial.transform import Rotation

from sitl.studies.thesis.trace import Trace
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Array
from swarmctl.telemetry.palette import LIMIT_RGB, SUM_RGB, agent_rgb, css
from swarmctl.telemetry.report.charts import (
    REFERENCE_STYLE,
    Ball,
    Limit,
    Line,
    SpaceLine,
    Window,
    agent_line,
    reference_line,
    space_view,
    time_chart,
)
from swarmctl.telemetry.report.from_above import Place, top_view
from swarmctl.telemetry.report.pages import render

FlightName = Literal[
    "open_loop", "pid_step", "pid_steps", "pid_slow", "pid_fast", "mpc_slow", "mpc_fast", "circle", "obstacle"
]
Drawn = Literal["states", "x", "y", "z", "roll", "pitch", "yaw", "thrust", "torque_x", "torque_y", "torque_z", "space"]

FLIGHTS: dict[FlightName, str] = {
    "open_loop": "Open loop, zero input",
    "pid_step": "PID, one step",
    "pid_steps": "PID, consecutive steps",
    "pid_slow": "PID, slow trajectory",
    "pid_fast": "PID, fast trajectory",
    "mpc_slow": "MPC, slow trajectory",
    "mpc_fast": "MPC, fast trajectory",
    "circle": "Swarm on a climbing circle",
    "obstacle": "Swarm and a suddenly seen obstacle",
}
SWARMS: tuple[FlightName, ...] = ("circle", "obstacle")

_QUANTITIES: dict[Drawn, str] = {
    "x": "position x [m]",
    "y": "position y [m]",
    "z": "position z [m]",
    "roll": "roll phi [rad]",
    "pitch": "pitch theta [rad]",
    "yaw": "yaw psi [rad]",
    "thrust": "thrust f_t [N]",
    "torque_x": "torque tau_x [N m]",
    "torque_y": "torque tau_y [N m]",
    "torque_z": "torque tau_z [N m]",
    "space": "path in space [m]",
    "states": "all twelve states",
}
_AXES: tuple[Drawn, ...] = ("x", "y", "z")
_ANGLES: tuple[Drawn, ...] = ("roll", "pitch", "yaw")
_TORQUES: tuple[Drawn, ...] = ("torque_x", "torque_y", "torque_z")
_PUBLISHED = "#b45309"


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One figure of the thesis."""

    number: int
    caption: str
    flight: FlightName
    drawn: Drawn

    @property
    def title(self) -> str:
        return f"Figure {self.number}: {self.caption}"


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexPoint:
    """One constraint radius of Table 19."""

    radius_m: float
    ours_m: float | None  # tracking index: sum over agents of the mean distance to the shared reference
    published_m: float | None = None
    series: str = "ours"  # points of one series are joined


@dataclass(frozen=True, slots=True)
class Extra:
    """Content of the page that is in no trace.

    Attributes:
        separation_m: constraint radius by trace name or, for all traces of a flight, by flight.
        index: tracking index over constraint radius.
        notes: paragraphs for the top of the page.
    """

    separation_m: Mapping[str, float] = field(default_factory=dict)
    index: Sequence[IndexPoint] = ()
    notes: Sequence[str] = ()


def _run_of(first: int, flight: FlightName, drawn: Sequence[Drawn], by: str) -> tuple[Figure, ...]:
    return tuple(
        Figure(number=first + k, caption=f"{_QUANTITIES[what]}, {by}", flight=flight, drawn=what)
        for k, what in enumerate(drawn)
    )


_TEN: tuple[Drawn, ...] = (*_AXES, *_ANGLES, "thrust", *_TORQUES)
_ELEVEN: tuple[Drawn, ...] = (*_TEN, "space")

FIGURES: tuple[Figure, ...] = (
    *_run_of(5, "open_loop", ("states",), "zero input from rest"),
    *_run_of(11, "pid_step", _TEN, "one step, PID"),
    *_run_of(21, "pid_steps", ("space", *_TEN), "consecutive steps, PID"),
    *_run_of(34, "pid_slow", _ELEVEN, "slow trajectory, PID"),
    *_run_of(45, "pid_fast", _ELEVEN, "fast trajectory, PID"),
    *_run_of(61, "mpc_slow", _ELEVEN, "slow trajectory, MPC"),
    *_run_of(72, "mpc_fast", _ELEVEN, "fast trajectory, MPC"),
    *_run_of(85, "circle", (*_AXES, "space"), "swarm, distributed MPC"),
    *_run_of(90, "obstacle", (*_AXES, "space"), "swarm and obstacle, distributed MPC"),
)


def draw(figure: Figure, traces: Sequence[Trace], points: int = 300) -> Markup:
    """Return the content of one figure of the thesis.

    Args:
        figure: entry of the table.
        traces: of its flight, the published preset first; at least one.
        points: kept per line.
    """
    if figure.drawn == "states":
        return _states(figure, traces, points)
    if figure.drawn == "space":
        return _space(figure, traces, points)
    lines = _lines(figure, traces)
    windows = _windows(traces[0], _AXES.index(figure.drawn)) if figure.drawn in _AXES else []
    title = figure.title if lines else f"{figure.title} (not recorded)"
    return time_chart(title, lines, _seconds(traces), points=points, windows=windows, height=200)


def body_rates_rad_s(trace: Trace) -> Array:
    """Return body FRD rates p, q, r (T, 3) [rad/s] of the first agent, by central differences: a trace has none."""
    euler_rad = trace.euler_rad[:, 0]
    if len(euler_rad) < 2:
        return np.full_like(euler_rad, np.nan)
    roll, pitch = euler_rad[:, 0], euler_rad[:, 1]
    droll, dpitch, dyaw = np.gradient(np.unwrap(euler_rad, axis=0), trace.t_s, axis=0).T
    return np.column_stack(
        [
            droll - dyaw * np.sin(pitch),
            dpitch * np.cos(roll) + dyaw * np.cos(pitch) * np.sin(roll),
            -dpitch * np.sin(roll) + dyaw * np.cos(pitch) * np.cos(roll),
        ]
    )


def body_velocity_m_s(trace: Trace) -> Array:
    """Return the body FRD velocity u, v, w (T, 3) [m/s] of the first agent: that in NED, turned by the ZYX angles."""
    to_ned = Rotation.from_euler("ZYX", trace.euler_rad[:, 0, ::-1])
    return np.asarray(to_ned.apply(trace.vel_ned_m_s[:, 0], inverse=True))


def separation_chart(
    flight: FlightName, traces: Sequence[Trace], separation_m: Mapping[str, float], points: int
) -> Markup:
    """Draw the smallest distance of two agents over time, with the constraint radius of every trace."""
    lines = [agent_line(k, trace.t_s, closest_pair_m(trace.pos_ned_m), trace.name) for k, trace in enumerate(traces)]
    radii = {separation_m.get(trace.name, separation_m.get(flight)) for trace in traces}
    limits = [Limit(r, f"constraint radius {r:g} m") for r in sorted(r for r in radii if r is not None)]
    title = "Smallest distance between two agents [m]"
    return _tall_chart(title, lines, traces, limits, points=points)


def error_chart(flight: FlightName, traces: Sequence[Trace], separation_m: Mapping[str, float], points: int) -> Markup:
    """Draw the distance to the reference over time, summed over agents; its mean is the published index."""
    lines = []
    for k, trace in enumerate(traces):
        sum_m = np.linalg.norm(trace.pos_ned_m - trace.ref_pos_ned_m, axis=2).sum(axis=1)
        lines.append(agent_line(k, trace.t_s, sum_m, f"{trace.name}, mean {_mean(sum_m)} m"))
    radius_m = separation_m.get(traces[0].name, separation_m.get(flight))
    limits = []
    if radius_m is not None and traces[0].pos_ned_m.shape[1] == 3:
        limits = [Limit(math.sqrt(3) * radius_m, "theoretical lower bound for three agents")]
    title = "Distances to the shared reference, sum [m]" if flight in SWARMS else "Distance to the reference [m]"
    return _tall_chart(title, lines, traces, limits, points=points)


def obstacle_chart(traces: Sequence[Trace], points: int) -> Markup:
    """Draw the distance to the first obstacle's centre: all agents of the first trace, the nearest of the others."""
    obstacle = traces[0].obstacles[0]

    def away_m(trace: Trace) -> Array:  # (T, N)
        return np.asarray(np.linalg.norm(trace.pos_ned_m - np.array(obstacle.center_ned_m), axis=2))

    lines = [agent_line(i, traces[0].t_s, own_m) for i, own_m in enumerate(away_m(traces[0]).T)]
    for color, trace in enumerate(traces[1:], len(lines)):
        lines.append(agent_line(color, trace.t_s, np.fmin.reduce(away_m(trace), axis=1), f"nearest, {trace.name}"))
    limits = [Limit(obstacle.keep_out_m, f"constraint radius {obstacle.keep_out_m:g} m")]
    title = "Distance to the centre of the obstacle [m]"
    return _tall_chart(title, lines, traces, limits, points=points)


def above_chart(trace: Trace) -> Markup:
    """Draw agents, reference and obstacles from above; circles are the keep-out and the obstacle."""
    agents = range(trace.pos_ned_m.shape[1])
    lines = [agent_line(i, trace.pos_ned_m[:, i, 1], trace.pos_ned_m[:, i, 0]) for i in agents]
    lines.append(reference_line(trace.ref_pos_ned_m[:, 0, 1], trace.ref_pos_ned_m[:, 0, 0]))
    ends = [Place(end, "", css(agent_rgb(i)), "dot") for i in agents for end in trace.pos_ned_m[-1:, i]]
    return top_view("From above: north up, east right [m]", lines, _balls(trace)[::-1], places=ends)


def _balls(trace: Trace) -> list[Ball]:
    """Return every obstacle and its keep-out."""
    return [
        ball
        for obstacle in trace.obstacles
        for ball in (
            Ball(obstacle.center_ned_m, obstacle.radius_m, "obstacle"),
            Ball(obstacle.center_ned_m, obstacle.keep_out_m, "keepout"),
        )
    ]


def index_chart(index: Sequence[IndexPoint]) -> Markup:
    """Draw the tracking index over the constraint radius: Table 19, ours, and the theoretical lower bound."""
    radii = np.array(sorted({point.radius_m for point in index}))
    published = sorted({(p.radius_m, p.published_m) for p in index if p.published_m is not None})
    lines = []
    for k, name in enumerate(dict.fromkeys(point.series for point in index)):
        ours = sorted((p.radius_m, p.ours_m) for p in index if p.series == name and p.ours_m is not None)
        lines.append(_marked(ours, css(agent_rgb(k)), name))
    lines.append(_marked(published, _PUBLISHED, "published, Table 19"))
    bound = "theoretical lower bound, sqrt(3) r"
    lines.append(reference_line(radii, math.sqrt(3) * radii, bound, color=css(LIMIT_RGB), dash="5 4", width=1.2))
    shown = (float(radii[0]) - 0.03, float(radii[-1]) + 0.03)
    title = "Tracking index [m] over constraint radius [m], three periods of the circle"
    return time_chart(title, lines, shown, from_zero=True, height=240, x_unit="m")


def _tall_chart(
    title: str, lines: Sequence[Line], traces: Sequence[Trace], limits: Sequence[Limit], *, points: int
) -> Markup:
    return time_chart(title, lines, _seconds(traces), limits=limits, points=points, from_zero=True, height=300)


def _marked(pairs: Sequence[tuple[float, float]], color: str, label: str) -> Line:
    values = np.array(pairs, np.float64).reshape(-1, 2)
    return Line(x=values[:, 0], y=values[:, 1], color=color, label=label, marks=True)


def _mean(values: Array) -> str:
    return f"{np.nanmean(values):.3g}" if np.isfinite(values).any() else "-"


def _seconds(traces: Sequence[Trace]) -> tuple[float, float]:
    ends = [float(trace.t_s[k]) for trace in traces if len(trace.t_s) for k in (0, -1)]
    return (min(ends), max(ends)) if ends else (0.0, 1.0)


def _flown(figure: Figure, traces: Sequence[Trace]) -> list[tuple[Trace, int, str]]:
    """Return the flights a figure shows: trace, agent and label; of a swarm the agents of the first trace."""
    if figure.flight in SWARMS:
        return [(traces[0], i, f"agent {i}") for i in range(traces[0].pos_ned_m.shape[1])]
    return [(trace, 0, trace.name if len(traces) > 1 else "response") for trace in traces]


def _lines(figure: Figure, traces: Sequence[Trace]) -> list[Line]:
    """Return what was flown, and the reference of the first trace."""
    lines, swarm = [], figure.flight in SWARMS
    for k, (trace, agent, label) in enumerate(_flown(figure, traces)):
        values = _response(trace, figure.drawn, agent)
        if swarm or np.isfinite(values).any():
            lines.append(agent_line(k, trace.t_s, values, label, width=1.4 if k or swarm else 1.9))
    asked = _asked(traces[0], figure.drawn)
    if asked is not None and (swarm or np.isfinite(asked).any()):
        word = "reference" if figure.drawn in _AXES else "setpoint"
        own = f" of {traces[0].name}" if word == "setpoint" and len(traces) > 1 else ""
        lines.append(reference_line(traces[0].t_s, asked, word + own))
    return lines


def _response(trace: Trace, drawn: Drawn, agent: int) -> Array:
    """Return the drawn state of one agent (T,)."""
    if drawn in _AXES:
        return trace.pos_ned_m[:, agent, _AXES.index(drawn)]
    if drawn in _ANGLES:
        return trace.euler_rad[:, agent, _ANGLES.index(drawn)]
    if drawn == "thrust":
        return trace.thrust_n[:, agent]
    return trace.torque_n_m[:, agent, _TORQUES.index(drawn)]


def _asked(trace: Trace, drawn: Drawn) -> Array | None:
    """Return the reference or attitude setpoint of the first agent (T,); None where the thesis has none."""
    if drawn in _AXES:
        return trace.ref_pos_ned_m[:, 0, _AXES.index(drawn)]
    if drawn in _ANGLES:
        return trace.euler_ref_rad[:, 0, _ANGLES.index(drawn)]
    return None


def _windows(trace: Trace, axis: int) -> list[Window]:
    """Return the extent of every obstacle on one axis while the reference is inside it."""
    found = []
    for ball in reversed(_balls(trace)):
        away_m = np.linalg.norm(trace.ref_pos_ned_m[:, 0] - np.array(ball.center_ned_m), axis=1)
        inside_s = trace.t_s[away_m < ball.radius_m]
        if len(inside_s):
            low_m, high_m = ball.center_ned_m[axis] - ball.radius_m, ball.center_ned_m[axis] + ball.radius_m
            found.append(Window(float(inside_s[0]), float(inside_s[-1]), low_m, high_m, ball.style))
    return found


def _space(figure: Figure, traces: Sequence[Trace], points: int) -> Markup:
    lines = [
        SpaceLine(pos_ned_m=trace.pos_ned_m[:, agent], color=css(agent_rgb(k)), label=label, width=1.6)
        for k, (trace, agent, label) in enumerate(_flown(figure, traces))
    ]
    lines.append(SpaceLine(pos_ned_m=traces[0].ref_pos_ned_m[:, 0], label="reference", **REFERENCE_STYLE))
    return space_view(figure.title, lines, _balls(traces[0]), points)


def _states(figure: Figure, traces: Sequence[Trace], points: int) -> Markup:
    """Draw four panels of three states; further traces are dashed."""
    panels: tuple[tuple[str, str], ...] = (
        ("angles [rad]", "phi theta psi"),
        ("body rates [rad/s]", "p q r"),
        ("body velocity [m/s]", "u v w"),
        ("position NED [m]", "x y z"),
    )
    states = [
        (t.euler_rad[:, 0], body_rates_rad_s(t), body_velocity_m_s(t), t.pos_ned_m[:, 0]) for t in traces
    ]  # each (T, 3)
    panels_drawn = []
    for panel, (title, names) in enumerate(panels):
        lines = [
            agent_line(
                k,
                trace.t_s,
                states[n][panel][:, k],
                "" if n else name,
                dash="4 3" if n else "",
                width=1.6 - 0.2 * k,
            )
            for n, trace in enumerate(traces)
            for k, name in enumerate(names.split())
        ]
        panels_drawn.append(time_chart(title, lines, _seconds(traces), points=points, height=130))
    others = ", ".join(trace.name for trace in traces[1:])
    return render(
        __package__, "states.html", title=figure.title, panels=panels_drawn, color=css(SUM_RGB), others=others
    )
