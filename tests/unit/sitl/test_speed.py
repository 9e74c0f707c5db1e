"""Simulated time that runs faster than the wall clock, and physics that waits for its clients."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mav

from sitl import realtime
from swarmctl.process_lifetime import StopRequest
from swarmctl.wall_clock import monotonic_us
from tests.benches.flown_world import OFFBOARD, FlownWorld


class Clocked:
    """A world that notes when it is stepped, on both clocks, and stops after `steps`."""

    def __init__(self, stop: StopRequest, steps: int) -> None:
        self.params = FlownWorld(1).world.params
        self.rows: list[tuple[int, int]] = []
        self._stop, self._steps = stop, steps

    def step(self, now_us: int) -> None:
        self.rows.append((monotonic_us(), now_us))
        if len(self.rows) >= self._steps:
            self._stop.ask()


@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_simulated_time_runs_at_its_speed(speed: float) -> None:
    stop = StopRequest()
    world: Any = Clocked(stop, round(75 * speed))
    statistics = realtime.fly(world, stop, None, speed=speed)
    wall_s = (world.rows[-1][0] - world.rows[0][0]) * 1e-6
    sim_s = (world.rows[-1][1] - world.rows[0][1]) * 1e-6
    assert {b[1] - a[1] for a, b in zip(world.rows, world.rows[1:], strict=False)} == {4000} or statistics.stalls
    if not statistics.stalls:
        assert sim_s / wall_s == pytest.approx(speed, rel=0.15)


def test_timeouts_stay_wall_time_as_px4_keeps_them() -> None:
    flown = FlownWorld(2)
    table = flown.world.autopilots[1].parameters
    before = table.real("COM_OF_LOSS_T")
    flown.world.scale_timeouts(5.0)
    assert table.real("COM_OF_LOSS_T") == pytest.approx(5.0 * before)
    assert table.real("COM_DISARM_LAND") == pytest.approx(2.0)


def test_five_times_as_fast_the_stream_may_still_stop_for_a_second() -> None:
    """Wall time: 1.0 s is 5 s of simulated time; without the scaling the loss came after 0.2 s of it."""
    for speed, modes in ((5.0, ("offboard", "offboard", "other")), (1.0, ("offboard", "other", "other"))):
        flown = FlownWorld(1, preset="x500")
        flown.take_off()
        flown.world.scale_timeouts(speed)
        flown.fly_offboard((0.0, 0.0, 0.0), 0.5)
        seen = []
        for wait_s in (0.5, 4.0, 1.0):
            flown.step(wait_s)
            seen.append("offboard" if flown.world.offboard_vehicles() else "other")
        assert tuple(seen) == modes


@pytest.mark.process
def test_the_command_runs_at_its_speed(tmp_path: Path) -> None:
    stats = tmp_path / "stats.json"
    command = [sys.executable, "-m", "sitl", "--vehicles", "1", "--local-port", "47580", "--speed", "5"]
    process = subprocess.Popen([*command, "--stats", f"{stats}"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    began_s = time.monotonic()
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    process.stdout.read()
    wall_s = time.monotonic() - began_s
    assert process.wait(10) == 0
    told = json.loads(stats.read_text(encoding="utf-8"))
    sim_s = told["steps"] / 250 + told["lost_us"] * 1e-6
    assert 3.5 < sim_s / wall_s <= 5.5


def offboard_world(preset: str = "x500") -> FlownWorld:
    flown = FlownWorld(2, preset=preset)
    flown.take_off()
    return flown


class Client(threading.Thread):
    """Streams setpoints to a world that runs in another thread, as slowly as told."""

    def __init__(self, flown: FlownWorld, every_s: float, count: int, stop: StopRequest) -> None:
        super().__init__()
        self._flown, self._every_s, self._count, self._stop_request = flown, every_s, count, stop

    def run(self) -> None:
        for _ in range(self._count):
            for vehicle in (0, 1):
                self._flown.setpoint(vehicle, (0.0, 0.0, 0.0), 0.49)
            time.sleep(self._every_s)
        self._stop_request.ask()


def gated(flown: FlownWorld, every_s: float, count: int, *, gate: bool) -> int:
    """Physics steps made while a client sends `count` setpoints."""
    flown.fly_offboard((0.0, 0.0, 0.0), 0.49)
    assert flown.world.offboard_vehicles() == {0, 1}
    stop = StopRequest()
    flown.clock.advance(1_000_000_000)  # nothing in the pipe may be late
    client = Client(flown, every_s, count, stop)
    world: Any = flown.world
    # continue the world's own clock from its newest step
    base_us, start_us = flown.clock.now_us(), monotonic_us()

    class Shifted:
        """The same world on the wall clock's time axis."""

        params = world.params

        def step(self, now_us: int) -> None:
            world.step(base_us + now_us - start_us)

        def receive(self, now_us: int) -> None:
            world.receive(base_us + now_us - start_us)

        def setpoint_counts(self) -> list[int]:
            counts: list[int] = world.setpoint_counts()
            return counts

        def offboard_vehicles(self) -> set[int]:
            vehicles: set[int] = world.offboard_vehicles()
            return vehicles

    shifted: Any = Shifted()
    gatekeeper = realtime.Gate(shifted) if gate else None
    client.start()
    statistics = realtime.fly(shifted, stop, None, speed=1.0, gate=gatekeeper)
    client.join()
    return statistics.steps


def test_physics_waits_for_a_slow_client() -> None:
    """A client that needs 60 ms for its 20 ms tick: 8 ticks are 160 ms of flight, not half a second."""
    steps = gated(offboard_world(), 0.06, 8, gate=True)
    assert 30 <= steps <= 55
    free = gated(offboard_world(), 0.06, 8, gate=False)
    assert free >= 100


def test_a_silent_client_is_waited_for_once_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime, "GATE_PATIENCE_US", 200_000)
    flown = offboard_world()
    flown.fly_offboard((0.0, 0.0, 0.0), 0.49)
    flown.step(0.02)
    gate, stop = realtime.Gate(flown.world), StopRequest()
    waits_s = []
    for _ in range(3):
        began = time.monotonic()
        gate.wait(stop, flown.clock.now_us())
        waits_s.append(time.monotonic() - began)
    assert waits_s[0] >= 0.2
    assert max(waits_s[1:]) < 0.1
    flown.setpoint(0, (0.0, 0.0, 0.0), 0.49)
    flown.world.receive(flown.clock.now_us())
    gate.wait(stop, flown.clock.now_us())  # vehicle 0 has spoken
    began = time.monotonic()
    gate.wait(stop, flown.clock.now_us())
    assert time.monotonic() - began >= 0.2  # and is waited for again


def test_without_a_vehicle_in_offboard_the_physics_does_not_wait() -> None:
    flown = offboard_world()
    gate = realtime.Gate(flown.world)
    began = time.monotonic()
    gate.wait(StopRequest(), flown.clock.now_us())
    assert time.monotonic() - began < 0.1
    flown.command(0, mav.MAV_CMD_DO_SET_MODE, *OFFBOARD)  # without a setpoint it is refused
    flown.step(0.1)
    assert flown.world.offboard_vehicles() == set()
