"""Real-time priority for processes whose peers don't wait: a client that gets no processor loses datagrams."""

from __future__ import annotations

import os

CLIENT_PRIORITY = 1  # below the 10 of launched flights


def request_realtime(pid: int, priority: int = CLIENT_PRIORITY) -> bool:
    """Schedule a process that has just started, or this thread (0), first; whether that is permitted."""
    try:
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(priority))
    except PermissionError:
        return False
    return True
