"""Real-time priority (SCHED_RR) for what flies: other programs then wait, and not setpoints or vehicle states."""

from __future__ import annotations

import os
import sys

FLIGHT_PRIORITY = 10  # above every program of normal priority, below the kernel's own threads at 50


def request_realtime(pid: int = 0, priority: int = FLIGHT_PRIORITY) -> bool:
    """Schedule a process before all of normal priority; return False where that is not permitted.

    Ask when it has just been started: threads that it starts later inherit the priority. A higher real-time priority
    that it has already is kept.

    Args:
        pid: the process; 0 is the calling thread.
        priority: 1 to 99; the higher one goes first.
    """
    if sys.platform != "linux":
        return False
    try:
        kept = os.sched_getparam(pid).sched_priority
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(max(priority, kept)))
    except OSError:
        return False
    return True
