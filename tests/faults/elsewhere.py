"""Rows that are tests already: the test is the row, and its negative control the row without its protection."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.faults.row import Played, Row, require

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, kw_only=True)
class ElsewhereRow(Row):
    """A row that a test plays.

    Attributes:
        test, control: as pytest names them. A test that flies both ways is its own control.
    """

    test: str
    control: str

    def play(self, folder: Path, *, protected: bool = True) -> Played:
        name = self.test if protected else self.control
        line = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "--no-header", name]
        done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
        tail = " ".join(done.stdout.strip().splitlines()[-3:])
        if protected:
            require(done.returncode == 0, f"{name}: {tail}")
        else:  # what it shows is that the harm happens
            require(done.returncode != 0, f"{name} shows the harm")
        return Played()
