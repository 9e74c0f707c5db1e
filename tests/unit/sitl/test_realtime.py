"""The real-time loop, its files and ports, and the command line's refusals; no processes."""

from __future__ import annotations

import errno
import os
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sitl import realtime
from sitl.__main__ import main
from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.core.recorded.records import TRUTH_DTYPE
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import is_held
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.process_lifetime import StopRequest
from swarmctl.simulator_config import SimulatorConfig


class SteppedWorld:
    """Stands in for a world: counts steps, stalls where told, and stops the loop."""

    def __init__(self, stop: StopRequest, steps: int, stall_at: int = -1, stall_s: float = 0.0) -> None:
        self.params = SimulatorConfig(vehicles=1)
        self.times_us: list[int] = []
        self._stop, self._steps, self._stall_at, self._stall_s = stop, steps, stall_at, stall_s

    def step(self, now_us: int) -> None:
        self.times_us.append(now_us)
        if len(self.times_us) == self._stall_at:
            time.sleep(self._stall_s)
        if len(self.times_us) >= self._steps:
            self._stop.ask()


def flown(steps: int, stall_at: int = -1, stall_s: float = 0.0) -> tuple[realtime.LoopStatistics, np.ndarray[Any, Any]]:
    stop = StopRequest()
    world = SteppedWorld(stop, steps, stall_at, stall_s)
    statistics = realtime.fly(world, stop, None)  # type: ignore[arg-type]
    return statistics, np.diff(world.times_us)


def test_deadlines_are_absolute() -> None:
    started = time.monotonic()
    statistics, gaps_us = flown(100)
    assert statistics.steps == 100
    assert time.monotonic() - started > 0.39
    if statistics.stalls == 0:
        assert set(gaps_us.tolist()) == {4000}


def test_a_short_delay_is_caught_up() -> None:
    statistics, gaps_us = flown(60, stall_at=10, stall_s=0.08)
    assert statistics.late > 0
    if statistics.stalls == 0:
        assert set(gaps_us.tolist()) == {4000}


def test_a_long_stall_is_given_up_and_counted() -> None:
    statistics, gaps_us = flown(60, stall_at=10, stall_s=0.4)
    assert statistics.stalls >= 1
    assert statistics.lost_us > 300_000
    assert gaps_us.max() > 300_000  # stamps keep up with the clock


def test_truth_file_is_an_array(tmp_path: Path) -> None:
    clock = SimClock()
    vehicle_end, _ = pipe_pair(clock.now_us)
    world = SitlWorld(SimulatorConfig(vehicles=1), [vehicle_end])
    truth = realtime.TruthFile(tmp_path / "truth.bin")
    for k in range(500):
        clock.advance(4000)
        world.step(clock.now_us())
        truth.record(world, clock.now_us())
        if k == 300:
            assert (tmp_path / "truth.bin").stat().st_size > 0  # flushed while flying
            assert is_held(tmp_path / "truth.bin")
    assert truth.close() == ""
    rows = np.fromfile(tmp_path / "truth.bin", TRUTH_DTYPE)
    assert len(rows) == pytest.approx(100, abs=1)
    assert set(np.diff(rows["t_us"][1:]).tolist()) == {20000}


def test_truth_file_in_no_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="truth"):
        realtime.TruthFile(tmp_path / "missing" / "truth.bin")


def test_a_full_disk_does_not_stop_the_flight() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    clock = SimClock()
    vehicle_end, _ = pipe_pair(clock.now_us)
    world = SitlWorld(SimulatorConfig(vehicles=1), [vehicle_end])
    truth = realtime.TruthFile(Path("/dev/full"))
    for _ in range(20):
        clock.advance(1_000_000)
        truth.record(world, clock.now_us())
    assert "truth file" in truth.close()


def test_a_disk_that_was_full_for_a_while_is_written_to_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimClock()
    vehicle_end, _ = pipe_pair(clock.now_us)
    world = SitlWorld(SimulatorConfig(vehicles=1), [vehicle_end])
    truth = realtime.TruthFile(tmp_path / "truth.bin")

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    for second in range(4):
        with monkeypatch.context() as disk:
            if second == 1:
                disk.setattr(os, "write", full)
            for _ in range(50):
                clock.advance(realtime.TRUTH_US)
                truth.record(world, clock.now_us())
    assert "rows could not be written" in truth.close()
    rows = np.fromfile(tmp_path / "truth.bin", TRUTH_DTYPE)
    assert len(rows) + truth.lost == 200
    assert 40 < truth.lost < 60


def test_the_end_of_the_port_range_is_refused() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 65535))
        with pytest.raises(StartError, match="free UDP ports"):
            realtime.bind_range(65535, 1)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--vehicles", "0"],
        ["--vehicles", "many"],
        ["--set", "spawn_ned_m=[[1,2]]"],
        ["--set", "spawn_ned_m=[[1,2,nan]]"],
        ["--set", "spawn_ned_m=[[0,0,0]]"],
        ["--origin-lat-deg", "1000"],
        ["--config-json", "{"],
        ["--config-json", "[]"],
        ["--mass-scale", "nan"],
        ["--port", "70000"],
        ["--remote-ports", "14540,14541"],
        ["--sysid-base", "254"],
        ["--truth", "/proc/none/truth.bin"],
        ["--bogus"],
        ["--set", "preset=y"],
        ["--set", "wind.speed=3"],
        ["--set", "spawn_ned_m"],
        ["--speed", "0"],
        ["--drag-scale", "99"],
    ],
)
def test_bad_arguments_are_one_clear_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = main(arguments)
    except SystemExit as end:
        code = int(end.code or 0)
    error = capsys.readouterr().err
    assert code == 2
    assert error.count("\n") == 1
    assert error.startswith("sitl: ")
