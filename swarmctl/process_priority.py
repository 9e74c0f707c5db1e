"""Real-time priority (SCHED_RR) or a processor for what flies, and a low priority for what only watches.

Other programs then wait, and not setpoints or vehicle states.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from pathlib import Path

FLIGHT_PRIORITY = 10  # above every program of normal priority, below the kernel's own threads at 50
WATCHER_NICE = 10  # a tenth of the processor time of a program of normal priority, where both want all of it


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


def leave_realtime() -> None:
    """Schedule all threads of this process at normal priority again."""
    with contextlib.suppress(OSError):
        for task in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(int(task.name), os.SCHED_OTHER, os.sched_param(0))


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


def usable_processors() -> tuple[int, ...]:
    """Return the numbers of the processors that this process may use, the least one first."""
    return tuple(sorted(os.sched_getaffinity(0))) if sys.platform == "linux" else tuple(range(os.cpu_count() or 1))


def bind_to_processor(pid: int, processor: int) -> None:
    """Let a process that has just been started run on one processor alone, with all threads that it will start.

    Where the system binds none, or the process has ended, nothing happens.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.sched_setaffinity(pid, {processor})


def give_way() -> None:
    """Let this process, and all that it starts from now on, have the processor time that others leave.

    Linux weighs sessions against each other where it groups processes by them (`autogroup`), and there the niceness of
    a process counts within its session only. So a process with a session of its own lowers that one too; in the session
    of others, as a terminal's, it would slow them down, and for good.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, WATCHER_NICE)
    if os.getsid(0) != os.getpid():
        return
    with contextlib.suppress(OSError):  # it is not Linux, or does not group
        Path("/proc/self/autogroup").write_text(f"{WATCHER_NICE}", encoding="ascii")


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
