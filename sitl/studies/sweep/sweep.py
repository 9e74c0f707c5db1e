"""The `sweep` verb: flies what is missing in a folder, and shows the combinations as a table and a page."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from sitl.studies.campaign.progress import collect
from sitl.studies.campaign.source import code_of, own_digest
from sitl.studies.campaign.store import RowStore, writing
from sitl.studies.campaign.trials import row_of_error
from sitl.studies.campaign.worker_pool import on_this_machine
from sitl.studies.sweep.figures import FIGURES, SHOWN, Combination, Row, combinations, schema_of
from sitl.studies.sweep.flight import FlySweep
from sitl.studies.sweep.page import cell_text, write_page
from sitl.studies.sweep.points import Axis, Flight, flights_of, parse_axes, problems_of
from swarmctl.config import Config, dump, load
from swarmctl.core.text import told_apart
from swarmctl.errors import EXIT_MISSION, EXIT_OK, ConfigError
from swarmctl.files import replace_text
from swarmctl.own_modules import OWN_FOLDER, OWN_KINDS
from swarmctl.telemetry.recording.file_names import STUDY_ROWS

BASE = "config.toml"  # in the folder: the configuration to which swept values are applied
_SHOWN_CHANGES = 5
_MOST_TEXT = 120  # characters of a value of the configuration
_Key = tuple[tuple[float | str, ...], int]  # stored values of the axes, and the seed


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepOptions:
    """Options of the verb."""

    config: Path | None
    sets: tuple[str, ...]
    seeds: int
    jobs: int
    out: Path
    fixed: tuple[str, ...] = ()  # `key=value` of every flight
    first_seed: int | None = None  # None: that of the configuration


def sweep(options: SweepOptions) -> int:
    """Fly the combinations that are missing; return 4 when one has failed or could not be flown.

    Raises:
        ConfigError: a combination is impossible, or the folder holds another sweep.
        StartError: a process ended by itself, or the folder can't be written.
    """
    axes = parse_axes(options.sets, options.fixed)
    base = load(options.config, options.fixed)
    if not base.own_folder and _names_own(axes):  # flights load a copy of it, which is elsewhere
        base = load(options.config, [*options.fixed, f"{OWN_FOLDER}=."])
    flights = flights_of(axes, base.seed if options.first_seed is None else options.first_seed, options.seeds)
    if problems := list(problems_of(flights, options.config, options.fixed)):
        raise ConfigError("sweep", problems)
    with writing(options.out):
        options.out.mkdir(parents=True, exist_ok=True)
        _claim(options.out, base)
    began_s, keyed = time.monotonic(), {_key(axes, flight): flight for flight in flights}
    code = code_of(own_digest(base.own_folder))
    with RowStore(options.out, code, schema=schema_of(axes), job_of=partial(_key_of_row, axes)) as store:
        todo = [keyed[key] for key in store.missing(keyed)]
        print(f"{len(flights)} flights, {len(flights) - len(todo)} of them there already; {options.out}", flush=True)
        jobs = min(options.jobs, max(1, len(todo)))
        flown = on_this_machine(todo, jobs, FlySweep(options.out / BASE, tuple(axes), code))
        noted = "failed", lambda row: row["outcome"] != "completed"
        count, errors = collect(flown, len(todo), store, noted=noted, unflown=partial(_unflown, axes, code=code))
    rows = [row for row in store.rows if _key_of_row(axes, row) in keyed]
    found = combinations(axes, rows)
    report = write_page(options.out, axes, found, code, config_text=dump(base))
    _print_table(axes, found)
    print(f"{count} flown in {time.monotonic() - began_s:.0f} s; {options.out / STUDY_ROWS}, {report}")
    for error in errors:
        print(error, file=sys.stderr)
    failed = errors or any(row["outcome"] != "completed" for row in rows)
    return EXIT_MISSION if failed else EXIT_OK


def _names_own(axes: Sequence[Axis]) -> bool:
    """Return whether a swept value is an own controller or mission."""
    return any(axis.key in OWN_KINDS and ":" in value for axis in axes for value in axis.values)


def _key(axes: Sequence[Axis], flight: Flight) -> _Key:
    """Return by what a flight is told from others."""
    values = (axis.stored(value) for axis, (_, value) in zip(axes, flight.settings, strict=True))
    return tuple(values), flight.seed


def _unflown(axes: Sequence[Axis], flight: Flight, error: str, code: str) -> Row:
    """Return the row of a flight that an error ended."""
    values, seed = _key(axes, flight)
    swept = {axis.key: value for axis, value in zip(axes, values, strict=True)}
    return row_of_error(swept | {"seed": seed}, schema_of(axes).names, error, code)


def _key_of_row(axes: Sequence[Axis], row: Row) -> _Key:
    return tuple(row[axis.key] for axis in axes), row["seed"]


def _claim(directory: Path, base: Config) -> None:
    """Write the configuration of a new sweep, or check that it is the one whose rows are there.

    Raises:
        ConfigError: the folder holds a sweep of another configuration; says which keys differ.
    """
    path = directory / BASE
    if not path.exists():
        replace_text(path, dump(base))
        return
    before, now = (dict(_leaves(config.model_dump(), "")) for config in (load(path), base))
    changed = [key for key in sorted({*before, *now}) if before.get(key) != now.get(key)]
    if changed:
        values = {key: told_apart([str(before.get(key)), str(now.get(key))], _MOST_TEXT) for key in changed}
        shown = ", ".join(
            f"{key} was {was} and is {is_now}" for key, (was, is_now) in [*values.items()][:_SHOWN_CHANGES]
        )
        more = f", and {len(changed) - _SHOWN_CHANGES} more" if len(changed) > _SHOWN_CHANGES else ""
        raise ConfigError(str(path), [f"of another configuration: {shown}{more}. Give a new --out"])


def _leaves(tree: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Yield every value of a tree by its dotted key."""
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from _leaves(value, f"{key}.{name}" if key else name)
    else:
        yield key, tree


def _print_table(axes: Sequence[Axis], found: Sequence[Combination]) -> None:
    table = Table(box=None, pad_edge=False)
    for axis in axes:
        table.add_column(axis.key.rpartition(".")[2])
    for name in ("completed", *SHOWN):
        table.add_column(name, justify="right")
    for one in found:
        figures = [cell_text(one.figures[name]) for name in SHOWN]
        table.add_row(*map(cell_text, one.values), f"{one.completed}/{one.flights}", *figures)
    Console(width=None if sys.stdout.isatty() else 160, highlight=False).print(table)
    for figure in FIGURES:
        if figure.name in SHOWN:
            print(f"  {figure.legend}")
