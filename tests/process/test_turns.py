"""The turns that flights and rows of the suite of real autopilots take, each in a process of its own."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
WAITS_S, SOON_S = 1.0, 10.0
TURNS = {"flight": "turn(shared, False)", "judged": "turn(shared, True)", "row": "row_turn(shared, lambda: None)"}
TAKES = """
import sys
from pathlib import Path
from tests.real.turns import row_turn, turn
shared = Path(sys.argv[1])
print("waits", flush=True)
with {turn}:
    print("flies", flush=True)
    sys.stdin.readline()
"""


class Lane:
    """A process that waits for its turn, and keeps it until it is ended."""

    def __init__(self, shared: Path, kind: str) -> None:
        code = TAKES.format(turn=TURNS[kind])
        pipe = subprocess.PIPE
        line = [sys.executable, "-c", code, str(shared)]
        self.process = subprocess.Popen(line, cwd=ROOT, stdin=pipe, stdout=pipe, bufsize=0)  # `select` sees all of it
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == b"waits\n"

    def flies(self, within_s: float = SOON_S) -> bool:
        """Whether it has its turn in time."""
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], within_s)
        return bool(ready) and self.process.stdout.readline() == b"flies\n"

    def end(self) -> None:
        """Give the turn back."""
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def lane(tmp_path: Path) -> Iterator[Callable[[str], Lane]]:
    """Return a function that starts a lane of a kind."""
    lanes: list[Lane] = []

    def start(kind: str) -> Lane:
        lanes.append(Lane(tmp_path, kind))
        return lanes[-1]

    yield start
    for each in lanes:
        each.end()


@pytest.mark.parametrize(
    ("first", "second", "waits"),
    [
        ("judged", "row", True),
        ("row", "judged", True),
        ("judged", "flight", True),
        ("flight", "judged", True),
        ("judged", "judged", True),
        ("row", "row", False),
        ("row", "flight", False),
        ("flight", "row", False),
    ],
)
def test_a_judged_flight_is_alone(lane: Callable[[str], Lane], first: str, second: str, waits: bool) -> None:
    before = lane(first)
    assert before.flies()
    after = lane(second)
    assert after.flies(WAITS_S if waits else SOON_S) != waits
    if waits:
        before.end()
        assert after.flies()


def test_no_more_flights_than_processors(lane: Callable[[str], Lane]) -> None:
    flights = [lane("flight") for _ in range(len(os.sched_getaffinity(0)))]
    assert all(flight.flies() for flight in flights)
    late = lane("flight")
    assert not late.flies(WAITS_S)
    flights[0].end()
    assert late.flies()


def test_nobody_passes_a_flight_that_waits(lane: Callable[[str], Lane]) -> None:
    before = lane("row")
    assert before.flies()
    judged = lane("judged")
    time.sleep(WAITS_S)  # it is at the gate
    late = lane("row")
    assert not late.flies(WAITS_S), "rows beside that one"
    before.end()
    assert judged.flies()
    assert not late.flies(WAITS_S)
    judged.end()
    assert late.flies()
