"""Who goes first on a busy machine: the feed of positions, then agents, then autopilots.

Only where the tests have real-time priority (`chrt -r`), which everything they start inherits. Who shares a priority
waits for the others' time slices of 100 ms: an agent would be late, and a position that is fed late is a wrong one.
"""

from __future__ import annotations

import os

AGENTS, FEED = 2, 4  # above the autopilots


def prefix(above: int) -> tuple[str, ...]:
    """Of a command line that is to run that much above this process."""
    return ("chrt", "-r", str(_own() + above)) if _own() else ()


def raise_thread(above: int) -> None:
    """The calling thread runs that much above its process from now on."""
    if _own():
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_own() + above))


def _own() -> int:
    """Real-time priority of this thread, 0 for none."""
    return os.sched_getparam(0).sched_priority if os.sched_getscheduler(0) == os.SCHED_RR else 0
