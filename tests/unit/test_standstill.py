"""What counts as a machine that stood still, of which the suite of real autopilots flies a second time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.benches.standstill import STILL_S, common_gap_s, stood_still_s

TICK_US = 20_000


def ticks(phase_us: int, *lost: int) -> np.ndarray:
    """Instants of a hundred ticks but those that were lost."""
    return np.delete(np.arange(100) * TICK_US + phase_us, lost)


def test_only_what_all_have_lost_at_once_counts() -> None:
    assert common_gap_s([ticks(0), ticks(7_000), ticks(12_000)]) < TICK_US * 1e-6
    one_is_slow = [ticks(0, 50, 51, 52, 53), ticks(7_000), ticks(12_000)]
    assert common_gap_s(one_is_slow) < STILL_S, "an agent that misses its deadlines is our own concern"
    all_are = [ticks(0, 50, 51, 52), ticks(7_000, 50, 51, 52), ticks(12_000, 50, 51, 52)]
    assert common_gap_s(all_are) == pytest.approx(0.068)
    one_after_the_other = [ticks(0, 20, 21, 22), ticks(7_000, 50, 51, 52), ticks(12_000, 70, 71, 72)]
    assert common_gap_s(one_after_the_other) < STILL_S
    assert common_gap_s([ticks(0), ticks(0)[:0]]) == common_gap_s([]) == 0.0


def test_a_launch_that_recorded_no_mission_has_not_stood_still(tmp_path: Path) -> None:
    assert stood_still_s(tmp_path, 3) == 0.0
