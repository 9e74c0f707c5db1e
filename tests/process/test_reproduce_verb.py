"""`reproduce` as an operator runs it: exit codes, and what is left in the folder."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sitl.studies.thesis.figures import FLIGHTS

pytestmark = pytest.mark.process

SWARMCTL = Path(sys.executable).parent / "swarmctl"


def run(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Away from the checkout: what comes with swarmctl is found from anywhere."""
    return subprocess.run(
        [str(SWARMCTL), *arguments],
        cwd=directory,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_one_flight_is_reproduced(tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder"
    done = run(tmp_path, "reproduce", "--only", "pid_fast", "--plant", "--out", str(out), "--jobs", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "reproduce.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    (rows,) = json.loads((out / "reproduce.json").read_text(encoding="utf-8")).values()
    for row in rows:
        assert row.keys() >= {"name", "published", "ours", "limit", "path", "unit", "note"}
        assert row["name"].startswith("PID fast, Table 6, ")
        assert row["path"] == "plant"
        assert isinstance(row["ours"], float)
    assert rows[0]["published"] == 0.0741
    assert rows[0]["limit"] == pytest.approx(1.2 * 0.0741)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Figure 45: " in page
    assert "Figure 11: " not in page
    assert str(out / "report.html") in done.stdout
    assert "5 published figures: 2 beaten (1 with the thesis' values, the others tuned" in done.stdout
    assert "0 limits missed" in done.stdout
    assert [row["differs"] != [] for row in rows] == [False] * 4 + [True]  # the last is tuned
    for shown in (done.stdout, page):
        assert "ours is less than the published figure" in " ".join(shown.split())


def test_an_unknown_flight_is_2_with_those_that_are_known(tmp_path: Path) -> None:
    done = run(tmp_path, "reproduce", "--only", "nonsense")
    assert done.returncode == 2
    assert "'nonsense' is no experiment" in done.stderr
    assert all(name in done.stderr for name in (*FLIGHTS, "timing"))
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
