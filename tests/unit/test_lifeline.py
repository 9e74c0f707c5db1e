"""A request to stop arrives whatever the waiting thread is just doing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

from swarmctl.lifeline import StopRequest

# A signal at a random moment of `wait`, over and over. An Event hangs here within some dozen rounds.
_STORM = """
import random, signal
from swarmctl.lifeline import StopRequest
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
