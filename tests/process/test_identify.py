"""`swarmctl check --identify` as a program, on the built-in simulator in real time: its flight and its output."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.config import load
from swarmctl.core.recorded.records import TICK_DTYPE
from swarmctl.core.types import Landed, Phase
from swarmctl.telemetry.recording.run_files import load_run
from tests.benches.at_once import at_once
from tests.process.test_check import Pilot, Simulator

pytestmark = pytest.mark.process

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "configs" / "x500_circle.toml"
SHORT = (
    "swarm.agents=1",
    "start.center_ned_m=[0.0, 0.0, -2.0]",
    "sitl.ground_z_m=-0.5",
    "mission.identify.repeats=1",
    "mission.identify.hold_s=1.5",
)


def begin(directory: Path, *arguments: str) -> subprocess.Popen[str]:
    sets = [item for pair in SHORT for item in ("--set", pair)]
    return subprocess.Popen(
        [sys.executable, "-m", "swarmctl", "check", str(CONFIG), "--identify", "--seconds=1", *sets, *arguments],
        cwd=directory,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def landed(directory: Path) -> bool:
    [run] = (directory / "runs").iterdir()
    last = load_run(run).truth[-1]
    return bool(last["landed"] == Landed.ON_GROUND and not last["armed"])


def tracking(directory: Path) -> bool:
    rows = [path.read_bytes() for path in directory.glob("runs/*/agent-0.ticks")]
    size = TICK_DTYPE.itemsize
    return any(np.frombuffer(d, TICK_DTYPE, len(d) // size)["phase"].max(initial=0) == Phase.TRACK for d in rows)


def test_a_flight_becomes_a_table_and_an_interrupted_one_none(tmp_path: Path) -> None:
    """Both are flown beside each other."""
    folders = [tmp_path / name for name in ("whole", "interrupted")]
    for folder in folders:
        folder.mkdir()
    flights = (what_was_flown_becomes_a_table_for_the_configuration, ctrl_c_lands_and_nothing_is_written)
    at_once([partial(flight, folder) for flight, folder in zip(flights, folders, strict=True)])


def what_was_flown_becomes_a_table_for_the_configuration(tmp_path: Path) -> None:
    table = tmp_path / "x500.toml"
    flight = begin(tmp_path, "--apply", "--write", str(table))
    said, _ = flight.communicate(timeout=170)
    assert flight.returncode == 0, said
    assert landed(tmp_path)
    model = load(table).vehicle_model
    assert model.drag_1_s == pytest.approx(1.0, abs=0.2)
    assert model.hover_thrust_01 == pytest.approx(9.81 / 20.0, rel=0.02)
    assert model.tilt_max_rad == load(CONFIG).vehicle_model.tilt_max_rad
    assert "agent-0\tdelay_s\t" in said
    assert table.read_text() in said


def ctrl_c_lands_and_nothing_is_written(tmp_path: Path) -> None:
    table = tmp_path / "x500.toml"
    flight = begin(tmp_path, "--apply", "--write", str(table))
    try:
        deadline_s = time.monotonic() + 90.0
        while not tracking(tmp_path):
            assert flight.poll() is None, flight.communicate()[0]
            assert time.monotonic() < deadline_s
            time.sleep(0.2)
        flight.send_signal(signal.SIGINT)
        said, _ = flight.communicate(timeout=80)
    finally:
        flight.kill()
    assert flight.returncode == 130, said
    assert landed(tmp_path)
    assert not table.exists()


def test_nothing_is_flown_while_somebody_else_flies_it(tmp_path: Path) -> None:
    simulator = Simulator(1)
    simulator.wait_until_up()
    [port] = simulator.ports
    try:
        with Pilot(port) as pilot:
            deadline_s = time.monotonic() + 10.0
            while pilot.arm(True) != 0:
                assert time.monotonic() < deadline_s
            take_off = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_NAV_TAKEOFF, 0, *[math.nan] * 7)
            assert pilot.ask(take_off, "COMMAND_ACK").result == 0
        config = tmp_path / "one.toml"
        vehicle = f'[[vehicles]]\nsysid = 1\nurl = "udpin://127.0.0.1:{port}"\n'
        config.write_text(f"swarm.agents = 1\nstart.center_ned_m = [0, 0, -2]\nsitl.enabled = false\n{vehicle}")
        command = [sys.executable, "-m", "swarmctl", "check", str(config), "--identify", "--apply", "--seconds=1"]
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 4, done.stdout
        assert "another program flies it" in done.stdout
        assert "not flown: something is to fix first" in done.stdout
        assert not (tmp_path / "runs").exists()
        with Pilot(port) as pilot:
            assert pilot.armed()
    finally:
        simulator.stop()


def test_nothing_is_flown_when_the_file_to_write_is_there_already(tmp_path: Path) -> None:
    (tmp_path / "here.toml").write_text("mine")
    flight = begin(tmp_path, "--write", "here.toml")
    printed, _ = flight.communicate(timeout=90)
    assert flight.returncode == 3, printed
    assert "exists already" in printed
    assert not (tmp_path / "runs").exists()
    assert (tmp_path / "here.toml").read_text() == "mine"
