"""The comparison of ticks with those of older code: a slower tick is seen, and this one is not slower."""

from __future__ import annotations

import importlib
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from statistics import median
from types import ModuleType

import pytest

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
SLOWER = """

def _slower(step):
    def stepped(self):
        began_s = time.process_time()
        step(self)
        until_s = time.process_time() + 0.35 * (time.process_time() - began_s)
        while time.process_time() < until_s:
            pass
    return stepped

Lockstep.step = _slower(Lockstep.step)
"""


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies the code, with a text appended to the module of lockstep flights."""

    def copy(appended: str) -> Path:
        for package in ("swarmctl", "sitl"):
            shutil.copytree(ROOT / package, tmp_path / package)
        with (tmp_path / "sitl" / "lockstep.py").open("a") as module:
            module.write(appended)
        return tmp_path

    return copy


@pytest.fixture
def tick_ratio(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the module of the comparison."""
    monkeypatch.syspath_prepend(ROOT / "tools")
    return importlib.import_module("tick_ratio")


def median_ratio(tick_ratio: ModuleType, new: Path, old: Path) -> float:
    return float(median(tick_ratio.ratios(new, old, (*tick_ratio.FLIGHTS["best effort"], "swarm.agents=2"), turns=40)))


def test_a_slower_tick_is_seen(tick_ratio: ModuleType, copied: Callable[[str], Path]) -> None:
    assert median_ratio(tick_ratio, copied(SLOWER), ROOT) > tick_ratio.LIMIT


def test_a_tick_costs_no_more_than_that_of_the_committed_baseline(tick_ratio: ModuleType) -> None:
    commit = tick_ratio.BASELINE.read_text().strip()
    known = subprocess.run(["git", "-C", str(ROOT), "cat-file", "-e", commit], capture_output=True, check=False)
    if known.returncode:
        pytest.skip(f"no commit {commit[:9]}: this is no clone with its history")
    with tick_ratio.checked_out(commit) as old:
        assert median_ratio(tick_ratio, ROOT, old) <= tick_ratio.LIMIT
