"""The command line of the `bench` verb. What measures is imported after it is read, so that `--help` is quick.

`python -m sitl.studies.bench.command [--out DIR] [--neighbours 0,1,2] [--solver osqp] [--ticks N] [--no-slsqp]`
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from swarmctl.errors import exit_code_of

NEIGHBOURS = (0, 1, 2, 4, 8, 16, 30)
MAX_NEIGHBOURS = 99
SOLVERS = ("osqp", "daqp")  # those of `control.mpc.qp`, which takes a second to import
_WHAT = """The `bench` verb: measures the duration of an agent's tick, split into parts, for growing swarms and each
QP solver."""


def main(arguments: list[str] | None = None) -> int:
    """Run the verb and return the process exit code."""
    options = _parser().parse_args(arguments)
    from sitl.studies.bench.bench import run

    return exit_code_of(partial(run, options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swarmctl bench", description=_WHAT)
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path(), help="folder of bench.json; default: here")
    parser.add_argument("--neighbours", metavar="K,K", type=_counts, default=list(NEIGHBOURS), help="counts, 0 to 99")
    parser.add_argument("--solver", action="append", choices=SOLVERS, help="repeatable; default: all installed")
    parser.add_argument("--ticks", metavar="N", type=_ticks, default=300, help="measured: ticks, and x-y problems")
    parser.add_argument("--slsqp", action=argparse.BooleanOptionalAction, default=True, help="the nonlinear baseline")
    return parser


def _counts(text: str) -> list[int]:
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        counts = [-1]
    if not all(0 <= count <= MAX_NEIGHBOURS for count in counts):
        raise argparse.ArgumentTypeError(f"{text!r}: give numbers from 0 to {MAX_NEIGHBOURS}, such as 0,2,8")
    return list(dict.fromkeys(counts))


def _ticks(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 100_000:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: 1 to 100000")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
