"""The command line of the `bench` verb. What measures is imported after it is read, so that `--help` is quick.

`python -m sitl.studies.bench.command [--scale] [--out DIR] [--neighbours 0,1,2] [--agents 3,6] [--hosts 1,2]
[--solver osqp] [--ticks N] [--no-slsqp]`
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from swarmctl.errors import exit_code_of

NEIGHBOURS = (0, 1, 2, 4, 8, 16, 30)
MAX_NEIGHBOURS = 99
AGENTS = (3, 6, 12, 24)
MAX_AGENTS = 100
HOSTS = (1, 2, 3, 4, 6)
MAX_HOSTS = 12
SOLVERS = ("osqp", "daqp")  # those of `control.mpc.solvers.qp`, which takes a second to import
_WHAT = """The `bench` verb: measures the duration of an agent's tick, split into parts, for growing swarms and each
QP solver; with --scale, how costs grow with neighbours, agents and hosts, with fitted exponents and a plot."""


def main(arguments: list[str] | None = None) -> int:
    """Run the verb and return the process exit code."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if problem := _problem(options):
        parser.error(problem)
    options.agents, options.hosts = options.agents or list(AGENTS), options.hosts or list(HOSTS)
    from sitl.studies.bench.bench import run

    return exit_code_of(partial(run, options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swarmctl bench", description=_WHAT)
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path(), help="folder to write to; default: here")
    parser.add_argument("--neighbours", metavar="K,K", type=_counts, default=list(NEIGHBOURS), help="counts, 0 to 99")
    parser.add_argument("--scale", action="store_true", help="how costs grow, with one solver: scale.json, scale.html")
    parser.add_argument("--agents", metavar="N,N", type=_agents, help="counts of --scale, 2 to 100")
    parser.add_argument("--hosts", metavar="H,H", type=_hosts, help="counts of --scale, 1 to 12")
    parser.add_argument("--solver", action="append", choices=SOLVERS, help="repeatable; default: all installed")
    parser.add_argument("--ticks", metavar="N", type=_ticks, default=300, help="measured: ticks, and x-y problems")
    parser.add_argument("--slsqp", action=argparse.BooleanOptionalAction, help="the nonlinear baseline; default: yes")
    return parser


def _problem(options: argparse.Namespace) -> str:
    """Return which options don't go together, or ""."""
    if not options.scale:
        return "--agents and --hosts need --scale" if options.agents or options.hosts else ""
    if options.slsqp is not None or len(options.solver or ()) > 1:
        return "--scale measures one solver, and not SLSQP"
    return ""


def _counts(text: str) -> list[int]:
    return _numbers(text, 0, MAX_NEIGHBOURS)


def _agents(text: str) -> list[int]:
    return _numbers(text, 2, MAX_AGENTS)


def _hosts(text: str) -> list[int]:
    return _numbers(text, 1, MAX_HOSTS)


def _numbers(text: str, least: int, most: int) -> list[int]:
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        counts = [-1]
    if not all(least <= count <= most for count in counts):
        raise argparse.ArgumentTypeError(f"{text!r}: give numbers from {least} to {most}, such as {least},8")
    return sorted(set(counts))


def _ticks(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 100_000:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: 1 to 100000")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
