"""Inline SVG, written by hand: time charts, a top view and bars. No script, no font, no request.

Every function returns text. Lines are thinned to a number of points that keeps their extremes.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import Array
from swarmctl.telemetry.palette import LIMIT_RGB, css

WIDTH = 640
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 8, 24


@dataclass(frozen=True, slots=True)
class Line:
    """One curve; NaN breaks it."""

    x: Array  # (T,)
    y: Array  # (T,)
    color: str
    label: str = ""
    dash: str = ""
    width: float = 1.4
    opacity: float = 1.0


class Limit(NamedTuple):
    """A horizontal line that should not be crossed."""

    value: float
    label: str


class Span(NamedTuple):
    """A state held from `start` to `end` on the time axis."""

    start: float
    end: float
    name: str
    color: str


class Circle(NamedTuple):
    """A circle in the plane of the top view, in metres."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, slots=True)
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
) -> str:
    """A figure with one chart over time.

    Args:
        title: what is drawn, with its unit.
        lines: curves over seconds.
        x_range: seconds shown.
        limits: horizontal lines.
        band: seconds to shade, the mission.
        points: kept per line.
        height: of the plot [px].
        from_zero: the value axis begins at 0.
        ceiling: largest value shown; higher ones leave the plot.
    """
    low, high = _value_range([line.y for line in lines], [limit.value for limit in limits], from_zero, ceiling)
    x = _Axis(*_widened(*x_range), _LEFT, WIDTH - _RIGHT)
    y = _Axis(low, high, height - _BOTTOM, _TOP)
    parts = []
    if band is not None:
        left, right = x.px(np.clip(np.array(band), x.low, x.high))
        parts.append(
            f'<rect class="band" x="{left:.1f}" y="{_TOP}" width="{right - left:.1f}" height="{y.first - _TOP}"/>'
        )
    parts += [_grid(x, y), *(_limit(limit, x, y) for limit in limits)]
    parts += [_polyline(line, x, y, thin(line.x, line.y, points)) for line in lines]
    clip = (
        f'<svg x="0" y="{_TOP}" width="{WIDTH}" height="{y.first - _TOP}" viewBox="0 {_TOP} {WIDTH} {y.first - _TOP}">'
    )
    body = (
        "".join(parts[:2]) + clip + "".join(parts[2:]) + "</svg>"
        if band
        else parts[0] + clip + "".join(parts[1:]) + "</svg>"
    )
    return _figure(title, lines, f'<svg viewBox="0 0 {WIDTH} {height}" role="img">{body}</svg>')


