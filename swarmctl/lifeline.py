"""A child process that doesn't outlive the launcher that started it. Linux only; elsewhere it does nothing."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
PARENT_ENV = "SWARMCTL_PARENT_PID"  # set by a launcher that wants a child to notice a death before it could ask


def die_with_parent(signum: int = signal.SIGTERM) -> None:
    """Have the kernel send this process `signum` when its parent dies, and send it now if that has happened already.

    The kernel watches the *thread* that started the child, so a launcher starts its children from its main thread.
    """
    if sys.platform != "linux":
        return
    parent = int(os.environ.get(PARENT_ENV) or os.getppid())
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signum, 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), signum)
