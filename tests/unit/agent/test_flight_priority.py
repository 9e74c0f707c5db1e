"""A process of agents asks for real-time priority, and gives it up where it leaves its processor no time."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from swarmctl.agent import flight_priority
from swarmctl.agent.flight_priority import FlightPriority
from swarmctl.core.clock import SimClock
from swarmctl.process_priority import is_realtime_permitted

PERIOD_US = 20_000


class Process:
    """Ticks for as long as it is told in each period, on a simulated clock."""

    def __init__(self) -> None:
        self.clock = SimClock()
        self.events: list[dict[str, Any]] = []
        self.left = 0
        paced: Any = SimpleNamespace(now_us=self.clock.now_us, sleep_until=self._sleep_until)
        self.priority = FlightPriority(paced, lambda name, **fields: self.events.append({"event": name, **fields}))
        self._due_us = self.clock.now_us()

    def fly(self, seconds: float, tick_us: int) -> None:
        for _ in range(round(seconds * 1e6 / PERIOD_US)):
            self.priority.sleep_until(self._due_us)
            self.clock.advance(tick_us)
            self._due_us = max(self._due_us + PERIOD_US, self.clock.now_us())

    def _sleep_until(self, t_us: int) -> None:
        if t_us > self.clock.now_us():
            self.clock.advance(t_us - self.clock.now_us())


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    made = Process()
    monkeypatch.setattr(flight_priority, "request_realtime", lambda: True)
    monkeypatch.setattr(flight_priority, "leave_realtime", lambda: setattr(made, "left", made.left + 1))
    yield made


def test_who_sleeps_a_little_keeps_the_priority(process: Process) -> None:
    process.priority.ask()
    process.fly(20.0, 14_500)
    assert process.left == 0
    assert [event["granted"] for event in process.events] == [True]


def test_who_hardly_sleeps_for_two_seconds_gives_it_up_once_and_says_so(process: Process) -> None:
    process.priority.ask()
    process.fly(10.0, 14_000)
    process.fly(1.9, 16_000)
    assert process.left == 0
    process.fly(20.0, 16_000)
    assert process.left == 1
    assert [(event["event"], event["granted"]) for event in process.events] == [("realtime", True), ("realtime", False)]
    assert process.events[-1]["spare_01"] < 0.25


def test_who_sleeps_again_asks_again(process: Process) -> None:
    process.priority.ask()
    process.fly(5.0, 19_000)
    process.fly(5.0, 13_000)
    assert [event["granted"] for event in process.events] == [True, False], "a little more sleep is not enough"
    process.fly(2.6, 11_000)
    assert [event["granted"] for event in process.events] == [True, False, True]
    process.fly(5.0, 19_000)
    assert process.left == 2


def test_a_pause_is_no_work(process: Process) -> None:
    process.priority.ask()
    process.fly(5.0, 10_000)
    process.clock.advance(30_000_000)
    process.fly(5.0, 10_000)
    assert process.left == 0


def test_who_was_not_granted_it_has_nothing_to_give_up(process: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight_priority, "request_realtime", lambda: False)
    process.fly(5.0, 30_000)
    process.priority.ask()
    process.fly(5.0, 30_000)
    assert process.left == 0
    assert [event["granted"] for event in process.events] == [False]


LEAVES = """
import os, threading, time
from swarmctl.process_priority import leave_realtime, request_realtime
threading.Thread(target=time.sleep, args=(5.0,), daemon=True).start()
assert request_realtime()
def policies():
    return {os.sched_getscheduler(int(task)) for task in os.listdir("/proc/self/task")}
assert policies() == {os.SCHED_RR}, policies()
leave_realtime()
assert policies() == {os.SCHED_OTHER}, policies()
"""


@pytest.mark.skipif(not is_realtime_permitted(), reason="real-time priority is not permitted here")
def test_all_threads_leave_the_priority() -> None:
    subprocess.run([sys.executable, "-c", LEAVES], check=True, timeout=60.0)
