"""How a child process ends: with the launcher that started it (Linux only), or when it is asked to, leaving nothing."""

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


def remove_socket(path: Path) -> None:
    """Delete a Unix socket, its lock, and their directory if that leaves it empty: who ends last takes it away."""
    for name in (path, path.with_name(path.name + ".lock")):
        name.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        path.parent.rmdir()


class StopRequest:
    """Set by a signal, waited for by the thread the signal interrupts.

    Not a `threading.Event`: a handler that runs while that thread holds the event's lock waits for it for ever.
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
        """Whether it has been asked for, at the latest after `timeout_s`."""
        if not self._wanted:
            select.select([self._read_fd], [], [], max(0.0, timeout_s))
        return self._wanted

    def close(self) -> None:
        """Give both descriptors back; the handlers stay."""
        for fd in (self._read_fd, self._write_fd):
            os.close(fd)

    def _ask(self, signum: int, frame: FrameType | None) -> None:
        if not self._wanted:
            self._wanted = True
            os.write(self._write_fd, b".")
