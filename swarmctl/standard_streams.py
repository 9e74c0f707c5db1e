"""Makes standard output and error take whatever is printed, however the program was started."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_NAMES = ("stdin", "stdout", "stderr")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # no room for a file; else the reader has closed its end
_lost: dict[int, OSError] = {}  # first error of each stream that takes nothing any more


class _Output(io.RawIOBase):
    """A stream that is printed to: once it takes no more, what is printed is dropped, and the program goes on."""

    def __init__(self, number: int) -> None:
        self._number = number

    def fileno(self) -> int:
        return self._number

    def isatty(self) -> bool:
        return os.isatty(self._number)

    def writable(self) -> bool:
        return True

    def write(self, data: ReadableBuffer, /) -> int:
        """Write all of `data`, or drop what is left of it; returns its length."""
        view = memoryview(data).cast("B")
        written = 0
        while self._number not in _lost and written < len(view):
            try:
                written += os.write(self._number, view[written:])
            except BlockingIOError:  # set so by another program that has the same terminal or pipe
                select.select((), (self._number,), ())
            except OSError as error:
                _lost[self._number] = error
        return len(view)


def prepare_standard_streams() -> None:
    """Open streams that were closed, as by `>&-`, on nothing; print as escapes what the terminal's encoding lacks.

    Otherwise the next file or socket would take the number of a closed stream, and with it what is printed. A reader
    that closes the pipe, as `head` does, or a full disk ends no verb: what is printed to them is dropped.
    """
    for number, name in enumerate(_NAMES):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))
    for number, name in enumerate(_NAMES[1:], 1):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
            if isinstance(getattr(stream.buffer, "raw", stream.buffer), io.FileIO) and stream.fileno() == number:
                setattr(sys, name, _forgiving(stream, number))


def _forgiving(stream: io.TextIOWrapper, number: int) -> io.TextIOWrapper:
    """Return a stream like `stream`, which is empty, that raises nothing where it can't be written to."""
    stream.flush()
    raw = _Output(number)
    buffer = raw if stream.write_through else io.BufferedWriter(raw)
    return io.TextIOWrapper(
        buffer,  # type: ignore[arg-type]  # raw without a buffer, as of `python -u`
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def output_is_lost() -> bool:
    """Return whether nobody reads what is printed any more."""
    return 1 in _lost


def finish_output() -> str:
    """Print what is left; return why not all could be, in words, "" if all was, or the reader has closed the pipe."""
    sys.stdout.flush()
    error = _lost.get(1)
    return "" if error is None or error.errno not in _FULL else f"standard output can't be written: {error.strerror}"
