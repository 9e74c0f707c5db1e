"""How the kernel schedules a process."""

from __future__ import annotations

import os
from pathlib import Path


def policies(pid: int) -> set[int]:
    """Scheduling policies of all threads of a process."""
    return {os.sched_getscheduler(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()}
