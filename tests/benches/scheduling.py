"""How the kernel schedules a process, and whether it would grant real-time priority."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from swarmctl.process_priority import request_realtime


def policies(pid: int) -> set[int]:
    """Scheduling policies of all threads of a process."""
    return {os.sched_getscheduler(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()}


def may_run_in_realtime() -> bool:
    """Whether this user may start processes at real-time priority."""
    with subprocess.Popen(["sleep", "60"]) as process:
        permitted = request_realtime(process.pid)
        process.kill()
    return permitted
