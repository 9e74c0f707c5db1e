"""The command line of the `sweep` verb. What flies is imported after it is read, so that `--help` is quick.

`python -m sitl.studies.sweep.command [CONFIG] --set KEY=V,V [--set KEY=V,V] [--duration S] [--seeds N] [--seed K]
[--jobs N] [--out DIR]`
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from sitl.arguments import count, seed
from swarmctl.errors import exit_code_of
from swarmctl.process_priority import usable_processors

_WHAT = """Fly every combination of values in lockstep, faster than real time, on all processors. The same call again
goes on where it stopped. Rows go to OUT/rows.parquet as they come in; OUT/report.html has the table and charts."""
_SET_HELP = "values of a key, separated by commas outside of brackets; repeatable"


def main(arguments: list[str] | None = None) -> int:
    """Run the verb and return the process exit code: 4 when a flight has failed or could not be flown."""
    options = _parser().parse_args(arguments)
    from sitl.studies.sweep.sweep import SweepOptions, sweep

    asked = SweepOptions(
        config=options.config,
        sets=tuple(options.sets),
        seeds=options.seeds,
        jobs=options.jobs,
        out=options.out,
        fixed=() if options.duration is None else (f"mission.duration_s={options.duration}",),
        first_seed=options.seed,
    )
    return exit_code_of(partial(sweep, asked), f"interrupted; the same call goes on from {options.out}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swarmctl sweep", description=_WHAT)
    add = parser.add_argument
    add("config", nargs="?", type=Path, metavar="CONFIG", help="TOML file; default: the circle of the thesis")
    add("--set", metavar="KEY=V,V", dest="sets", action="append", default=[], help=_SET_HELP)
    add("--duration", metavar="S", help="duration of every mission [s]; default: that of the configuration")
    add("--seeds", metavar="N", type=count, default=1, help="seeds of every combination; default %(default)s")
    add("--seed", metavar="K", type=seed, help="the first of them; default: that of the configuration")
    add("--jobs", metavar="N", type=count, default=len(usable_processors()), help="processes; default %(default)s")
    add("--out", metavar="DIR", type=Path, default=Path("runs/sweep"), help="folder; default %(default)s")
    return parser


if __name__ == "__main__":
    sys.exit(main())
