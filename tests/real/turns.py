"""Who flies when: lanes share a folder of locks, so that what one measures is not how busy the others are.

Flights and rows of the conformance suite pass one gate, one after the other: nobody passes who waits.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

LOOK_S = 0.2


@contextlib.contextmanager
def turn(shared: Path, is_alone: bool) -> Iterator[None]:
    """Wait until fewer flights are in the air than this machine has processors.

    A flight whose accuracy or violations are judged waits until there is no other, and no row is played: beside others
    it shares the processors, and what is measured then is how late its ticks are.
    """
    with contextlib.ExitStack() as stack:
        names = [shared / f"flight-{i}.lock" for i in range(len(os.sched_getaffinity(0)))]
        places = [stack.enter_context(name.open("a+")) for name in names]
        rows = stack.enter_context(_rows(shared).open("a+"))
        pass_gate(shared, [[place] for place in places] + [[rows]] if is_alone else [places])
        yield


@contextlib.contextmanager
def row_turn(shared: Path, while_waiting: Callable[[], None]) -> Iterator[None]:
    """Wait until no flight is judged; rows are played side by side. `while_waiting` is called at every look."""
    with _rows(shared).open("a+") as rows:
        pass_gate(shared, [[rows]], fcntl.LOCK_SH, while_waiting)
        yield


def pass_gate(
    shared: Path,
    wanted: Sequence[Sequence[IO[str]]],
    kind: int = fcntl.LOCK_EX,
    while_waiting: Callable[[], None] = lambda: None,
) -> None:
    """Lock any one file of each choice, while nobody else passes."""
    with (shared / "gate.lock").open("a+") as gate:
        for choice, how in [([gate], fcntl.LOCK_EX), *((choice, kind) for choice in wanted)]:
            while not any(locked(file, how) for file in choice):
                while_waiting()
                time.sleep(LOOK_S)


def locked(file: IO[str], kind: int = fcntl.LOCK_EX) -> bool:
    """Lock a file, until it is closed; return False where another process has."""
    try:
        fcntl.lockf(file, kind | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _rows(shared: Path) -> Path:
    return shared / "rows.lock"
