"""How the kernel schedules a process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from swarmctl.process_priority import request_realtime_for_this_thread


def policies(pid: int) -> set[int]:
    """Scheduling policies of all threads of a process."""
    return {os.sched_getscheduler(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()}


def niceness(pid: int) -> set[int]:
    """Niceness of all threads of a process, and of its session where the kernel weighs sessions."""
    found = {os.getpriority(os.PRIO_PROCESS, int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()}
    session = Path(f"/proc/{pid}/autogroup")  # "/autogroup-12 nice 0"
    return found | ({int(session.read_text().split()[-1])} if session.exists() else set())


@contextmanager
def realtime_where_permitted(priority: int) -> Iterator[None]:
    """This thread, and what it starts meanwhile, has at least this real-time priority."""
    before, param = os.sched_getscheduler(0), os.sched_getparam(0)
    request_realtime_for_this_thread(priority)
    try:
        yield
    finally:
        os.sched_setscheduler(0, before, param)
