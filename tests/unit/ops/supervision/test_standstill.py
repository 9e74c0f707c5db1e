"""A process that does not run is told from one that is only silent."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import psutil

from swarmctl.ops.processes import Child, Command
from swarmctl.ops.supervision.standstill import Standstill

BUSY = "import time\nwhile True:\n    time.sleep(0.002)\n    sum(range(20000))"


HANGS = """
import threading, time
def busy():
    while True:
        time.sleep(0.002)
        sum(range(20000))
threading.Thread(target=busy, daemon=True).start()
time.sleep(60)
"""


def wait_until_it_runs(child: Child) -> None:
    used_s = child.processor_s()
    while child.processor_s() == used_s:
        time.sleep(0.02)


def looked(standstill: Standstill, child: Child, seconds: float) -> float:
    """Look every 50 ms, as the supervisor does; return the newest answer."""
    until_s, lasts_s = time.monotonic() + seconds, 0.0
    while time.monotonic() < until_s:
        lasts_s = standstill.lasts_s(child, time.monotonic())
        time.sleep(0.05)
    return lasts_s


def test_a_process_stands_still_while_it_is_stopped(tmp_path: Path) -> None:
    standstill, child = Standstill(), Child(Command("busy", (sys.executable, "-Sc", BUSY)), tmp_path)
    try:
        wait_until_it_runs(child)
        os.kill(child.pid, signal.SIGSTOP)
        assert looked(standstill, child, 1.5) > 1.0
        os.kill(child.pid, signal.SIGCONT)
        wait_until_it_runs(child)
        assert standstill.lasts_s(child, time.monotonic()) == 0.0
    finally:
        child.kill_all()
        assert child.wait(10.0)
    assert standstill.lasts_s(child, time.monotonic()) == 0.0


def test_a_process_whose_main_thread_hangs_stands_still_while_others_go_on(tmp_path: Path) -> None:
    """An agent ticks in its main thread; recorder and bus have others."""
    standstill, child = Standstill(), Child(Command("hangs", (sys.executable, "-Sc", HANGS)), tmp_path)
    try:
        process = psutil.Process(child.pid)
        deadline_s = time.monotonic() + 30.0
        while process.num_threads() < 2 and time.monotonic() < deadline_s:
            time.sleep(0.02)
        before_s = sum(process.cpu_times()[:2])
        assert looked(standstill, child, 2.0) > 1.0
        assert sum(process.cpu_times()[:2]) > before_s
    finally:
        child.kill_all()
        assert child.wait(10.0)
