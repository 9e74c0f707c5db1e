"""Inline SVG: elements, axes with ticks, paths, dots, and the figure around a drawing. Lengths are pixels.

All charts of all pages are made of these. Text and attributes are escaped; numbers are rounded to a tenth of a pixel.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from markupsafe import Markup

from swarmctl.core.types import Array
from swarmctl.telemetry.report.pages import render

WIDTH_PX = 640
LEFT_PX, RIGHT_PX, TOP_PX, BOTTOM_PX = 62, 12, 8, 30  # margins around the plot: texts grow on narrow screens
_VARIABLE = re.compile(r"var\((--[a-z-]+)\)")
CHARACTER_PX = 6.5  # width of a character
_LEGEND_PX, _KEY_PX = 18, 18  # of a legend: height of a row in a file, width of a sign


@dataclass(frozen=True, slots=True, kw_only=True)
class Stroke:
    """How a curve is drawn, and its name in the legend."""

    color: str
    label: str = ""
    dash: str = ""
    width: float = 1.4
    opacity: float = 1.0
    sign: Literal["line", "dot", "ring", "obstacle", "keepout", "text"] = "line"  # in the legend

    def along(self, px: Array, py: Array) -> Markup:
        """Return the path through points (T,) in pixels; NaN interrupts it."""
        style = {"stroke": self.color, "stroke_width": f"{self.width:g}", "stroke_dasharray": self.dash}
        return polyline(px, py, **style, opacity="" if self.opacity >= 1 else f"{self.opacity:g}")

    def sample(self, px: float, py: float) -> Markup:
        """Return the sign of the legend, whose left edge, half way up, is at a point."""
        middle_px = px + _KEY_PX / 2
        if self.sign == "line":
            return self.along(np.array([px, px + _KEY_PX]), np.array([py, py]))
        if self.sign == "dot":
            return dot(middle_px, py, 4, self.color)
        if self.sign == "ring":
            return ring(middle_px, py, 4, self.color)
        place = {"x": px + 2, "y": py - 5, "width": _KEY_PX - 4.0, "height": 10.0}
        return element("rect", class_=self.sign, **place, rx="3")


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """Maps [low, high] to [first, last] pixels."""

    low: float
    high: float
    first: float
    last: float

    def px(self, values: Array | float) -> Array:
        """Return the pixels (...,) of values (...,)."""
        scale = (self.last - self.first) / (self.high - self.low)
        return self.first + (np.asarray(values, np.float64) - self.low) * scale

    def clipped_px(self, values: Sequence[float]) -> list[float]:
        """Return the pixels of values, those outside of the axis moved to its ends."""
        return [float(px) for px in self.px(np.clip(np.array(values), self.low, self.high))]


def element(name: str, /, *inside: str, **attributes: str | float) -> Markup:
    """Return one element around what is inside; `text_anchor` is written `text-anchor`, an empty attribute left out."""
    words = {
        key.strip("_").replace("_", "-"): f"{value:.1f}" if isinstance(value, float) else value
        for key, value in attributes.items()
        if value != ""
    }
    opening = Markup("<{}").format(name) + Markup("").join(Markup(' {}="{}"').format(*word) for word in words.items())
    return opening + (Markup(">{}</{}>").format(Markup("").join(inside), name) if inside else Markup("/>"))


def polyline(px: Array, py: Array, **attributes: str | float) -> Markup:
    """Return one path through points (T,); NaN interrupts it."""
    known = np.flatnonzero(np.isfinite(px) & np.isfinite(py))
    stretches = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1) if len(known) else []
    path = "".join(
        "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(px[part], py[part], strict=True)) for part in stretches
    )
    return element("path", d=path, **attributes) if path else Markup()


def dot(px: float, py: float, radius: float, color: str) -> Markup:
    """Return a filled dot."""
    return element("circle", cx=px, cy=py, r=f"{radius:g}", fill=color)


def ring(px: float, py: float, radius: float, color: str) -> Markup:
    """Return a circle."""
    return element("circle", cx=px, cy=py, r=f"{radius:g}", fill="none", stroke=color, stroke_width="2")


def tick(px: float, py: float, text: str, anchor: str) -> Markup:
    """Return a small text whose `anchor` (start, middle, end), half way up, is at a point."""
    return element("text", text, class_="tick", x=px, y=py, dy=".32em", text_anchor=anchor)


def mark(px: float, py: float, text: str, anchor: str) -> Markup:
    """Return a small text whose `anchor` is at a point, which is read over lines."""
    return element("text", text, class_="tick mark", x=px, y=py, dy=".32em", text_anchor=anchor)


def grid(x: Axis, y: Axis, x_unit: str = "") -> Markup:
    """Return horizontal lines with their values, and the axis below with its own, the last of them with a unit."""
    parts = []
    for value in round_numbers(y.low, y.high, 4):
        py = float(y.px(value))
        parts.append(element("path", class_="grid", d=f"M{x.first} {py:.1f}H{x.last}"))
        parts.append(tick(x.first - 6, py, f"{value:g}", "end"))
    return Markup("").join([*parts, axis_below(x, y, x_unit)])


def axis_below(x: Axis, y: Axis, unit: str = "") -> Markup:
    """Return the horizontal axis with its ticks, the last of them with a unit."""
    line = element("path", class_="axis", d=f"M{x.first} {y.first:.1f}H{x.last}")
    values = round_numbers(x.low, x.high, 7)
    texts = [f"{value:g}" for value in values[:-1]] + [f"{value:g} {unit}".rstrip() for value in values[-1:]]
    ticks = [
        tick(float(x.px(value)), float(y.first + 16), text, "middle") for value, text in zip(values, texts, strict=True)
    ]
    return Markup("").join([line, *ticks])


class Figure(Markup):
    """The content of a `<figure>`: title, drawing and legend. It is also a drawing that can be kept as a file."""

    heading: str
    _drawing: Markup
    _height_px: float
    _legend: Sequence[Stroke]

    def as_file(self) -> str:
        """Return a whole SVG document, in light colours, with title and legend.

        Colours are written out: few programs but browsers know variables.
        """
        keys, rows = _legend_keys(self._legend, self._height_px + 2 * _LEGEND_PX)
        height_px = self._height_px + _LEGEND_PX * (1.5 + rows)
        document = render(
            __package__,
            "figure.svg",
            title=self.heading,
            drawing=self._drawing,
            keys=keys,
            width_px=WIDTH_PX,
            height_px=height_px,
        )
        colors = _light_colors()
        return _VARIABLE.sub(lambda found: colors[found[1]], document)


@cache
def _light_colors() -> Mapping[str, str]:
    """Return the colours of a page by day, by the names of their variables."""
    return dict(re.findall(r"(--[a-z-]+): *([^;]+);", render(__package__, "light.css")))


def figure(title: str, height_px: float, parts: Iterable[str], legend: Iterable[Stroke]) -> Figure:
    """Return a figure with a legend of the strokes that have a name."""
    inside, named = Markup("").join(parts), [key for key in legend if key.label]
    drawing = element("svg", inside, viewBox=f"0 0 {WIDTH_PX} {height_px:.0f}", role="img")
    drawn = Figure(render(__package__, "chart.html", title=title, drawing=drawing, legend=named))
    drawn.heading, drawn._drawing, drawn._height_px, drawn._legend = title, inside, height_px, named
    return drawn


def _legend_keys(legend: Sequence[Stroke], top_px: float) -> tuple[Markup, int]:
    """Return sign and name of every stroke, in rows from `top_px` down, and the number of rows."""
    keys, px, row = [], float(LEFT_PX), 0
    for key in legend:
        sign_px = 0 if key.sign == "text" else _KEY_PX + 5
        width_px = sign_px + 15 + CHARACTER_PX * len(key.label)
        if px + width_px > WIDTH_PX and px > LEFT_PX:
            px, row = float(LEFT_PX), row + 1
        py = top_px + _LEGEND_PX * row
        keys += [key.sample(px, py)] if sign_px else []
        keys.append(tick(px + sign_px, py, key.label, "start"))
        px += width_px
    return Markup("").join(keys), row + 1 if legend else 0


def widened(low: float, high: float) -> tuple[float, float]:
    """Return a range that is not empty."""
    return (low, high) if high - low > 1e-9 * max(1.0, abs(low)) else (low - 0.5, high + 0.5)


def round_numbers(low: float, high: float, count: int) -> list[float]:
    """Return about `count` round numbers within [low, high]."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw)
    first = math.ceil(low / step)
    return [round(k * step, 10) for k in range(first, math.floor(high / step) + 1)]
