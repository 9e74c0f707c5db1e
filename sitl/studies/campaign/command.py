"""Seeded Monte Carlo in lockstep: scenario x agents x delay x loss x noise x wind x protections, on true states.

Every combination is a cell, flown with the same seeds. Rows go to `OUT/rows.parquet` as they come in; the same call
again flies only what is missing there. `OUT/report.html` has every cell with exact binomial intervals.

    swarmctl campaign --quick
    swarmctl campaign --scenario swap --agents 6,10 --delay 0,50,100 --loss 0,0.1 --trials 100 --out runs/swap
    swarmctl campaign --scenario random --protections default,off --dask scheduler.local:8786
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.table import Table

from sitl.arguments import count, seed
from sitl.studies.campaign.conditions.disturbances import DISTURBANCES, NONE
from sitl.studies.campaign.conditions.factors import NOISES, PROTECTIONS
from sitl.studies.campaign.conditions.scenarios import AIRFRAMES, SCENARIOS
from sitl.studies.campaign.flight import config_of, drawn
from sitl.studies.campaign.page import share_text, write_page
from sitl.studies.campaign.progress import collect
from sitl.studies.campaign.quick import QUICK
from sitl.studies.campaign.source import code_of, own_digest
from sitl.studies.campaign.store import Store
from sitl.studies.campaign.summary import summaries
from sitl.studies.campaign.trials import Cell, Row, Trial, cells, trial_of, unflown
from sitl.studies.campaign.worker_pool import fly_trial, on_cluster, on_this_machine
from swarmctl.errors import EXIT_MISSION, EXIT_OK, ConfigError, exit_code_of
from swarmctl.process_priority import usable_processors

MAX_AGENTS = 100
_AXES = (  # options that --quick has its own values of
    *("scenario", "agents", "delay", "loss", "noise", "wind", "protections"),
    *("airframe", "disturbance", "sets", "trials", "first_seed"),
)
_OF_OPTIONS = {  # keys that tell cells or trials apart: the rows would tell other values than were flown
    "seed": "--first-seed",
    "swarm.agents": "--agents",
    "bus.delay_ms": "--delay",
    "bus.loss_01": "--loss",
}
_Value = TypeVar("_Value")


def main(arguments: list[str] | None = None) -> int:
    """Fly the requested trials that are missing; return 4 when a trial could not be flown at all."""
    options = _parser().parse_args(arguments)
    return exit_code_of(partial(_run, options), f"interrupted; the same call goes on from {options.out}")


def _run(options: argparse.Namespace) -> int:
    trials = _trials(options)
    began_s = time.monotonic()
    own = own_digest(_own_folder(trials[0]))
    code, fly = code_of(own), partial(fly_trial, own=own)
    with Store(options.out, code, options.mix) as store:
        missing = store.missing(trials)
        print(f"{len(trials)} runs, {len(trials) - len(missing)} of them there already; {options.out}", flush=True)
        jobs = min(options.jobs, max(1, len(missing)))
        flown = on_cluster(missing, options.dask, fly) if options.dask else on_this_machine(missing, jobs, fly)
        noted = "collided", lambda row: bool(row["collided"])
        count, errors = collect(flown, len(missing), store, noted=noted, unflown=partial(unflown, code=code))
    hours = (time.monotonic() - began_s) / 3600.0
    report = write_page(options.out, store.rows, count / hours if count else None)
    asked = set(trials)
    _print_table([row for row in store.rows if trial_of(row) in asked])
    print(f"{count} runs in {hours * 60:.1f} min, {count / hours if count else 0.0:.0f} an hour; {report}")
    for error in errors:
        print(error, file=sys.stderr)
    return EXIT_MISSION if errors else EXIT_OK


def _trials(options: argparse.Namespace) -> list[Trial]:
    """Return the requested trials.

    Raises:
        ConfigError: with every cell that can't be flown, and why.
    """
    if options.quick:
        usual = _parser()
        given = [name for name in _AXES if getattr(options, name) != usual.get_default(name)]
        if given:
            raise ConfigError("--quick", [f"{name}: leave it out, what is flown is fixed" for name in given])
        return list(QUICK)
    if spaced := [item for item in options.sets if item.split() != [item]]:
        raise ConfigError("--set", [f"{item!r}: write it without spaces" for item in spaced])
    if asked := [key for key in (item.partition("=")[0] for item in options.sets) if key in _OF_OPTIONS]:
        raise ConfigError("--set", [f"{key} is told by {_OF_OPTIONS[key]}; give it there" for key in asked])
    found: list[Cell] = []
    for name in options.scenario:
        agents = options.agents or SCENARIOS[name].agents
        found += cells(
            [name],
            agents,
            options.delay,
            options.loss,
            noises=options.noise,
            winds_m_s=options.wind,
            protections=options.protections,
            airframes=options.airframe,
            disturbances=options.disturbance,
            sets=" ".join(options.sets),
        )
    problems: dict[str, None] = {}
    found = list(dict.fromkeys(found))  # a value that is given twice is flown once
    for cell in found:
        problems.update(dict.fromkeys(_problems(cell, options.first_seed)))
    if problems:
        raise ConfigError("campaign", list(problems))
    seeds = range(options.first_seed, options.first_seed + options.trials)
    return [
        Trial(cell, seed) for seed in seeds for cell in found
    ]  # seeds are the outer loop, so that all cells grow together


def _own_folder(trial: Trial) -> str:
    """Return the folder of own modules, which is that of every trial; "" for none."""
    cell, seed = trial.cell, trial.seed
    return config_of(cell, seed, drawn(cell, seed), cell.agents).own_folder


def _problems(cell: Cell, seed: int) -> Iterator[str]:
    least = SCENARIOS[cell.scenario].needs
    if cell.agents < least:
        yield f"--agents {cell.agents}: {cell.scenario} needs at least {least}"
        return
    try:
        config_of(cell, seed, drawn(cell, seed), cell.agents)
    except ConfigError as error:
        yield from error.problems
    except ValueError as error:
        yield f"--scenario {cell.scenario} --agents {cell.agents}: {error}"


def _print_table(rows: list[Row]) -> None:
    table = Table(box=None, pad_edge=False)
    for name in ("cell", "collided", "arrived", "deadlocked", "separation", "time"):
        table.add_column(name)
    for s in summaries(rows):
        c = s.cell
        name = f"{c.scenario} {c.agents}, {c.delay_ms:g} ms, {100 * c.loss:g} %"
        extras = [c.noise if c.noise != "exact" else "", f"wind {c.wind_m_s:g}" if c.wind_m_s else ""]
        extras += [c.airframe if c.airframe != "own" else "", c.disturbance if c.disturbance != NONE else "", c.sets]
        table.add_row(
            ", ".join([name, *filter(None, extras), c.protections]),
            share_text(s.collided),
            share_text(s.arrived),
            str(s.deadlocked.hits),
            "" if s.min_separation_m is None else f"{s.min_separation_m:.2f} m",
            "" if s.time_median_s is None else f"{s.time_median_s:.1f} s",
        )
    Console(width=None if sys.stdout.isatty() else 160, highlight=False).print(table)


def _parser() -> argparse.ArgumentParser:
    scenarios = "\n".join(f"  {name:15}{s.title}; agents {s.agents}" for name, s in SCENARIOS.items())
    disturbances = "\n".join(
        f"  {f'{name}:{d.strength:g}' if d.strength else name:15}{d.title}{f' ({d.unit})' if d.unit else ''}"
        for name, d in DISTURBANCES.items()
    )
    parser = argparse.ArgumentParser(
        prog="swarmctl campaign",
        description=(__doc__ or "").rstrip(),
        epilog=f"scenarios:\n{scenarios}\n\ndisturbances:\n{disturbances}\n\nLists are separated by commas.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--scenario", metavar="NAME,..", type=_names(SCENARIOS), default=["swap"], help="or all")
    add("--agents", metavar="N,..", type=_numbers(int, 1, MAX_AGENTS), help="left out: as listed below")
    add("--delay", metavar="MS,..", type=_numbers(float, 0, 5000), default=[0.0], help="of every message on the bus")
    add("--loss", metavar="P,..", type=_numbers(float, 0, 1), default=[0.0], help="0..1, of unreliable messages")
    add("--noise", metavar="NAME,..", type=_names(NOISES), default=["exact"], help=", ".join(NOISES))
    add(
        "--wind",
        metavar="M/S,..",
        type=_numbers(float, 0, 40),
        default=[0.0],
        help="mean, with turbulence of as much, or of the disturbance",
    )
    add("--protections", metavar="NAME,..", type=_names(PROTECTIONS), default=["default"], help=", ".join(PROTECTIONS))
    add("--airframe", metavar="NAME,..", type=_names(AIRFRAMES), default=["own"], help=", ".join(AIRFRAMES))
    add("--disturbance", metavar="NAME[:STRENGTH],..", type=_disturbances, default=[NONE], help="as listed below")
    add("--set", metavar="KEY=VALUE", dest="sets", action="append", default=[], help="of the configuration, any number")
    add("--trials", metavar="N", type=count, default=20, help="seeds of every cell, default %(default)s")
    add("--first-seed", metavar="K", type=seed, default=1)
    add("--out", metavar="DIR", type=Path, default=Path("runs/campaign"), help="default %(default)s")
    add("--jobs", metavar="N", type=count, default=len(usable_processors()), help="processes, default %(default)s")
    add("--dask", metavar="HOST:PORT", help="fly on the workers of this scheduler instead")
    add("--mix", action="store_true", help="go on in a folder whose rows were flown by other sources")
    add("--quick", action="store_true", help="the subset that is tested with every change; leaves the axes above out")
    return parser


def _disturbances(text: str) -> list[str]:
    parsed = _names(DISTURBANCES)
    for item in text.split(","):
        name, colon, strength = item.partition(":")
        parsed(name)
        if colon:
            _numbers(float, 0, math.inf)(strength)
    return text.split(",")


def _names(known: dict[str, Any]) -> Callable[[str], list[str]]:
    def parse(text: str) -> list[str]:
        asked = list(known) if text == "all" else text.split(",")
        unknown = [name for name in asked if name not in known]
        if unknown:
            raise argparse.ArgumentTypeError(f"{', '.join(unknown)}: allowed: {', '.join(known)}")
        return asked

    return parse


def _numbers(kind: Callable[[str], _Value], low: float, high: float) -> Callable[[str], list[_Value]]:
    def parse(text: str) -> list[_Value]:
        try:
            values = [kind(part) for part in text.split(",")]
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r}: numbers, separated by commas") from error
        if not all(low <= value <= high for value in values):  # type: ignore[operator]
            raise argparse.ArgumentTypeError(f"{text}: allowed: {low:g} to {high:g}")
        return values

    return parse


if __name__ == "__main__":
    sys.exit(main())
