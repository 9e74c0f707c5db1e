"""Priorities on a busy machine: first the feed of positions, then agents, then autopilots.

Only where the tests have real-time priority (`chrt -r`), which everything they start inherits. Processes of equal
priority wait for each other's time slices of 100 ms: an agent would be late, and a late position is a wrong one.
"""

from __future__ import annotations

import os

AGENTS, FEED = 2, 4  # above the autopilots


def prefix(above: int) -> tuple[str, ...]:
    """Return the prefix of a command line that is to run that much above this process."""
    return ("chrt", "-r", str(_own() + above)) if _own() else ()


def raise_thread(above: int) -> None:
    """Raise the calling thread that much above its process from now on."""
    if _own():
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_own() + above))


def _own() -> int:
    """Return the real-time priority of this thread, 0 for none."""
    return os.sched_getparam(0).sched_priority if os.sched_getscheduler(0) == os.SCHED_RR else 0
