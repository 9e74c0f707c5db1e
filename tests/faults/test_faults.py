"""A sample of the fault matrix, with and without protections; all of it is `python -m tests.faults`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.elsewhere import ElsewhereRow
from tests.faults.launched import LaunchedRow
from tests.faults.matrix import ROWS
from tests.faults.page import PAGE, page
from tests.faults.row import UnmetError
from tests.faults.simulated import SimulatedRow

ROOT = Path(__file__).parents[2]
SAMPLE = (
    "solver-3s",
    "solver-not-finite",
    "peer-silent",
    "peer-2khz-numbers",
    "bus-silent-10s",
    "clock-ahead-guaranteed",
    "link-lost-3s",
    "link-lost-3s-arducopter",
    "pilot-kills",
    "above-obstacle-home",
)
UNPROTECTED = ("bus-silent-10s", "link-lost-3s", "link-lost-3s-arducopter", "solver-not-finite", "above-obstacle-home")


@pytest.mark.parametrize("name", SAMPLE)
def test_a_row_holds(name: str, tmp_path: Path) -> None:
    ROWS[name].play(tmp_path / "run")


@pytest.mark.parametrize("name", UNPROTECTED)
def test_a_row_fails_without_its_protection(name: str, tmp_path: Path) -> None:
    with pytest.raises(UnmetError):
        ROWS[name].play(tmp_path / "run", protected=False)


@pytest.mark.process
def test_a_process_row_holds_and_fails_without_its_protection(tmp_path: Path) -> None:
    ROWS["start-configuration-wrong"].play(tmp_path / "protected")
    with pytest.raises(UnmetError):
        ROWS["start-configuration-wrong"].play(tmp_path / "unprotected", protected=False)


def test_there_are_rows_of_every_kind() -> None:
    kinds = [type(row) for row in ROWS.values()]
    assert len(kinds) >= 60
    assert min(kinds.count(kind) for kind in (SimulatedRow, LaunchedRow, ElsewhereRow)) >= 10


def test_the_page_is_what_the_command_writes() -> None:
    assert (ROOT / PAGE).read_text() == page(), f"run python -m tests.faults --page > {PAGE}"
