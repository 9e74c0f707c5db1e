"""`python -m sitl` with one vehicle, for clients that only know UDP: started, told apart from others, ended cleanly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sitl.studies.bench.free_ports import free_ports

ROOT = Path(__file__).resolve().parents[2]
SPEED = 4  # simulated seconds a second: what clients wait for is flight


@contextmanager
def simulator(preset: str = "x500", speed: float = SPEED, port: int | None = None) -> Iterator[int]:
    """Yields the port it sends to, free if none is given, and checks its clean end."""
    port = free_ports(1)[0] if port is None else port
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "sitl", "--vehicles", "1", "--preset", preset, "--speed", str(speed)),
            *("--ekf-ready-s", "0.2", "--remote-ports", str(port), "--local-port", str(free_ports(1)[0])),
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield port
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=10)
        assert process.returncode == 0
        assert "steps" in output
    finally:
        process.kill()
        process.communicate()


def wait_for(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s: {what}"
        time.sleep(0.02)
