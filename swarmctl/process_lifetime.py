"""Ends child processes cleanly: with the launcher that started them (Linux only), or on a signal."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import sys
from pathlib import Path
from types import FrameType

_PR_SET_PDEATHSIG = 1
PARENT_ENV = "SWARMCTL_PARENT_PID"  # set by the launcher, so that a child notices a death before its own first check


def die_with_parent(signum: int = signal.SIGTERM) -> None:
    """Have the kernel send this process `signum` when its parent dies; send it now if the parent is dead already.

    The kernel watches the *thread* that started the child, so a launcher starts its children from its main thread.
    """
    if sys.platform != "linux":
        return
    parent = int(os.environ.get(PARENT_ENV) or os.getppid())
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signum, 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), signum)


def remove_socket(path: Path) -> None:
    """Delete a Unix socket and its lock, and their directory if it is then empty."""
    for name in (path, path.with_name(path.name + ".lock")):
        name.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        path.parent.rmdir()


class StopRequest:
    """A stop flag set by signals, for which the interrupted thread can wait.

    It is no `threading.Event`, because a signal handler that runs while its thread holds the event's lock deadlocks.
    """

    def __init__(self, *signums: int) -> None:
        self._read_fd, self._write_fd = os.pipe()
        os.set_blocking(self._write_fd, False)
        self._wanted = False
        for signum in signums:
            signal.signal(signum, self._ask)

    def is_set(self) -> bool:
        return self._wanted

    def wait(self, timeout_s: float) -> bool:
        """Wait for at most `timeout_s`; returns whether a stop has been requested."""
        if not self._wanted:
            select.select([self._read_fd], [], [], max(0.0, timeout_s))
        return self._wanted

    def close(self) -> None:
        """Close both descriptors; the signal handlers stay installed."""
        for fd in (self._read_fd, self._write_fd):
            os.close(fd)

    def _ask(self, signum: int, frame: FrameType | None) -> None:
        if not self._wanted:
            self._wanted = True
            os.write(self._write_fd, b".")
