"""What is beaten, met or missed, and that page and terminal count it the same."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from sitl.studies.thesis.page import write_page
from sitl.studies.thesis.reproduce import show
from sitl.studies.thesis.trace import Row
from sitl.studies.thesis.verdicts import MEANING, counted, counts_text, verdict_of

ROW = Row(name="row", published=0.0024, ours=0.002, limit=None, path="plant", unit="m2", decimals=4)


@pytest.mark.parametrize(
    ("ours", "beside"),
    [(0.00234, "beaten"), (0.00236, "equal"), (0.00244, "equal"), (0.00246, "worse"), (float("nan"), "worse")],
)
def test_figures_are_compared_at_the_digits_that_are_printed(ours: float, beside: str) -> None:
    assert replace(ROW, ours=ours).beside == beside


def test_a_figure_printed_as_zero_is_compared_too() -> None:
    zero = replace(ROW, published=0.0)
    assert replace(zero, ours=4e-5).beside == "equal"
    assert replace(zero, ours=6e-5).beside == "worse"


def test_who_comes_closer_than_the_thesis_allows_beats_nothing() -> None:
    assert replace(ROW, short_m=0.010).beside == "beaten"
    assert replace(ROW, short_m=0.011).beside == "too close"
    assert replace(ROW, short_m=0.011, ours=0.003).beside == "worse"


def test_a_limit_out_of_reach_is_missed_all_the_same() -> None:
    far = replace(ROW, limit=0.001, lower_bound=0.0015)
    assert (far.met, far.out_of_reach, verdict_of(far)) == (False, True, "missed, out of reach")
    near = replace(ROW, limit=0.001, lower_bound=0.0005)
    assert (near.met, near.out_of_reach, verdict_of(near)) == (False, False, "missed")
    assert verdict_of(replace(ROW, limit=0.002)) == "met"
    assert verdict_of(replace(ROW, limit=0.002, ours=float("nan"))) == "missed"
    assert verdict_of(ROW) == ""


TUNED = ("controller.mpc.x.r 0.01 (thesis 0.75)",)
ROWS = [
    replace(ROW, name="MPC fast, beaten as printed", preset="thesis_4"),
    replace(ROW, name="MPC fast, beaten, tuned", preset="improved_4", differs=TUNED, matched_start=True, limit=0.003),
    replace(ROW, name="MPC fast, equal", ours=0.0024),
    replace(ROW, name="MPC fast, worse", ours=0.003, limit=0.001, lower_bound=0.0015, bound_source="some command"),
    replace(ROW, name="MPC fast, too close", short_m=1.0, limit=0.001, lower_bound=0.0005, bound_source="sqrt(3) r"),
    replace(ROW, name="MPC fast, without a published figure", published=None, ours=2.0, limit=2.5),
]
COUNTS = (
    "6 rows; 5 published figures: 2 beaten (1 with the thesis' values, the others tuned; 1 from a matched start), "
    "1 equal, 1 worse, 1 too close; 4 limits: 2 met, 2 limits missed (1 of them out of reach)"
)


def test_every_row_is_counted_once() -> None:
    counts = counted(ROWS)
    assert counts.published == counts.beaten + counts.equal + counts.worse + counts.too_close
    assert counts_text(counts) == COUNTS


def test_the_page_shows_counts_words_bounds_and_what_is_tuned(tmp_path: Path) -> None:
    page = write_page(tmp_path, ROWS, {}).read_text(encoding="utf-8").replace("&#39;", "'")
    assert COUNTS in page
    table = page[page.index("<h2>Published and ours</h2>") :]
    head = table[: table.index("<th>")]
    assert all(f"<b>{word}</b>: {meaning}" in head for word, meaning in MEANING.items())
    assert page.count('<span class="bad">missed') == 2
    assert page.count('<span class="ok">met') == 2
    (missed,) = re.findall(r"<ul class=violations>(.*?)</ul>", page)
    assert re.findall(r"<li>(.*?)</li>", missed) == [
        "MPC fast, worse: 0.003 m2, limit 0.001, lower bound 0.0015 (some command): out of reach",
        "MPC fast, too close: 0.002 m2, limit 0.001, lower bound 0.0005 (sqrt(3) r)",
    ]
    assert "1 of 2 presets are tuned" in page
    assert TUNED[0] in page


def test_the_terminal_shows_words_and_verdicts() -> None:
    screen = Console(file=io.StringIO(), width=300)
    show(ROWS, screen)
    assert isinstance(screen.file, io.StringIO)
    text = screen.file.getvalue()
    words = " ".join(text.split())  # the head is as wide as the table
    assert all(f"{word}: {meaning}." in words for word, meaning in MEANING.items())
    assert words.index(MEANING["met, missed"]) < words.index(ROWS[0].name)
    lines = {row.name: next(line for line in text.splitlines() if row.name in line) for row in ROWS}
    assert "missed, out of reach" in lines["MPC fast, worse"]
    assert "too close" in lines["MPC fast, too close"].split("too close", 1)[1]
    assert all(("missed" in line) is (row.met is False) for row, line in zip(ROWS, lines.values(), strict=True))
    assert [name for name, line in lines.items() if line.rstrip().endswith("met")] == [ROWS[1].name, ROWS[5].name]
