"""Charts of pages: over time, from above, oblique, and bars of states.

Every function returns the content of a `<figure>`. Lines are thinned to a number of points, which keeps their extremes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from markupsafe import Markup

from swarmctl.core.types import Array
from swarmctl.telemetry.palette import agent_rgb, css
from swarmctl.telemetry.report import svg
from swarmctl.telemetry.report.svg import Axis, Figure, Stroke, dot, element
from swarmctl.telemetry.report.thinning import evenly_spaced, thin

REFERENCE_STYLE: Mapping[str, Any] = {"color": "var(--reference)", "dash": "4 3", "width": 1.1}
_MAX_DRAWN = 1e9  # larger values come from damaged recordings and would flatten all other curves
_BAR_PX = 21  # from one bar to the next
_LANE_PX, _LANES, _NUMBER_PX = 15, 3, 20  # height and number of lanes of numbers above bars; width of a number
_LOOK_RAD, _DOWN_RAD = math.radians(35), math.radians(24)  # direction of the oblique view: east of north, and down


@dataclass(frozen=True, slots=True, kw_only=True)
class Line(Stroke):
    """One curve; NaN and values too large to draw interrupt it."""

    x: Array  # (T,)
    y: Array  # (T,)
    marks: bool = False  # draw a dot on every point

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            values = np.asarray(getattr(self, name), np.float64)
            object.__setattr__(self, name, np.where(np.abs(values) < _MAX_DRAWN, values, np.nan))


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceLine(Stroke):
    """One path in space; NaN interrupts it."""

    pos_ned_m: Array  # (T, 3)


def agent_line(agent: int, x: Array, y: Array, label: str | None = None, **style: Any) -> Line:
    """Return a curve through points (T,) in the colour of an agent, with its name unless a label is given."""
    return Line(x=x, y=y, color=css(agent_rgb(agent)), label=f"agent {agent}" if label is None else label, **style)


def reference_line(x: Array, y: Array, label: str = "reference", **style: Any) -> Line:
    """Return the dashed curve of what was asked for, through points (T,)."""
    return Line(x=x, y=y, label=label, **{**REFERENCE_STYLE, **style})


class Limit(NamedTuple):
    """A limit, drawn as a horizontal line."""

    value: float
    label: str


class Span(NamedTuple):
    """A state held from `start` to `end` on the time axis."""

    start: float
    end: float
    name: str
    color: str


class Mark(NamedTuple):
    """A numbered upright line on a time axis: something that happened, on some of the bars."""

    at: float
    words: str
    rows: Sequence[int]  # of the bars concerned


class Window(NamedTuple):
    """A shaded part of a time chart: the extent of an obstacle on one axis while the reference passes through it."""

    start: float
    end: float
    low: float
    high: float
    style: Literal["obstacle", "keepout"]


class Ball(NamedTuple):
    """A sphere in the view from above or the oblique one, in metres."""

    center_ned_m: Sequence[float]  # (3,)
    radius_m: float
    style: Literal["obstacle", "keepout"]


def time_chart(
    title: str,
    lines: Sequence[Line],
    x_range: tuple[float, float],
    *,
    limits: Sequence[Limit] = (),
    band: tuple[float, float] | None = None,
    points: int = 600,
    height: int = 170,
    from_zero: bool = False,
    ceiling: float | None = None,
    windows: Sequence[Window] = (),
    uprights: Sequence[float] = (),
    x_unit: str = "s",
) -> Figure:
    """Return a chart over time.

    Args:
        title: quantity drawn, with its unit.
        lines: curves over seconds.
        x_range: seconds shown.
        limits: horizontal lines.
        band: seconds to shade, usually the mission.
        points: number of points kept of each line.
        height: height of the plot [px].
        from_zero: whether the value axis begins at 0.
        ceiling: largest value shown; higher ones leave the plot.
        windows: shaded parts, clipped to the plot.
        uprights: seconds at which thin upright lines are drawn.
        x_unit: unit of the axis below, if that is no time.
    """
    low, high = value_range([line.y for line in lines], [limit.value for limit in limits], from_zero, ceiling)
    x, y = axes(svg.widened(*x_range), (low, high), height)
    inside = [_window(window, x, y) for window in windows] + [_limit(limit, x, y) for limit in limits]
    for line in lines:
        kept_x, kept_y = thin(line.x, line.y, points)
        inside.append(_curve(line, x, y, kept_x, y_values=kept_y))
    tall = y.first - svg.TOP_PX
    place = {"x": 0, "y": svg.TOP_PX, "width": svg.WIDTH_PX, "height": tall}
    clipped = element("svg", *inside, **place, viewBox=f"0 {svg.TOP_PX} {svg.WIDTH_PX} {tall}")
    behind = Markup()
    if band is not None:
        left, right = x.clipped_px(band)
        behind = element("rect", class_="band", x=left, y=svg.TOP_PX, width=right - left, height=tall)
    stood = _uprights([float(x.px(at)) for at in uprights], svg.TOP_PX, y.first)
    return svg.figure(title, height, [behind, svg.grid(x, y, x_unit), stood, clipped], lines)


def space_view(title: str, lines: Sequence[SpaceLine], balls: Sequence[Ball] = (), points: int = 600) -> Figure:
    """Return a view from the south-west and above; north is to the left, east to the right.

    Scales are equal, so that balls are round. Without balls, paths far taller or flatter than wide are drawn with
    another scale of heights, which the axis states.
    """
    spread = [line.pos_ned_m for line in lines]
    spread += [np.array([ball.center_ned_m]) + side * ball.radius_m for ball in balls for side in (-1, 1)]
    view = _Oblique([value_range([pos[:, k] for pos in spread]) for k in range(3)], may_stretch=not balls)
    drawn, nearer = [], []
    for line in lines:
        pos_ned_m = line.pos_ned_m[evenly_spaced(len(line.pos_ned_m), points)]  # (K, 3)
        px, py = view.px(pos_ned_m)
        drawn.append(line.along(px, py))
        if balls:
            covered = np.all([view.depth_m(pos_ned_m) > view.depth_m(np.array(b.center_ned_m)) for b in balls], axis=0)
            nearer.append(line.along(np.where(covered, np.nan, px), py))
        known = np.flatnonzero(np.isfinite(px) & np.isfinite(py))
        if line.label and not line.dash and len(known):
            nearer.append(dot(float(px[known[-1]]), float(py[known[-1]]), 4, line.color))
    for ball in balls:
        cx, cy = map(float, view.px(np.array(ball.center_ned_m)))
        drawn.append(element("circle", class_=ball.style, cx=cx, cy=cy, r=float(ball.radius_m * view.scale)))
    return svg.figure(title, view.height, [view.frame(), *drawn, *nearer], lines)


class _Oblique:
    """Parallel projection of a NED box onto the drawing."""

    def __init__(self, ranges_ned_m: Sequence[tuple[float, float]], may_stretch: bool) -> None:
        self._low, self._high = np.array(ranges_ned_m).T
        wide_m, tall_m = max(self._high[:2] - self._low[:2]), self._high[2] - self._low[2]
        fitting = min(max(1.0, 0.3 * wide_m / tall_m), 1.3 * wide_m / tall_m)
        self._heights = float(f"{fitting:.2g}") if may_stretch else 1.0
        corners = np.array(list(itertools.product(*zip(self._low, self._high, strict=True))))
        right_m, up_m = self._plane_m(corners)
        self.scale = float(min((svg.WIDTH_PX - 130) / np.ptp(right_m), 330 / np.ptp(up_m)))  # pixels per metre
        self._left_px = svg.WIDTH_PX / 2 - self.scale * float(right_m.min() + right_m.max()) / 2
        self._top_px = svg.TOP_PX + self.scale * float(up_m.max())
        self.height = svg.TOP_PX + float(np.ptp(up_m)) * self.scale + 34

    def px(self, pos_ned_m: Array) -> tuple[Array, Array]:
        """Return pixels (...,) to the right and down of positions (..., 3), NED."""
        right_m, up_m = self._plane_m(pos_ned_m)
        return self._left_px + right_m * self.scale, self._top_px - up_m * self.scale

    def _plane_m(self, pos_ned_m: Array) -> tuple[Array, Array]:
        """Return coordinates right and up (...,) in the plane of the drawing [m]."""
        n, e, down = pos_ned_m[..., 0], pos_ned_m[..., 1], pos_ned_m[..., 2] * self._heights
        right_m = e * math.cos(_LOOK_RAD) - n * math.sin(_LOOK_RAD)
        ahead_m = n * math.cos(_LOOK_RAD) + e * math.sin(_LOOK_RAD)
        return right_m, ahead_m * math.sin(_DOWN_RAD) - down * math.cos(_DOWN_RAD)

    def depth_m(self, pos_ned_m: Array) -> Array:
        """Return the distance (...,) [m] of positions (..., 3) behind the origin, seen from the camera."""
        ahead_m = pos_ned_m[..., 0] * math.cos(_LOOK_RAD) + pos_ned_m[..., 1] * math.sin(_LOOK_RAD)
        return np.asarray(ahead_m * math.cos(_DOWN_RAD) + pos_ned_m[..., 2] * math.sin(_DOWN_RAD))

    def frame(self) -> Markup:
        """Return floor, the two walls behind, ticks and names of the axes."""
        (n0, e0, top), (n1, e1, floor) = self._low, self._high
        parts = []
        for n in svg.round_numbers(n0, n1, 4):
            parts += [self._wire((n, e0, floor), (n, e1, floor), (n, e1, top)), self._tick((n, e0, floor), n, "end")]
        for e in svg.round_numbers(e0, e1, 4):
            parts += [self._wire((n0, e, floor), (n1, e, floor), (n1, e, top)), self._tick((n0, e, floor), e, "start")]
        for z in svg.round_numbers(top, floor, 5):
            parts += [self._wire((n1, e0, z), (n1, e1, z), (n0, e1, z)), self._tick((n1, e0, z), z, "end", 3.5)]
        parts.append(self._wire((n1, e0, top), (n1, e0, floor), (n0, e0, floor), (n0, e1, floor), style="axis"))
        parts.append(self._text(((n0 + n1) / 2, e0, floor), "x north [m]", "end", -26, below=26))
        parts.append(self._text((n0, (e0 + e1) / 2, floor), "y east [m]", "start", 26, below=26))
        scaled = "" if self._heights == 1.0 else f", scale x {self._heights:g}"
        parts.append(self._text((n1, e0, top), f"z down [m]{scaled}", "end", 10, below=-8))
        return Markup("").join(parts)

    def _wire(self, *corners_ned_m: tuple[float, float, float], style: str = "grid") -> Markup:
        px, py = self.px(np.array(corners_ned_m))
        return svg.polyline(px, py, class_=style)

    def _tick(self, at_ned_m: tuple[float, float, float], value: float, anchor: str, below: float = 13) -> Markup:
        return self._text(at_ned_m, f"{value:g}", anchor, -5 if anchor == "end" else 5, below=below - 3.5)

    def _text(
        self, at_ned_m: tuple[float, float, float], text: str, anchor: str, right: float, *, below: float
    ) -> Markup:
        px, py = map(float, self.px(np.array(at_ned_m)))
        return svg.tick(px + right, py + below, text, anchor)


def state_bars(
    title: str,
    rows: Sequence[tuple[str, Sequence[Span]]],
    x_range: tuple[float, float],
    *,
    marks: Sequence[Mark] = (),
) -> Figure:
    """Return one bar for each row, coloured by state, and marks across them, in order of time."""
    low, high = svg.widened(*x_range)
    x = Axis(low=low, high=high, first=svg.LEFT_PX + 40, last=svg.WIDTH_PX - svg.RIGHT_PX)
    at_px = [float(x.px(mark.at)) for mark in marks]
    lanes = _lanes(at_px)
    top = svg.TOP_PX + _LANE_PX * (max(lanes, default=-1) + 1)
    parts, states = list[Markup](), {}
    for number, (label, spans) in enumerate(rows):
        bar_top = top + _BAR_PX * number
        parts.append(svg.tick(svg.LEFT_PX + 34, bar_top + 8, label, "end"))
        for span in spans:
            left, right = map(float, x.px(np.array([span.start, span.end])))
            states[span.name] = Stroke(color=span.color, label=span.name)
            words = element("title", f"{span.name} {span.start:.1f} to {span.end:.1f} s")
            place = {"x": left, "y": bar_top, "width": max(0.6, right - left), "height": 16}
            parts.append(element("rect", words, **place, fill=span.color))
    for number, (mark, px, lane) in enumerate(zip(marks, at_px, lanes, strict=True), 1):
        tops = [top + _BAR_PX * row for row in mark.rows]
        path = "".join(f"M{px:.1f} {bar_top - 2}v20" for bar_top in tops)
        parts.append(element("path", class_="moment", d=path))
        parts.append(svg.tick(px, svg.TOP_PX + _LANE_PX * (lane + 0.4), f"{number}", "middle"))
    height = top + _BAR_PX * len(rows) + svg.BOTTOM_PX
    parts.append(svg.axis_below(x, Axis(low=0.0, high=1.0, first=height - svg.BOTTOM_PX, last=svg.TOP_PX), "s"))
    said = [
        Stroke(color="", label=f"{k} {mark.words}, {mark.at:.1f} s", sign="text") for k, mark in enumerate(marks, 1)
    ]
    return svg.figure(title, height, parts, [*states.values(), *said])


def _lanes(at_px: Sequence[float]) -> list[int]:
    """Return for each number, from the left, the lowest lane in which it is clear of the one before."""
    ends_px, lanes = [-math.inf] * _LANES, []
    for px in at_px:
        lane = next((k for k, end_px in enumerate(ends_px) if px >= end_px), _LANES - 1)
        ends_px[lane] = px + _NUMBER_PX
        lanes.append(lane)
    return lanes


def axes(x_range: tuple[float, float], y_range: tuple[float, float], height: float) -> tuple[Axis, Axis]:
    """Return the axes of a drawing of a height [px]."""
    x = Axis(low=x_range[0], high=x_range[1], first=svg.LEFT_PX, last=svg.WIDTH_PX - svg.RIGHT_PX)
    return x, Axis(low=y_range[0], high=y_range[1], first=height - svg.BOTTOM_PX, last=svg.TOP_PX)


def _curve(line: Line, x: Axis, y: Axis, x_values: Array, *, y_values: Array) -> Markup:
    px, py = x.px(x_values), np.clip(y.px(y_values), -1e4, 1e4)
    shown = np.isfinite(px) & np.isfinite(py) & line.marks
    dots = [dot(a, b, 3.5, line.color) for a, b in zip(px[shown], py[shown], strict=True)]
    return Markup("").join([line.along(px, py), *dots])


def _window(window: Window, x: Axis, y: Axis) -> Markup:
    left, right = x.clipped_px([window.start, window.end])
    bottom, top = y.clipped_px([window.low, window.high])
    return element("rect", class_=window.style, x=left, y=top, width=right - left, height=bottom - top)


def _uprights(at_px: Sequence[float], top: float, bottom: float) -> Markup:
    path = "".join(f"M{px:.1f} {top:.1f}V{bottom:.1f}" for px in at_px)
    return element("path", class_="upright", d=path) if path else Markup()


def _limit(limit: Limit, x: Axis, y: Axis) -> Markup:
    py = float(y.px(limit.value))
    place = {"d": f"M{x.first} {py:.1f}H{x.last}", "stroke_width": "1.2", "stroke_dasharray": "5 4"}
    line = element("path", class_="limit", **place)
    name = element("text", limit.label, x=x.last - 4, y=py, dy="1.1em", class_="tick name", text_anchor="end")
    return Markup("").join([line, name])


def value_range(
    values: Sequence[Array],
    extra: Sequence[float] = (),
    from_zero: bool = False,
    ceiling: float | None = None,
) -> tuple[float, float]:
    """Return a range in which all finite values have room."""
    finite = [array[np.isfinite(array)] for array in values]
    known = [*extra, *(float(f(array)) for array in finite if len(array) for f in (np.min, np.max))]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    if ceiling is not None:
        high = min(high, ceiling)
    if from_zero:
        low, high = 0.0, high if high > 0.0 else 1.0
    low, high = svg.widened(low, high)
    room = 0.06 * (high - low)
    return (low if from_zero else low - room), high + room
