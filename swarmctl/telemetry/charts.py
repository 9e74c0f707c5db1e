"""Draws inline SVG: time charts, a top view, an oblique view and state bars, without scripts, fonts or requests.

Every function returns text. Lines are thinned to a number of points, which keeps their extremes.
"""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import Array
from swarmctl.telemetry.palette import LIMIT_RGB, css

WIDTH = 640
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 8, 24
_MAX_DRAWN = 1e9  # larger values come from damaged recordings and would flatten all other curves
_LOOK_RAD, _DOWN_RAD = math.radians(35), math.radians(24)  # direction of the oblique view: east of north, and down


def _near(values: Array) -> Array:
    """Return values that can be drawn, and NaN for others."""
    values = np.asarray(values, np.float64)
    return np.where(np.abs(values) < _MAX_DRAWN, values, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """One curve; NaN and values too large to draw interrupt it."""

    x: Array  # (T,)
    y: Array  # (T,)
    color: str
    label: str = ""
    dash: str = ""
    width: float = 1.4
    opacity: float = 1.0
    marks: bool = False  # draw a dot on every point

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", _near(self.x))
        object.__setattr__(self, "y", _near(self.y))


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceLine:
    """One path in space; NaN interrupts it."""

    pos_ned_m: Array  # (T, 3)
    color: str
    label: str = ""
    dash: str = ""
    width: float = 1.4
    opacity: float = 1.0


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


class Window(NamedTuple):
    """A shaded part of a time chart: the extent of an obstacle on one axis while the reference passes through it."""

    start: float
    end: float
    low: float
    high: float
    style: Literal["obstacle", "keepout"]


class Ball(NamedTuple):
    """A sphere in the view from above and in the oblique one, in metres."""

    center_ned_m: tuple[float, float, float]
    radius_m: float
    style: Literal["obstacle", "keepout"]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Axis:
    """Maps [low, high] to [first, last] pixels."""

    low: float
    high: float
    first: float
    last: float

    def px(self, values: Array) -> Array:
        scale = (self.last - self.first) / (self.high - self.low)
        return self.first + (np.asarray(values, np.float64) - self.low) * scale


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
) -> str:
    """Return a figure with one chart over time.

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
    """
    low, high = _value_range([line.y for line in lines], [limit.value for limit in limits], from_zero, ceiling)
    left, right = _widened(*x_range)
    x = _Axis(low=left, high=right, first=_LEFT, last=WIDTH - _RIGHT)
    y = _Axis(low=low, high=high, first=height - _BOTTOM, last=_TOP)
    behind = ""
    if band is not None:
        left, right = x.px(np.clip(np.array(band), x.low, x.high))
        behind = f'<rect class="band" x="{left:.1f}" y="{_TOP}" width="{right - left:.1f}" height="{y.first - _TOP}"/>'
    inside = [_window(window, x, y) for window in windows] + [_limit(limit, x, y) for limit in limits]
    inside += [_polyline(line, x, y, thin(line.x, line.y, points)) for line in lines]
    clip = (
        f'<svg x="0" y="{_TOP}" width="{WIDTH}" height="{y.first - _TOP}" viewBox="0 {_TOP} {WIDTH} {y.first - _TOP}">'
    )
    body = f"{behind}{_grid(x, y)}{clip}{''.join(inside)}</svg>"
    return _figure(title, lines, f'<svg viewBox="0 0 {WIDTH} {height}" role="img">{body}</svg>')


