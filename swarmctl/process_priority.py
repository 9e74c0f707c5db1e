"""Real-time priority (SCHED_RR) for what flies: other programs then wait, and not setpoints or vehicle states."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

FLIGHT_PRIORITY = 10  # above every program of normal priority, below the kernel's own threads at 50


def request_realtime(pid: int | None = None) -> bool:
    """Schedule all threads of a process before all of normal priority; return False where that is not permitted.

    Ask when the process is ready for flight. One that has priority while it still loads its modules computes for
    seconds on end, and takes turns of 100 ms, the time slice of SCHED_RR, with every agent that flies on the machine.
    Threads that are started later inherit the priority.

    Args:
        pid: the process; None is this one.
    """
    try:
        return all(_raise_priority(int(task.name)) for task in Path(f"/proc/{pid or 'self'}/task").iterdir())
    except OSError:  # the process has ended, or this is not Linux
        return False


def request_realtime_for_this_thread(priority: int = FLIGHT_PRIORITY) -> bool:
    """Schedule the calling thread alone before all of normal priority; return False where that is not permitted.

    Args:
        priority: 1 to 99; the higher one goes first.
    """
    return _raise_priority(threading.get_native_id(), priority)


def is_realtime_permitted() -> bool:
    """Return whether this process, and those that it starts, may have the priority of a flight."""
    granted: list[bool] = []
    asking = threading.Thread(target=lambda: granted.append(request_realtime_for_this_thread()), name="ask-priority")
    asking.start()
    asking.join()
    return granted == [True]


def _raise_priority(thread: int, priority: int = FLIGHT_PRIORITY) -> bool:
    """Give a thread at least this priority: a higher one that it has already is kept."""
    if sys.platform != "linux":
        return False
    try:
        kept = os.sched_getparam(thread).sched_priority
        os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(max(priority, kept)))
    except OSError:
        return False
    return True
