"""The comparison of ticks with those of other code: a slower tick is seen, the same one is not taken for slower."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from statistics import median

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


@pytest.mark.parametrize(("appended", "is_slower"), [("", False), (SLOWER, True)], ids=["the same", "slower"])
def test_a_slower_tick_is_seen(
    monkeypatch: pytest.MonkeyPatch, copied: Callable[[str], Path], appended: str, is_slower: bool
) -> None:
    monkeypatch.syspath_prepend(ROOT / "tools")
    from tick_ratio import FLIGHTS, LIMIT, ratios

    found = ratios(copied(appended), ROOT, (*FLIGHTS["best effort"], "swarm.agents=2"), turns=40)
    assert (median(found) > LIMIT) == is_slower
