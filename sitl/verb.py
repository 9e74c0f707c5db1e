"""Runs the module of a verb: `python -m sitl.verb sitl.simulate ARGUMENTS...`.

Modules take seconds to import. Ctrl-C ends that without a traceback, and with the exit code of later.
"""

from __future__ import annotations

import importlib
import os
import sys

_EXIT_INTERRUPTED = 130  # that of `swarmctl.errors`, which is not imported yet either


def main() -> None:
    """Import the module named first, and end with the exit code of its `main`."""
    try:
        code = importlib.import_module(sys.argv[1]).main(sys.argv[2:])
    except KeyboardInterrupt:
        os._exit(_EXIT_INTERRUPTED)  # Python would end by the signal where text was being executed, as by dataclasses
    sys.exit(code)


if __name__ == "__main__":
    main()
