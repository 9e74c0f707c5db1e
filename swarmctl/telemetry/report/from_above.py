"""The view from above of where vehicles have flown, with equal scales."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from markupsafe import Markup

from swarmctl.core.types import Array
from swarmctl.telemetry.report import svg
from swarmctl.telemetry.report.charts import Ball, Line, axes, value_range
from swarmctl.telemetry.report.svg import Axis, Figure, Stroke, dot, element, ring
from swarmctl.telemetry.report.thinning import shape_of

_TALLEST_PX = 420.0
_POINTS = 7_000  # of all lines together: less than 100 kB
_FEWEST, _MOST = 100, 2_500  # of one line
_ROW_PX = 13.0  # height of a label
# Where a label may be, from its place: best first.
_BESIDE_PX = ((9, -9), (9, 10), (-9, -9), (-9, 10), (0, -17), (0, 18), (9, -22), (-9, 23))
_BALLS = {"keepout": "keep-out", "obstacle": "obstacle"}
_PLACES = {"ring": "goal", "dot": "end"}


class Place(NamedTuple):
    """A place with a name: a goal, where a reference comes to rest, or the end of a flight."""

    pos_ned_m: Array  # (3,)
    label: str
    color: str
    sign: Literal["ring", "dot"]


def top_view(
    title: str,
    lines: Sequence[Line],
    balls: Sequence[Ball],
    *,
    places: Sequence[Place] = (),
    legend: Sequence[Stroke] = (),
) -> Figure:
    """Return a view from above.

    Args:
        title: what is drawn.
        lines: curves; x is to the right (east), y up (north).
        balls: obstacles and keep-outs, drawn in this order.
        places: ends and goals.
        legend: entries before those of lines, balls and places.
    """
    x, y = _scales(lines, balls)
    scale = (x.last - x.first) / (x.high - x.low)  # pixels per metre
    parts = [svg.grid(x, y)]
    for ball in balls:
        center = {"cx": float(x.px(ball.center_ned_m[1])), "cy": float(y.px(ball.center_ned_m[0]))}
        parts.append(element("circle", class_=ball.style, **center, r=float(ball.radius_m * scale)))
    points = int(np.clip(_POINTS // max(1, len(lines)), _FEWEST, _MOST))
    parts += [line.along(*shape_of(x.px(line.x), y.px(line.y), points)) for line in lines]
    known = [place for place in places if np.isfinite(place.pos_ned_m).all()]
    at_px = [(float(x.px(place.pos_ned_m[1])), float(y.px(place.pos_ned_m[0]))) for place in known]
    for place, (px, py) in zip(known, at_px, strict=True):
        parts.append(dot(px, py, 4, place.color) if place.sign == "dot" else ring(px, py, 7, place.color))
    parts += _names([place.label for place in known], at_px)
    styles = {ball.style for ball in balls}
    signs = {place.sign for place in known}
    keys = [Stroke(color="", label=name, sign=style) for style, name in _BALLS.items() if style in styles]
    keys += [Stroke(color="var(--soft)", label=name, sign=sign) for sign, name in _PLACES.items() if sign in signs]
    return svg.figure(title, y.first + svg.BOTTOM_PX, parts, [*legend, *lines, *keys])


def _scales(lines: Sequence[Line], balls: Sequence[Ball]) -> tuple[Axis, Axis]:
    """Return axes with room for everything."""
    edges = [(np.array(ball.center_ned_m), np.array([-ball.radius_m, ball.radius_m])) for ball in balls]
    x_low, x_high = value_range([line.x for line in lines] + [center[1] + edge for center, edge in edges])
    y_low, y_high = value_range([line.y for line in lines] + [center[0] + edge for center, edge in edges])
    wide = svg.WIDTH_PX - svg.LEFT_PX - svg.RIGHT_PX
    scale = min(wide / (x_high - x_low), _TALLEST_PX / (y_high - y_low))  # pixels per metre
    height = max(160.0, (y_high - y_low) * scale + svg.TOP_PX + svg.BOTTOM_PX)
    more_x = (wide / scale - (x_high - x_low)) / 2
    more_y = ((height - svg.TOP_PX - svg.BOTTOM_PX) / scale - (y_high - y_low)) / 2
    return axes((x_low - more_x, x_high + more_x), (y_low - more_y, y_high + more_y), height)


def _names(labels: Sequence[str], at_px: Sequence[tuple[float, float]]) -> Iterator[Markup]:
    """Yield the names of places, each beside its own and clear of the others as far as there is room."""
    taken = [(px - 5, py - 5, px + 5, py + 5) for px, py in at_px]
    for label, (px, py) in zip(labels, at_px, strict=True):
        if not label:
            continue
        boxes = [(right, down, _box(label, px + right, py + down, right)) for right, down in _BESIDE_PX]
        free = (box for box in boxes if not any(_overlap(box[2], other) for other in taken))
        right, down, box = next(free, boxes[0])
        taken.append(box)
        yield svg.mark(px + right, py + down, label, _anchor(right))


def _anchor(right: float) -> str:
    return "start" if right > 0 else "end" if right < 0 else "middle"


def _box(label: str, px: float, py: float, right: float) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom edge of a label whose anchor is at a point."""
    wide = svg.CHARACTER_PX * len(label)
    left = px - {"start": 0.0, "middle": wide / 2, "end": wide}[_anchor(right)]
    return left, py - _ROW_PX / 2, left + wide, py + _ROW_PX / 2


def _overlap(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
