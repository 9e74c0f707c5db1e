"""`python -m sitl --autopilot-kind arducopter --tcp-port P`: real vehicles behind real TCP sockets."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink import mavutil

pytestmark = pytest.mark.process
ROOT = Path(__file__).resolve().parents[2]
ENV = {**os.environ, "PYTHONPATH": str(ROOT)}
ARGUMENTS = "--vehicles 2 --autopilot-kind arducopter --preset arducopter --ekf-ready 0.2 --die-with-parent --tcp-port"


@pytest.fixture(scope="module")
def sitl() -> Iterator[tuple[subprocess.Popen[str], list[int]]]:
    """The process and the port of each vehicle."""
    for port in range(27600, 29600, 200):  # others may use some
        argv = [sys.executable, "-m", "sitl", *ARGUMENTS.split(), str(port)]
        process = subprocess.Popen(
            argv, cwd=ROOT, env=ENV, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert process.stdout is not None
        places = [re.search(r"sysid=\d+ tcp=(\d+)", process.stdout.readline()) for _ in range(2)]
        if all(places):
            yield process, [int(place[1]) for place in places if place]
            break
    process.kill()
    process.wait()


def test_mavutil_talks_to_each_vehicle_over_tcp(sitl: tuple[subprocess.Popen[str], list[int]]) -> None:
    process, ports = sitl
    assert ports[1] - ports[0] == 10
    for i, port in enumerate(ports):
        link = mavutil.mavlink_connection(f"tcp:127.0.0.1:{port}", source_system=255)
        beat = link.wait_heartbeat(timeout=3.0)
        assert (beat.autopilot, beat.custom_mode, link.target_system) == (3, 0, i + 1)
        link.param_fetch_one("GUID_OPTIONS")
        assert link.recv_match(type="PARAM_VALUE", blocking=True, timeout=2.0).param_value == 0.0
        link.set_mode_apm("GUIDED")
        deadline = time.monotonic() + 2.0
        while link.flightmode != "GUIDED" and time.monotonic() < deadline:
            link.recv_match(blocking=True, timeout=0.2)
        assert link.flightmode == "GUIDED"
        link.close()
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=5.0) == 0
