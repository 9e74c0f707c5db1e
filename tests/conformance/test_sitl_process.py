"""`python -m sitl` as a user starts it: ports, latch, truth on SIGTERM, and no orphan."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mav

from swarmctl.core.recorded.records import TRUTH_DTYPE
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.process_priority import is_realtime_permitted
from swarmctl.wall_clock import monotonic_us
from tests.benches.scheduling import policies

pytestmark = pytest.mark.process

ROOT = Path(__file__).resolve().parents[2]
ENV = {**os.environ, "PYTHONPATH": str(ROOT)}
FIRST_PORT, FIRST_LOCAL_PORT = 24540, 24580


def start(*arguments: str) -> tuple[subprocess.Popen[str], list[tuple[int, int]]]:
    """A simulator, and (local, remote) port of each vehicle."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sitl", "--port", str(FIRST_PORT), "--local-port", str(FIRST_LOCAL_PORT), *arguments],
        cwd=ROOT,
        env=ENV,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    wanted = int(arguments[arguments.index("--vehicles") + 1]) if "--vehicles" in arguments else 3
    ports: list[tuple[int, int]] = []
    while len(ports) < wanted:
        line = process.stdout.readline()
        assert line, "ended before it was ready"
        found = re.search(r"local=(\d+) remote=(\d+)", line)
        if found:
            ports.append((int(found[1]), int(found[2])))
    return process, ports


def stop(process: subprocess.Popen[str], number: int = signal.SIGTERM) -> str:
    process.send_signal(number)
    try:
        output, _ = process.communicate(timeout=10)
    finally:
        process.kill()
    assert process.returncode == 0
    return output


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly_with_all_truth_written(tmp_path: Path, number: int) -> None:
    process, _ = start("--truth", str(tmp_path / "truth.bin"))
    time.sleep(1.0)
    output = stop(process, number)
    assert output.count("\n") == 1
    rows = np.fromfile(tmp_path / "truth.bin", TRUTH_DTYPE)
    assert (tmp_path / "truth.bin").stat().st_size == rows.nbytes
    assert len(rows) >= 3 * 30
    assert rows["t_us"][-1] <= monotonic_us()
    np.testing.assert_allclose(rows["pos_ned_m"][:3, 0], [-1.0, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize(("arguments", "wants"), [((), True), (("--no-realtime",), False), (("--lockstep",), False)])
def test_other_programs_wait_for_the_vehicles(arguments: tuple[str, ...], wants: bool) -> None:
    process, _ = start(*arguments)
    scheduled = policies(process.pid)
    stop(process)
    assert scheduled == {os.SCHED_RR if wants and is_realtime_permitted() else os.SCHED_OTHER}


def test_a_second_simulator_takes_the_next_ports() -> None:
    first, first_ports = start("--vehicles", "2")
    second, second_ports = start("--vehicles", "2")
    stop(first)
    stop(second)
    assert not {p for pair in first_ports for p in pair} & {p for pair in second_ports for p in pair}
    assert {remote - local for local, remote in first_ports + second_ports} == {FIRST_PORT - FIRST_LOCAL_PORT}


def test_the_first_sender_is_the_only_one_answered_and_obeyed() -> None:
    process, [(local, _)] = start("--vehicles", "1", "--ekf-ready-s", "0.2")
    codec = Codec(1, 191)
    arm = codec.encode(mav.MAVLink_command_long_message(1, 1, 400, 0, 1, *[0.0] * 6))
    beat = codec.encode(mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as owner,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as intruder,
    ):
        for sock in (owner, intruder):
            sock.bind(("127.0.0.1", 0))
            sock.settimeout(0.5)
        owner.sendto(beat, ("127.0.0.1", local))
        assert owner.recv(2048)
        intruder.sendto(arm, ("127.0.0.1", local))
        with pytest.raises(TimeoutError):
            intruder.recv(2048)
        armed = False
        deadline = time.monotonic() + 1.5
        while time.monotonic() < deadline:
            for frame in frames(owner.recv(2048)):
                message = codec.decode(frame)
                if message is not None and message.get_type() == "HEARTBEAT":
                    armed = armed or bool(message.base_mode & 128)
        assert not armed
    stop(process)


def test_it_dies_with_its_parent() -> None:
    script = (
        "import subprocess, sys, time\n"
        f"p = subprocess.Popen([sys.executable, '-m', 'sitl', '--die-with-parent', '--port', '{FIRST_PORT}',"
        f" '--local-port', '{FIRST_LOCAL_PORT}'], stdout=subprocess.PIPE)\n"
        "p.stdout.readline()\n"
        "print(p.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, env=ENV, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.kill()
    parent.communicate()
    deadline = time.monotonic() + 5.0
    while running(child):
        assert time.monotonic() < deadline, "the simulator outlived its parent"
        time.sleep(0.05)


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("given", [True, False], ids=["given peer", "control: latched peer"])
def test_a_stray_datagram_does_not_take_over_a_vehicle_whose_peer_is_given(given: bool) -> None:
    """Somebody who still talks to the port of an earlier simulator must not be taken for the agent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as agent:
        agent.bind(("127.0.0.1", 0))
        port = agent.getsockname()[1]
        process, ((local, _),) = start(
            "--vehicles", "1", *(["--remote-ports", str(port)] if given else ["--port", str(port)])
        )
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stray:
            stray.sendto(b"\xfd", ("127.0.0.1", local))
            time.sleep(0.5)
            agent.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while agent.recv(2048):
                    pass
            agent.settimeout(3.0)
            if given:
                assert agent.recv(2048)
            else:
                with pytest.raises(TimeoutError):
                    agent.recv(2048)
        stop(process)
