"""Tests of the charts in reports: positions of drawn items and interruptions of lines."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl.telemetry.report import svg
from swarmctl.telemetry.report.charts import Ball, Line, SpaceLine, Window, space_view, time_chart

Array = NDArray[np.float64]


def point(drawing: str, color: str) -> tuple[float, float]:
    """Return the position of the dot at the end of a path, right and down in pixels."""
    found = re.search(rf'<circle cx="([-\d.]+)" cy="([-\d.]+)" r="4" fill="{color}"/>', drawing)
    assert found is not None
    return float(found[1]), float(found[2])


def to(*end_ned_m: float, color: str, label: str = "path") -> SpaceLine:
    return SpaceLine(pos_ned_m=np.array([[0.0, 0.0, 0.0], end_ned_m]), color=color, label=label)


def test_space_view_keeps_up_up_north_left_and_east_right() -> None:
    lines = [to(1, 0, 0, color="#n"), to(0, 1, 0, color="#e"), to(0, 0, -1, color="#u"), to(0, 0, 0, color="#o")]
    drawing = space_view("axes", lines)
    (nx, ny), (ex, ey), (ux, uy), (ox, oy) = (point(drawing, color) for color in ("#n", "#e", "#u", "#o"))
    assert uy < oy - 50
    assert ux == pytest.approx(ox, abs=0.2)
    assert nx < ox < ex
    assert ny < oy  # seen from above, what is farther is higher
    assert ey < oy


def test_a_ball_is_drawn_round_and_at_its_place() -> None:
    center_ned_m, radius_m = (9.5, 5.5, -2.3), 1.75
    look = math.radians(35)
    edge_ned_m = (9.5 - radius_m * math.sin(look), 5.5 + radius_m * math.cos(look), -2.3)
    lines = [to(*center_ned_m, color="#c"), to(*edge_ned_m, color="#e")]
    drawing = space_view("ball", lines, [Ball(center_ned_m, radius_m, "keepout")])
    found = re.search(r'<circle class="keepout" cx="([\d.]+)" cy="([\d.]+)" r="([\d.]+)"/>', drawing)
    assert found is not None
    cx, cy, radius = (float(value) for value in found.groups())
    assert point(drawing, "#c") == pytest.approx((cx, cy), abs=0.11)
    assert point(drawing, "#e") == pytest.approx((cx + radius, cy), abs=0.3)


def test_only_the_near_side_is_drawn_over_a_ball() -> None:
    through = SpaceLine(pos_ned_m=np.column_stack([np.linspace(-4, 4, 81), np.zeros(81), np.zeros(81)]), color="#p")
    drawing = space_view("through", [through], [Ball((0.0, 0.0, 0.0), 1.0, "obstacle")])
    before, after = drawing.split('<circle class="obstacle"')
    (all_of_it,) = re.findall(r'd="([^"]*)" stroke="#p"', before)
    (near,) = re.findall(r'd="([^"]*)" stroke="#p"', after)
    assert all_of_it.startswith(near)
    assert near.count("L") == all_of_it.count("L") // 2


def test_a_tall_path_states_its_scale_of_heights() -> None:
    t = np.linspace(0, 37.7, 400)
    spiral = SpaceLine(pos_ned_m=np.column_stack([0.5 * np.cos(t), 0.5 * np.sin(t), -1 - t]), color="#s")
    assert re.search(r"z down \[m\], scale x 0\.0\d+<", space_view("spiral", [spiral]))
    assert "z down [m]<" in space_view("ball", [spiral], [Ball((0.0, 0.0, -10.0), 1.0, "obstacle")])


@pytest.mark.parametrize("rows", [0, 1])
def test_space_view_of_nothing(rows: int) -> None:
    drawing = space_view("nothing", [SpaceLine(pos_ned_m=np.zeros((rows, 3)), color="#z", label="nothing")])
    assert "nan" not in drawing


def test_gaps_break_a_path_in_space() -> None:
    pos_ned_m = np.zeros((9, 3))
    pos_ned_m[:, 0] = np.arange(9)
    pos_ned_m[4] = np.nan
    drawing = space_view("gap", [SpaceLine(pos_ned_m=pos_ned_m, color="#g")])
    (path,) = re.findall(r'd="([^"]*)" stroke="#g"', drawing)
    assert path.count("M") == 2
    assert "nan" not in drawing


def test_a_window_is_cut_where_it_leaves_the_chart() -> None:
    line = Line(x=np.array([0.0, 10.0]), y=np.array([0.0, 10.0]), color="#l")
    drawing = time_chart("window", [line], (0.0, 10.0), windows=[Window(4.0, 6.0, 4.0, 99.0, "obstacle")])
    found = re.search(r'<rect class="obstacle" x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"/>', drawing)
    assert found is not None
    x, y, width, height = (float(value) for value in found.groups())
    wide = 640 - svg.LEFT_PX - svg.RIGHT_PX
    assert x == pytest.approx(svg.LEFT_PX + 0.4 * wide, abs=0.1)
    assert width == pytest.approx(0.2 * wide, abs=0.1)
    assert y == 8.0
    assert 0 < height < 170 - svg.TOP_PX - svg.BOTTOM_PX


def test_marks_are_on_the_known_points() -> None:
    line = Line(x=np.array([0.3, 0.6, 0.9]), y=np.array([1.0, np.nan, 2.0]), color="#m", marks=True)
    assert time_chart("marks", [line], (0.0, 1.0)).count('r="3.5"') == 2
