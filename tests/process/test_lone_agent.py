"""One agent as it is started on a companion computer: no launch and no bus, and a terminal that may close."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.recorded.records import TICK_DTYPE
from swarmctl.core.types import Phase
from swarmctl.errors import EXIT_INTERRUPTED
from swarmctl.mavlink.codec import Codec
from swarmctl.telemetry.recording.run_files import read_rows
from tests.process.test_check import ENV, ROOT, Pilot, Simulator

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]

CONFIG = """
swarm.agents = 1
start.center_ned_m = [0.0, 0.0, -1.0]
mission.duration_s = 600.0
sitl.enabled = false
telemetry.enabled = false
[[vehicles]]
sysid = 1
url = "udpin://127.0.0.1:{port}"
"""


class Stranger(threading.Thread):
    """Sends what is no vehicle of ours to a port, for as long as the test lasts."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._port, self._ended, self.heard = port, threading.Event(), threading.Event()

    def run(self) -> None:
        beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 128, 0, 4, 3)
        codec, taken = Codec(2, 1), 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.connect(("127.0.0.1", self._port))
            while not self._ended.wait(0.02):
                try:
                    sock.send(b"hello")
                    sock.send(codec.encode(beat))
                    taken += 1
                except ConnectionRefusedError:
                    taken = 0  # nobody is there yet
                if taken == 50:
                    self.heard.set()

    def stop(self) -> None:
        self._ended.set()
        self.join(5.0)


def test_a_stranger_gets_no_link_and_a_closed_terminal_lands_the_vehicle(tmp_path: Path) -> None:
    """A stranger sends first and all the time, another vehicle's heartbeats too; kernel and shell both send SIGHUP."""
    simulator = Simulator(1)
    simulator.wait_until_up()
    [port] = simulator.ports
    simulator.process.send_signal(signal.SIGSTOP)
    config = tmp_path / "lone.toml"
    config.write_text(CONFIG.format(port=port))
    command = [sys.executable, "-m", "swarmctl", "agent", "--config", str(config), "--id", "0"]
    command += ["--run", "lone", "--bus", "none", "--run-dir", str(tmp_path)]
    stranger = Stranger(port)
    stranger.start()
    agent = subprocess.Popen(command, cwd=ROOT, env=ENV, stderr=subprocess.PIPE, text=True)
    try:
        assert stranger.heard.wait(30.0)
        simulator.process.send_signal(signal.SIGCONT)
        deadline_s = time.monotonic() + 60.0
        while read_rows(tmp_path / "agent-0.ticks", TICK_DTYPE)["phase"].max(initial=0) < Phase.GOTO_START:
            assert agent.poll() is None and time.monotonic() < deadline_s
            time.sleep(0.1)
        for _ in range(2):
            agent.send_signal(signal.SIGHUP)
            time.sleep(0.02)
        _, said = agent.communicate(timeout=60)
        assert agent.returncode == EXIT_INTERRUPTED, said
        assert read_rows(tmp_path / "agent-0.ticks", TICK_DTYPE)["phase"][-1] == Phase.DONE
        stranger.stop()
        with Pilot(port) as pilot:
            assert not pilot.armed()
    finally:
        agent.kill()
        stranger.stop()
        simulator.process.send_signal(signal.SIGCONT)
        simulator.stop()
