"""A sample of the fault matrix, with and without protections; all of it is `python -m tests.faults`."""

from __future__ import annotations

import ast
import inspect
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

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


@pytest.mark.parametrize("row", [row for row in ROWS.values() if isinstance(row, LaunchedRow) and row.off.preload])
def test_what_a_launched_row_switches_off_exists(row: LaunchedRow) -> None:
    """A protection that has been renamed would be replaced by nothing, and the row hold without it."""
    known: dict[str, Any] = {}
    for node in ast.walk(ast.parse(row.off.preload)):
        if isinstance(node, ast.Import):
            known |= {name.asname: import_module(name.name) for name in node.names if name.asname}
    for node in ast.walk(ast.parse(row.off.preload)):
        for target in getattr(node, "targets", ()):
            module, *names = ast.unparse(target).split(".")
            if isinstance(target, ast.Attribute) and module in known:
                owner = attrgetter(".".join(names[:-1]))(known[module]) if names[1:] else known[module]
                assert hasattr(owner, names[-1]) or f"self.{names[-1]} = " in inspect.getsource(owner), names


def test_there_are_rows_of_every_kind() -> None:
    kinds = [type(row) for row in ROWS.values()]
    assert len(kinds) >= 60
    assert min(kinds.count(kind) for kind in (SimulatedRow, LaunchedRow, ElsewhereRow)) >= 10


def test_the_page_is_what_the_command_writes() -> None:
    assert (ROOT / PAGE).read_text() == page(), f"run python -m tests.faults --page > {PAGE}"
