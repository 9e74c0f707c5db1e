"""Tests that a tick that is held up on its way, as by a busy processor, plans and records by its own time."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.core.clock import SimClock
from tests.closed_loop.conftest import Fly

HELD_UP_US = 33_000
EVERY = 7  # ticks


class BusyClock(SimClock):
    """Loses time in every seventh tick, at the n-th look at the stopwatch: 1 at its beginning, 2 with the state."""

    def __init__(self, look: int) -> None:
        super().__init__()
        self.look = look
        self.looks = self.lost_us = self.held_up = 0

    def now_us(self) -> int:
        return super().now_us() + self.lost_us

    def utc_us(self) -> int:
        return super().utc_us() + self.lost_us

    def advance(self, step_us: int) -> None:
        self.looks = self.lost_us = 0
        super().advance(step_us)

    def look_ns(self) -> int:
        self.looks += 1
        if self.looks == self.look and super().now_us() // 20_000 % EVERY == 0:
            self.lost_us = HELD_UP_US
            self.held_up += 1
        return 0


@pytest.mark.parametrize("look", [1, 2])
@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_references_commitments_and_records_of_a_held_up_tick_are_of_its_beginning(
    fly: Fly, mode: str, look: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks: list[BusyClock] = []
    followed_ned_m: list[np.ndarray] = []  # where the plan of each tick is to begin

    def busy_clock() -> BusyClock:
        clocks.append(BusyClock(look))
        return clocks[-1]

    def until(running: Lockstep) -> bool:
        (agent,) = running.agents
        rows = running.logs[0].rows
        if agent is not None and rows and np.isfinite(rows[-1]["mission_t_s"][0]):
            committed = agent._planner.directive.reference
            truth = running.world.truth_rows()
            reference, _ = agent._planner._references.reference(truth["pos_ned_m"][0], truth["vel_ned_m_s"][0])
            followed_ned_m.append((reference if committed is None else committed).pos_ned_m[0].copy())
        return running.clock.now_us() >= 8_000_000

    monkeypatch.setattr("sitl.lockstep.SimClock", busy_clock)
    monkeypatch.setattr("sitl.lockstep.time.perf_counter_ns", lambda: clocks[-1].look_ns())
    alone = ("swarm.agents=1", "sitl.start=air", "mission.duration_s=20", f"separation.mode={mode}")
    ticks = fly(*alone, until=until).ticks(0)
    assert clocks[-1].held_up > 50
    assert len(np.unique(ticks["utc_us"] - ticks["t_us"])) == 1
    tracked = ticks[np.isfinite(ticks["mission_t_s"])]
    assert len(tracked) > 50 and tracked["mission_t_s"][0] >= 0.0
    assert np.ptp(np.diff(tracked["mission_t_s"])) < 1e-6
    for places_ned_m in (tracked["ref_pos_ned_m"], np.array(followed_ned_m)):
        steps_m = np.linalg.norm(np.diff(places_ned_m, axis=0), axis=1)
        assert np.abs(np.diff(steps_m)).max() < 0.02  # at 2.5 m/s, 33 ms are 0.08 m