def top_view(title: str, lines: Sequence[Line], circles: Sequence[Circle], points: int = 600) -> str:
    """A figure seen from above, equal scales; x is to the right, y up."""
    xs = [line.x for line in lines] + [np.array([c.x - c.radius, c.x + c.radius]) for c in circles]
    ys = [line.y for line in lines] + [np.array([c.y - c.radius, c.y + c.radius]) for c in circles]
    (x_low, x_high), (y_low, y_high) = _value_range(xs), _value_range(ys)
    wide = WIDTH - _LEFT - _RIGHT
    scale = min(wide / (x_high - x_low), 420 / (y_high - y_low))
    height = max(160.0, (y_high - y_low) * scale + _TOP + _BOTTOM)
    extra_x, extra_y = wide / scale - (x_high - x_low), (height - _TOP - _BOTTOM) / scale - (y_high - y_low)
    x = _Axis(x_low - extra_x / 2, x_high + extra_x / 2, _LEFT, WIDTH - _RIGHT)
    y = _Axis(y_low - extra_y / 2, y_high + extra_y / 2, height - _BOTTOM, _TOP)
    parts = [_grid(x, y)]
    for circle in circles:
        cx, cy = float(x.px(np.array(circle.x))), float(y.px(np.array(circle.y)))
        parts.append(f'<circle class="obstacle" cx="{cx:.1f}" cy="{cy:.1f}" r="{circle.radius * scale:.1f}"/>')
    for line in lines:
        kept = (
            np.unique(np.linspace(0, max(0, len(line.x) - 1), points).astype(int)) if len(line.x) else np.zeros(0, int)
        )
        parts.append(_polyline(line, x, y, (line.x[kept], line.y[kept])))
        if line.label and len(line.x) and np.isfinite(line.y[-1]):
            cx, cy = float(x.px(line.x[-1])), float(y.px(line.y[-1]))
            parts.append(f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="4" fill="{line.color}"/>')
    return _figure(title, lines, f'<svg viewBox="0 0 {WIDTH} {height:.0f}" role="img">{"".join(parts)}</svg>')


def state_bars(title: str, rows: Sequence[tuple[str, Sequence[Span]]], x_range: tuple[float, float]) -> str:
    """A figure with one bar per row, coloured by state."""
    x = _Axis(*_widened(*x_range), _LEFT + 40, WIDTH - _RIGHT)
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
    y = _Axis(0.0, 1.0, height - _BOTTOM, _TOP)
    parts.append(_ticks_below(x, y))
    legend = "".join(_key(name, color, "") for name, color in names.items())
    drawing = f'<svg viewBox="0 0 {WIDTH} {height}" role="img">{"".join(parts)}</svg>'
    return f"<figure><figcaption>{html.escape(title)}</figcaption>{drawing}<div class=legend>{legend}</div></figure>"


def thin(x: Array, y: Array, points: int) -> tuple[Array, Array]:
    """At most `points` of a curve, keeping the smallest and the largest value of every stretch."""
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
    finite = np.isfinite(px) & np.isfinite(py)
    path = "".join(
        "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(px[part], py[part], strict=True))
        for part in _stretches(finite)
    )
    if not path:
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
    for value in _nice(y.low, y.high, 4):
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


def _limit(limit: Limit, x: _Axis, y: _Axis) -> str:
    py = float(y.px(np.array(limit.value)))
    color = css(LIMIT_RGB)
    return (
        f'<path d="M{x.first} {py:.1f}H{x.last}" stroke="{color}" stroke-width="1.2" stroke-dasharray="5 4"/>'
        f'<text x="{x.last - 4}" y="{py + 12:.1f}" class="tick" style="fill:{color}" text-anchor="end">'
        f"{html.escape(limit.label)}</text>"
    )


def _figure(title: str, lines: Sequence[Line], drawing: str) -> str:
    legend = "".join(_key(line.label, line.color, line.dash) for line in lines if line.label)
    return f"<figure><figcaption>{html.escape(title)}</figcaption>{drawing}<div class=legend>{legend}</div></figure>"


def _key(label: str, color: str, dash: str) -> str:
    style = "dashed" if dash else "solid"
    return f'<span><i style="border-top:3px {style} {color}"></i>{html.escape(label)}</span>'


def _value_range(
    values: Sequence[Array], extra: Sequence[float] = (), from_zero: bool = False, ceiling: float | None = None
) -> tuple[float, float]:
    finite = [array[np.isfinite(array)] for array in values]
    known = [*extra, *(float(f(array)) for array in finite if len(array) for f in (np.min, np.max))]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    if ceiling is not None:
        high = min(high, ceiling)
    low = 0.0 if from_zero else low
    low, high = _widened(low, high)
    room = 0.06 * (high - low)
    return (low if from_zero else low - room), high + room


def _widened(low: float, high: float) -> tuple[float, float]:
    return (low, high) if high - low > 1e-9 * max(1.0, abs(low)) else (low - 0.5, high + 0.5)


def _nice(low: float, high: float, count: int) -> list[float]:
    """Round numbers inside [low, high], about `count` of them."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw)
    first = math.ceil(low / step)
    return [round(k * step, 10) for k in range(first, math.floor(high / step) + 1)]
