"""Tests of page templates and SVG elements: what is put in is escaped, what is missing is an error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from jinja2 import UndefinedError
from markupsafe import Markup

from sitl.studies.campaign.page import write_page as write_campaign
from swarmctl.telemetry.report.pages import render
from swarmctl.telemetry.report.svg import Axis, Stroke, axis_below, element, figure, polyline

SHARED = "swarmctl.telemetry.report"
HOSTILE = "<script>\"'&"
ESCAPED = "&lt;script&gt;&#34;&#39;&amp;"


def test_text_is_escaped_and_markup_is_not() -> None:
    page = render(SHARED, "chart.html", title=HOSTILE, drawing=Markup("<svg/>"), legend=[])
    assert page == f"<figcaption>{ESCAPED}</figcaption><svg/><div class=legend></div>\n"


def test_a_value_that_nobody_gave_is_an_error() -> None:
    with pytest.raises(UndefinedError, match="drawing"):
        render(SHARED, "chart.html", title="", legend=[])


def test_another_package_extends_the_shared_page(tmp_path: Path) -> None:
    directory = tmp_path / HOSTILE
    directory.mkdir()
    page = write_campaign(directory, []).read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>\n<html lang=en>\n<head>")
    assert f"<title>Campaign {ESCAPED}</title>" in page
    assert ":root { color-scheme: light dark }" in page
    assert page.endswith("</html>\n")


def test_an_element_escapes_its_attributes_and_what_is_inside() -> None:
    drawn = element("text", HOSTILE, class_=HOSTILE, x=1.26, y=3, text_anchor="end", opacity="")
    assert drawn == f'<text class="{ESCAPED}" x="1.3" y="3" text-anchor="end">{ESCAPED}</text>'
    assert element("g", element("path", d="M0 0")) == '<g><path d="M0 0"/></g>'


def test_a_figure_escapes_names_of_its_legend() -> None:
    drawn = figure("title", 100.4, [element("g")], [Stroke(color="#123456", label=HOSTILE, dash="4 3")])
    assert f'<span><i style="border-top:3px dashed #123456"></i>{ESCAPED}</span>' in drawn
    assert '<svg viewBox="0 0 640 100" role="img"><g/></svg>' in drawn


def test_nan_interrupts_a_path() -> None:
    px = np.array([np.nan, 0.0, 1.0, np.nan, 2.0, np.inf])
    assert polyline(px, np.zeros(6), stroke="#1") == '<path d="M0.0 0.0L1.0 0.0M2.0 0.0" stroke="#1"/>'
    assert polyline(px, np.full(6, np.nan), stroke="#1") == ""


def test_ticks_stand_at_round_numbers_below_their_value() -> None:
    x = Axis(low=-0.1, high=10.1, first=50, last=50 + 102)
    drawn = axis_below(x, Axis(low=0.0, high=1.0, first=80, last=0))
    assert drawn.startswith('<path class="axis" d="M50 80.0H152"/>')
    assert '<text class="tick" x="51.0" y="96.0" dy=".32em" text-anchor="middle">0</text>' in drawn
    assert '<text class="tick" x="151.0" y="96.0" dy=".32em" text-anchor="middle">10</text>' in drawn