def top_view(title: str, lines: Sequence[Line], balls: Sequence[Ball], points: int = 600) -> str:
    """Return a figure seen from above with equal scales; x is to the right, y up."""
    xs = [line.x for line in lines] + [
        np.array([b.center_ned_m[1] - b.radius_m, b.center_ned_m[1] + b.radius_m]) for b in balls
    ]
    ys = [line.y for line in lines] + [
        np.array([b.center_ned_m[0] - b.radius_m, b.center_ned_m[0] + b.radius_m]) for b in balls
    ]
    (x_low, x_high), (y_low, y_high) = _value_range(xs), _value_range(ys)
    wide = WIDTH - _LEFT - _RIGHT
    scale = min(wide / (x_high - x_low), 420 / (y_high - y_low))
    height = max(160.0, (y_high - y_low) * scale + _TOP + _BOTTOM)
    extra_x, extra_y = wide / scale - (x_high - x_low), (height - _TOP - _BOTTOM) / scale - (y_high - y_low)
    x = _Axis(low=x_low - extra_x / 2, high=x_high + extra_x / 2, first=_LEFT, last=WIDTH - _RIGHT)
    y = _Axis(low=y_low - extra_y / 2, high=y_high + extra_y / 2, first=height - _BOTTOM, last=_TOP)
    parts = [_grid(x, y)]
    for ball in balls:
        cx, cy = float(x.px(np.array(ball.center_ned_m[1]))), float(y.px(np.array(ball.center_ned_m[0])))
        parts.append(f'<circle class="obstacle" cx="{cx:.1f}" cy="{cy:.1f}" r="{ball.radius_m * scale:.1f}"/>')
    for line in lines:
        kept = (
            np.unique(np.linspace(0, max(0, len(line.x) - 1), points).astype(int)) if len(line.x) else np.zeros(0, int)
        )
        parts.append(_polyline(line, x, y, (line.x[kept], line.y[kept])))
        if line.label and len(line.x) and np.isfinite(line.y[-1]):
            cx, cy = float(x.px(line.x[-1])), float(y.px(line.y[-1]))
            parts.append(f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="4" fill="{line.color}"/>')
    return _figure(title, lines, f'<svg viewBox="0 0 {WIDTH} {height:.0f}" role="img">{"".join(parts)}</svg>')


def space_view(title: str, lines: Sequence[SpaceLine], balls: Sequence[Ball] = (), points: int = 600) -> str:
    """Return a figure seen from the south-west and above; north is to the left, east to the right.

    Scales are equal, so that balls are round. Without balls, paths far taller or flatter than wide are drawn with
    another scale of heights, which the axis states.
    """
    spread = [line.pos_ned_m for line in lines]
    spread += [np.array([ball.center_ned_m]) + side * ball.radius_m for ball in balls for side in (-1, 1)]
    view = _Oblique([_value_range([pos[:, k] for pos in spread]) for k in range(3)], may_stretch=not balls)
    drawn, nearer = [], []
    for line in lines:
        kept = np.unique(np.linspace(0, len(line.pos_ned_m) - 1, min(points, len(line.pos_ned_m))).astype(int))
        pos_ned_m = line.pos_ned_m[kept]  # (K, 3)
        px, py = view.px(pos_ned_m)
        drawn.append(_stroke(line, px, py))
        if balls:
            covered = np.all([view.depth_m(pos_ned_m) > view.depth_m(np.array(b.center_ned_m)) for b in balls], axis=0)
            nearer.append(_stroke(line, np.where(covered, np.nan, px), py))
        known = np.flatnonzero(np.isfinite(px) & np.isfinite(py))
        if line.label and not line.dash and len(known):
            nearer.append(f'<circle cx="{px[known[-1]]:.1f}" cy="{py[known[-1]]:.1f}" r="4" fill="{line.color}"/>')
    for ball in balls:
        cx, cy = view.px(np.array(ball.center_ned_m))
        drawn.append(f'<circle class="{ball.style}" cx="{cx:.1f}" cy="{cy:.1f}" r="{ball.radius_m * view.scale:.1f}"/>')
    body = "".join([view.frame(), *drawn, *nearer])
    return _figure(title, lines, f'<svg viewBox="0 0 {WIDTH} {view.height:.0f}" role="img">{body}</svg>')


class _Oblique:
    """Parallel projection of a NED box onto the drawing."""

    def __init__(self, ranges_ned_m: Sequence[tuple[float, float]], may_stretch: bool) -> None:
        self._low, self._high = np.array(ranges_ned_m).T
        wide_m, tall_m = max(self._high[:2] - self._low[:2]), self._high[2] - self._low[2]
        fitting = min(max(1.0, 0.3 * wide_m / tall_m), 1.3 * wide_m / tall_m)
        self._heights = float(f"{fitting:.2g}") if may_stretch else 1.0
        corners = np.array(list(itertools.product(*zip(self._low, self._high, strict=True))))
        right_m, up_m = self._plane_m(corners)
        self.scale = float(min((WIDTH - 130) / np.ptp(right_m), 330 / np.ptp(up_m)))  # pixels per metre
        self._left_px = WIDTH / 2 - self.scale * float(right_m.min() + right_m.max()) / 2
        self._top_px = _TOP + self.scale * float(up_m.max())
        self.height = _TOP + float(np.ptp(up_m)) * self.scale + 34

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

    def frame(self) -> str:
        """Return floor, the two walls behind, ticks and names of the axes."""
        (n0, e0, top), (n1, e1, floor) = self._low, self._high
        parts = []
        for n in _nice(n0, n1, 4):
            parts += [self._wire((n, e0, floor), (n, e1, floor), (n, e1, top)), self._tick((n, e0, floor), n, "end")]
        for e in _nice(e0, e1, 4):
            parts += [self._wire((n0, e, floor), (n1, e, floor), (n1, e, top)), self._tick((n0, e, floor), e, "start")]
        for z in _nice(top, floor, 5):
            parts += [self._wire((n1, e0, z), (n1, e1, z), (n0, e1, z)), self._tick((n1, e0, z), z, "end", 3.5)]
        parts.append(self._wire((n1, e0, top), (n1, e0, floor), (n0, e0, floor), (n0, e1, floor), style="axis"))
        parts.append(self._text(((n0 + n1) / 2, e0, floor), "x north [m]", "end", -26, 26))
        parts.append(self._text((n0, (e0 + e1) / 2, floor), "y east [m]", "start", 26, 26))
        scaled = "" if self._heights == 1.0 else f", scale x {self._heights:g}"
        parts.append(self._text((n1, e0, top), f"z down [m]{scaled}", "end", 10, -8))
        return "".join(parts)

    def _wire(self, *corners_ned_m: tuple[float, float, float], style: str = "grid") -> str:
        px, py = self.px(np.array(corners_ned_m))
        return f'<path class="{style}" d="M{"L".join(f"{a:.1f} {b:.1f}" for a, b in zip(px, py, strict=True))}"/>'

    def _tick(self, at_ned_m: tuple[float, float, float], value: float, anchor: str, below: float = 13) -> str:
        return self._text(at_ned_m, f"{value:g}", anchor, -5 if anchor == "end" else 5, below)

    def _text(self, at_ned_m: tuple[float, float, float], text: str, anchor: str, right: float, below: float) -> str:
        px, py = self.px(np.array(at_ned_m))
        return f'<text class="tick" x="{px + right:.1f}" y="{py + below:.1f}" text-anchor="{anchor}">{text}</text>'


def state_bars(title: str, rows: Sequence[tuple[str, Sequence[Span]]], x_range: tuple[float, float]) -> str:
    """Return a figure with one bar for each row, coloured by state."""
    left, right = _widened(*x_range)
    x = _Axis(low=left, high=right, first=_LEFT + 40, last=WIDTH - _RIGHT)
    parts, names = [], {}
    for number, (label, spans) in enumerate(rows):
        top = _TOP + 18 * number
        parts.append(
            f'<text x="{_LEFT + 34}" y="{top + 10}" class="tick" text-anchor="end">{html.escape(label)}</text>'
        )
        for span in spans:
            left, right = x.px(np.array([span.start, span.end]))
            names[span.name] = span.color
            parts.append(
                f'<rect x="{left:.1f}" y="{top}" width="{max(0.6, right - left):.1f}" height="13" fill="{span.color}">'
                f"<title>{html.escape(span.name)} {span.start:.1f} to {span.end:.1f} s</title></rect>"
            )
    height = _TOP + 18 * len(rows) + _BOTTOM
    y = _Axis(low=0.0, high=1.0, first=height - _BOTTOM, last=_TOP)
    parts.append(_ticks_below(x, y))
    legend = "".join(_key(name, color, "") for name, color in names.items())
    drawing = f'<svg viewBox="0 0 {WIDTH} {height}" role="img">{"".join(parts)}</svg>'
    return f"<figure><figcaption>{html.escape(title)}</figcaption>{drawing}<div class=legend>{legend}</div></figure>"


def thin(x: Array, y: Array, points: int) -> tuple[Array, Array]:
    """Return at most `points` points of a curve (T,), with the smallest and largest value of every part."""
    if len(x) <= points:
        return x, y
    buckets = np.array_split(np.arange(len(x)), max(1, points // 2))
    kept: list[int] = []
    for bucket in buckets:
        values = y[bucket]
        if not np.isfinite(values).any():
            kept.append(int(bucket[0]))
            continue
        kept += sorted({int(bucket[np.nanargmin(values)]), int(bucket[np.nanargmax(values)])})
    chosen = np.array(kept)
    return x[chosen], y[chosen]


def _polyline(line: Line, x: _Axis, y: _Axis, curve: tuple[Array, Array]) -> str:
    px, py = x.px(curve[0]), np.clip(y.px(curve[1]), -1e4, 1e4)
    dots = ""
    if line.marks:
        shown = np.isfinite(px) & np.isfinite(py)
        dots = "".join(
            f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5" fill="{line.color}"/>'
            for a, b in zip(px[shown], py[shown], strict=True)
        )
    return _stroke(line, px, py) + dots


def _stroke(line: Line | SpaceLine, px: Array, py: Array) -> str:
    """Return one path through points (T,) in pixels; NaN interrupts it."""
    path = "".join(
        "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(px[part], py[part], strict=True))
        for part in _stretches(np.isfinite(px) & np.isfinite(py))
    )
    if not path or line.width <= 0:
        return ""
    dash = f' stroke-dasharray="{line.dash}"' if line.dash else ""
    opacity = f' opacity="{line.opacity:g}"' if line.opacity < 1 else ""
    return f'<path d="{path}" stroke="{line.color}" stroke-width="{line.width:g}"{dash}{opacity}/>'


def _stretches(finite: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    where = np.flatnonzero(finite)
    if not len(where):
        return []
    return np.split(where, np.flatnonzero(np.diff(where) > 1) + 1)


def _grid(x: _Axis, y: _Axis) -> str:
    parts = []
    for value in _nice(y.low, y.high, 5):
        py = float(y.px(np.array(value)))
        parts.append(f'<path class="grid" d="M{x.first} {py:.1f}H{x.last}"/>')
        parts.append(f'<text class="tick" x="{x.first - 6}" y="{py + 3.5:.1f}" text-anchor="end">{value:g}</text>')
    return "".join(parts) + _ticks_below(x, y)


def _ticks_below(x: _Axis, y: _Axis) -> str:
    parts = [f'<path class="axis" d="M{x.first} {y.first:.1f}H{x.last}"/>']
    for value in _nice(x.low, x.high, 8):
        px = float(x.px(np.array(value)))
        parts.append(f'<text class="tick" x="{px:.1f}" y="{y.first + 15:.1f}" text-anchor="middle">{value:g}</text>')
    return "".join(parts)


def _window(window: Window, x: _Axis, y: _Axis) -> str:
    left, right = x.px(np.clip(np.array([window.start, window.end]), x.low, x.high))
    bottom, top = y.px(np.clip(np.array([window.low, window.high]), y.low, y.high))
    size = f'width="{right - left:.1f}" height="{bottom - top:.1f}"'
    return f'<rect class="{window.style}" x="{left:.1f}" y="{top:.1f}" {size}/>'


def _limit(limit: Limit, x: _Axis, y: _Axis) -> str:
    py = float(y.px(np.array(limit.value)))
    color = css(LIMIT_RGB)
    return (
        f'<path d="M{x.first} {py:.1f}H{x.last}" stroke="{color}" stroke-width="1.2" stroke-dasharray="5 4"/>'
        f'<text x="{x.last - 4}" y="{py + 12:.1f}" class="tick" style="fill:{color}" text-anchor="end">'
        f"{html.escape(limit.label)}</text>"
    )


def _figure(title: str, lines: Sequence[Line | SpaceLine], drawing: str) -> str:
    legend = "".join(_key(line.label, line.color, line.dash) for line in lines if line.label)
    return f"<figure><figcaption>{html.escape(title)}</figcaption>{drawing}<div class=legend>{legend}</div></figure>"


def _key(label: str, color: str, dash: str) -> str:
    style = "dashed" if dash else "solid"
    return f'<span><i style="border-top:3px {style} {color}"></i>{html.escape(label)}</span>'


def _value_range(
    values: Sequence[Array],
    extra: Sequence[float] = (),
    from_zero: bool = False,
    ceiling: float | None = None,
) -> tuple[float, float]:
    finite = [array[np.isfinite(array)] for array in values]
    known = [*extra, *(float(f(array)) for array in finite if len(array) for f in (np.min, np.max))]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    if ceiling is not None:
        high = min(high, ceiling)
    if from_zero:
        low, high = 0.0, high if high > 0.0 else 1.0
    low, high = _widened(low, high)
    room = 0.06 * (high - low)
    return (low if from_zero else low - room), high + room


def _widened(low: float, high: float) -> tuple[float, float]:
    return (low, high) if high - low > 1e-9 * max(1.0, abs(low)) else (low - 0.5, high + 0.5)


def _nice(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round numbers within [low, high]."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw)
    first = math.ceil(low / step)
    return [round(k * step, 10) for k in range(first, math.floor(high / step) + 1)]
