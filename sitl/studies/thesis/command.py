"""The command line of the `reproduce` verb. What flies is imported after it is read, so that `--help` is quick.

`python -m sitl.studies.thesis.command [--only FLIGHT]... [--plant] [--full] [--out DIR] [--jobs N]`
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from swarmctl.errors import exit_code_of
from swarmctl.process_priority import usable_processors

_WHAT = (
    "The `reproduce` verb: flies the six experiments of the thesis and writes the results beside the published ones."
)


def main(arguments: list[str] | None = None) -> int:
    """Run the verb and return the process exit code."""
    options = _parser().parse_args(arguments)
    from sitl.studies.thesis.reproduce import run

    return exit_code_of(partial(run, options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swarmctl reproduce", description=_WHAT)
    add = parser.add_argument
    which = "one experiment, such as pid_fast; repeatable; an unknown one lists all"
    add("--only", action="append", default=[], metavar="FLIGHT", help=which)
    add("--plant", action="store_true", help="fly the model only, as the thesis did")
    add("--full", action="store_true", help="fly the full MAVLink loop only")
    add("--out", type=Path, metavar="DIR", help="folder to write; default runs/<UTC>-reproduce")
    processes = min(8, len(usable_processors()))
    add("--jobs", type=int, metavar="N", default=processes, help="processes; default: one per processor, at most 8")
    return parser


if __name__ == "__main__":
    sys.exit(main())
