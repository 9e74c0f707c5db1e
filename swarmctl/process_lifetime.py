"""Starts child processes, and ends them cleanly: with the launcher that started them (Linux only), or on a signal."""

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


def module_command(module: str, *arguments: str) -> tuple[str, ...]:
    """Return the command that runs a module of ours in another process.

    Python files of the current folder, which may be named as a module that is imported, are no part of it, unless
    this package is itself imported from there.
    """
    safe_path = () if Path(__file__).resolve().parents[1] == Path.cwd() else ("-P",)
    return (sys.executable, *safe_path, "-m", module, *arguments)


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


def serve_parent() -> None:
    """Prepare a worker process: it ignores Ctrl-C, which the parent handles, and dies with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(signal.SIGKILL)


def remove_socket(path: Path) -> None:
    """Delete a Unix socket and its lock, and their directory if it is then empty."""
    for name in (path, path.with_name(path.name + ".lock")):
        name.unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        path.parent.rmdir()


class StopRequest:
    """Counts requests to stop, made by signals or by `ask`; the interrupted thread can wait for one.

    A closing terminal sends SIGHUP more than once, from the kernel and from the shell: SIGHUP is never a second
    request, and is left ignored under `nohup`. SIGINT is handled in the background too, where shells ignore it. As a
    context, it restores the handlers that are still its own.

    It is no `threading.Event`, because a signal handler that runs while its thread holds the event's lock deadlocks.

    Args:
        signums: the signals that ask.
        raise_at: the number of the signal's request that raises KeyboardInterrupt, after which the signals are ignored
            for good; 0 is none.
    """

    def __init__(self, *signums: int, raise_at: int = 0) -> None:
        self._read_fd, self._write_fd = os.pipe()
        os.set_blocking(self._write_fd, False)
        self._raise_at = raise_at
        self.count = 0
        under_nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        heard = [signum for signum in signums if signum != signal.SIGHUP or not under_nohup]
        self._before = {signum: signal.signal(signum, self._note) for signum in heard}

    def __enter__(self) -> StopRequest:
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._before.items():
            if signal.getsignal(signum) == self._note:
                signal.signal(signum, handler)
        self.close()

    def ask(self) -> None:
        """Request a stop, as a signal does."""
        self.count += 1
        if self.count == 1:
            os.write(self._write_fd, b".")

    def is_set(self) -> bool:
        return self.count > 0

    def wait(self, timeout_s: float) -> bool:
        """Wait for at most `timeout_s`; returns whether a stop has been requested."""
        if not self.count:
            select.select([self._read_fd], [], [], max(0.0, timeout_s))
        return self.count > 0

    def close(self) -> None:
        """Close both descriptors; the signal handlers stay installed."""
        for fd in (self._read_fd, self._write_fd):
            os.close(fd)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        if signum == signal.SIGHUP and self.count:
            return
        self.ask()
        if self.count == self._raise_at:
            for each in self._before:  # whoever cleans up after the interrupt is not interrupted again
                signal.signal(each, signal.SIG_IGN)
            raise KeyboardInterrupt
