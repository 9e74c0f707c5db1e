"""Tests that a tick that is held up in its middle, as by a busy processor, plans and records by its own time."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.core.clock import SimClock
from tests.closed_loop.conftest import Flight, Fly

HELD_UP_US = 33_000
EVERY = 7  # ticks


class BusyClock(SimClock):
    """Loses time in the middle of every seventh tick, at the second look at the stopwatch: when the state is known."""

    def __init__(self) -> None:
        super().__init__()
        self.looks = self.lost_us = 0

    def now_us(self) -> int:
        return super().now_us() + self.lost_us

    def utc_us(self) -> int:
        return super().utc_us() + self.lost_us

    def advance(self, step_us: int) -> None:
        self.looks = self.lost_us = 0
        super().advance(step_us)

    def look_ns(self) -> int:
        self.looks += 1
        if self.looks == 2 and super().now_us() // 20_000 % EVERY == 0:
            self.lost_us = HELD_UP_US
        return 0


def flown(fly: Fly, mode: str) -> Flight:
    return fly(
        "swarm.agents=1",
        "sitl.start=air",
        "mission.duration_s=20",
        f"separation.mode={mode}",
        until=lambda running: running.clock.now_us() >= 8_000_000,
    )


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_reference_and_records_of_a_held_up_tick_are_of_its_beginning(
    fly: Fly, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks: list[BusyClock] = []

    def busy_clock() -> BusyClock:
        clocks.append(BusyClock())
        return clocks[-1]

    monkeypatch.setattr("sitl.lockstep.SimClock", busy_clock)
    monkeypatch.setattr("sitl.lockstep.time.perf_counter_ns", lambda: clocks[-1].look_ns())
    ticks = flown(fly, mode).ticks(0)
    assert len(np.unique(ticks["utc_us"] - ticks["t_us"])) == 1
    tracked = ticks[np.isfinite(ticks["mission_t_s"])]
    assert len(tracked) > 50
    assert np.ptp(np.diff(tracked["mission_t_s"])) < 1e-6
    steps_m = np.linalg.norm(np.diff(tracked["ref_pos_ned_m"], axis=0), axis=1)
    assert np.ptp(steps_m) < 0.002  # at 2.5 m/s, 33 ms are 0.08 m
