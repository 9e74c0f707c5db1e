"""How an agent that shares its process with others tells the supervisor that it has ended: a line on a pipe."""

from __future__ import annotations

import contextlib
import os
import select

import msgspec

from swarmctl.core.text import printable

_READ_BYTES = 4096


class AgentEnd(msgspec.Struct, frozen=True, kw_only=True):
    """The end of one agent.

    Attributes:
        agent: its number.
        exit_code: what its process would have ended with, were it the only one there.
        words: why it has not completed its mission, "" where it has.
    """

    agent: int
    exit_code: int
    words: str = ""


def write_end(fd: int, end: AgentEnd) -> None:
    """Write one end to a pipe; a supervisor that does not read any more is no error."""
    words = printable(next((line for line in reversed(end.words.splitlines()) if line.strip()), ""))
    line = _line(end, words)
    while len(line) > select.PIPE_BUF:  # more than that could be written in part
        words = words[: len(words) // 2]
        line = _line(end, words)
    with contextlib.suppress(OSError):
        os.write(fd, line)


def _line(end: AgentEnd, words: str) -> bytes:
    return msgspec.json.encode(msgspec.structs.replace(end, words=words)) + b"\n"


class EndReader:
    """Reads the ends that come through a pipe, without waiting.

    Args:
        fd: the end of the pipe to read; it is closed when nobody can write any more.
    """

    def __init__(self, fd: int) -> None:
        os.set_blocking(fd, False)
        self._fd: int | None = fd
        self._begun = b""  # of a line whose rest is not there yet
        self._ends: dict[int, AgentEnd] = {}

    def end_of(self, agent: int) -> AgentEnd | None:
        """Return how an agent has ended, None while it has not said so."""
        while self._fd is not None and self._read(self._fd):
            pass
        return self._ends.get(agent)

    def _read(self, fd: int) -> bool:
        """Read some bytes; return whether there were any."""
        try:
            data = os.read(fd, _READ_BYTES)
        except BlockingIOError:
            return False
        if not data:
            os.close(fd)
            self._fd = None
        *lines, self._begun = (self._begun + data).split(b"\n")
        for end in (msgspec.json.decode(line, type=AgentEnd) for line in lines):
            self._ends[end.agent] = end
        return bool(data)
