"""Makes standard output and error take whatever is printed, however the program was started."""

from __future__ import annotations

import io
import os
import sys

_NAMES = ("stdin", "stdout", "stderr")


def prepare_standard_streams() -> None:
    """Open streams that were closed, as by `>&-`, on nothing; print as escapes what the terminal's encoding lacks.

    Otherwise the next file or socket would take the number of a closed stream, and with it what is printed.
    """
    for number, name in enumerate(_NAMES):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
