"""Child processes are our own modules, and a request to stop arrives whatever the waiting thread is just doing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import swarmctl
from swarmctl.process_lifetime import PARENT_ENV, StopRequest, module_command

# A signal at a random moment of `wait`, over and over. An Event hangs here within some dozen rounds.
_STORM = """
import random, signal
from swarmctl.process_lifetime import StopRequest
for asked in range(3000):
    stop = StopRequest(signal.SIGALRM)
    signal.setitimer(signal.ITIMER_REAL, random.uniform(2e-5, 2e-4))
    while not stop.is_set():
        stop.wait(0.0)
    stop.close()
print(asked)
"""


def test_a_signal_at_any_moment_never_locks_the_waiting_thread() -> None:
    done = subprocess.run([sys.executable, "-c", _STORM], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "2999"


def test_a_signal_ends_the_wait_at_once() -> None:
    before = signal.getsignal(signal.SIGUSR1)
    try:
        stop = StopRequest(signal.SIGUSR1)
        assert not stop.wait(0.0)
        os.kill(os.getpid(), signal.SIGUSR1)
        began_s = time.monotonic()
        assert stop.wait(10.0)
        assert time.monotonic() - began_s < 5.0
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_without_a_signal_it_waits_as_long_as_it_is_told() -> None:
    began_s = time.monotonic()
    assert not StopRequest().wait(0.05)
    assert time.monotonic() - began_s >= 0.05


# A launcher that starts a child and dies before the child has asked the kernel to watch over it.
_ORPHAN = """
import os, subprocess, sys, time
from swarmctl.process_lifetime import PARENT_ENV
child = (
    "import os, sys, time\\n"
    "from swarmctl.process_lifetime import PARENT_ENV, die_with_parent\\n"
    "while os.getppid() == int(os.environ[PARENT_ENV]): time.sleep(0.01)\\n"
    "print('ready', flush=True)\\n"
    "die_with_parent()\\n"
    "time.sleep(1.0)\\n"
    "print('flies on', flush=True)\\n"
)
subprocess.Popen([sys.executable, "-c", child], env={**os.environ, PARENT_ENV: str(os.getpid())})
"""


def test_a_child_whose_launcher_is_dead_already_does_not_outlive_it() -> None:
    """Its output ends when it does: both the launcher and the child hold the pipe."""
    done = subprocess.run([sys.executable, "-c", _ORPHAN], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines() == ["ready"]


def test_a_child_whose_launcher_lives_goes_on() -> None:
    code = "from swarmctl.process_lifetime import die_with_parent; die_with_parent(); print('flies on')"
    environment = {**os.environ, PARENT_ENV: str(os.getpid())}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines() == ["flies on"]


def test_files_of_the_current_folder_take_the_place_of_no_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A `queue` beside an own controller: pyarrow could not be imported, so that nothing flew, or had no view."""
    (tmp_path / "queue.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.chdir(tmp_path)
    command = module_command("sitl.simulate", "--help")
    where = {**os.environ, "PYTHONPATH": str(Path(swarmctl.__file__).parents[1])}
    done = subprocess.run(command, env=where, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    control = [sys.executable, "-m", "queue"]
    assert subprocess.run(control, capture_output=True, text=True, timeout=60).stderr == "imported\n"


def test_from_its_own_checkout_the_package_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(swarmctl.__file__).parents[1])
    without = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        module_command("swarmctl", "--version"), env=without, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
