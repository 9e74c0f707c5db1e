"""The `bench` verb: measures the duration of an agent's tick, split into parts, for growing swarms and each QP solver.

Its options are in `command`.

One real agent among neighbours that are paths on the bus (see `formation`), no process, no socket: what is measured is
the work of a tick (see `ticks`), and x-y problems alone on the processor (see `captured`). Garbage collection is on, as
in flight. Writes `bench.json`, a list of rows of five keys. `--scale` asks how costs grow instead (see `scale`).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress
from rich.table import Column, Table

from sitl.studies.bench import scale
from sitl.studies.bench.captured import (
    MOST_PROBLEMS,
    WARM_UP,
    Times,
    XyTimes,
    capture,
    circle_with_obstacle,
    measure_xy,
    times_of,
)
from sitl.studies.bench.output import json_rows, make_folder, write_texts
from sitl.studies.bench.ticks import PARTS, SWAPS, measure_swaps, measure_ticks
from swarmctl.control.mpc.solvers.qp import SOLVERS, installed_solvers
from swarmctl.core.types import Array
from swarmctl.errors import EXIT_OK

_BESIDE_PILLAR = 2  # neighbours in the scenario with an obstacle
_OBSTACLE = ", 1 obstacle"
_SWAP_NEIGHBOURS = 9
_PART_WIDTH, _CASE_WIDTH = 16, 21  # of columns in the terminal, with the room between them
_BUSY_LOAD = 0.7  # one-minute load average


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchRow:
    """One line of `bench.json`."""

    name: str
    solver: str
    neighbours: int
    p50_ms: float
    p99_ms: float


def tick_rows(timings: dict[str, Array], neighbours: int, suffix: str = "") -> list[BenchRow]:
    """Return the rows of one scenario."""
    rows = []
    for solver, parts in timings.items():
        for name, column in zip(PARTS, parts.T, strict=True):
            rows.append(_row(name + suffix, solver, neighbours, times_of(column)))
    return rows


def xy_rows(times: XyTimes) -> list[BenchRow]:
    """Return the rows of the x-y problem alone: the QP, and the thesis' problem with true distances."""
    rows = [_row("solve x-y" + _OBSTACLE, solver, 2, times.qp(solver)) for solver in times.qp_ms]
    if times.fmincon is not None and times.gradients is not None:
        rows.append(_row("solve x-y, nonlinear" + _OBSTACLE, "slsqp", 2, times.fmincon.times))
        rows.append(_row("solve x-y, nonlinear, gradients" + _OBSTACLE, "slsqp", 2, times.gradients.times))
    return rows


def _row(name: str, solver: str, neighbours: int, times: Times) -> BenchRow:
    return BenchRow(
        name=name, solver=solver, neighbours=neighbours, p50_ms=round(times.p50_ms, 4), p99_ms=round(times.p99_ms, 4)
    )


def bench(
    neighbours: Sequence[int], solvers: Sequence[str], ticks: int, slsqp: bool, *, console: Console
) -> list[BenchRow]:
    """Run all measurements; shows progress on a terminal."""
    rows: list[BenchRow] = []
    swapping = min(_SWAP_NEIGHBOURS, max(1, *neighbours, 0))
    with Progress(transient=True, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("ticks", total=ticks * (len(neighbours) + 2))

        def on_tick() -> None:
            bar.advance(task)

        for count in neighbours:
            bar.update(task, description=f"{count} neighbours")
            rows += tick_rows(measure_ticks(count, solvers, ticks, on_tick=on_tick), count)
        bar.update(task, description=f"{swapping} neighbours, with and without commitments")
        for mode, timings in measure_swaps(swapping, solvers, ticks, on_tick).items():
            rows += tick_rows(timings, swapping, f", {mode}")
        bar.update(task, description=f"{_BESIDE_PILLAR} neighbours, 1 obstacle")
        beside = measure_ticks(_BESIDE_PILLAR, solvers, ticks, pillar=True, on_tick=on_tick)
        rows += tick_rows(beside, _BESIDE_PILLAR, _OBSTACLE)
        bar.update(task, description="x-y problems of a flight")
        captured = capture(circle_with_obstacle(), most=min(MOST_PROBLEMS, WARM_UP + ticks))
        problem_task = bar.add_task("x-y problems", total=len(captured.problems))
        rows += xy_rows(measure_xy(captured, solvers, slsqp, lambda: bar.advance(problem_task)))
    return rows


def busy_note(load: float, processors: int) -> str:
    """Return a note on a busy machine, from the load before the measurement; "" when it is quiet."""
    if load < _BUSY_LOAD:
        return ""
    return f"load {load:.1f} on {processors} processors before the start: p99 of ticks includes other processes' work"


def chosen_solvers(asked: Sequence[str]) -> tuple[list[str], str]:
    """Return the solvers to measure, and a note on those that are left out because they are not installed."""
    if asked:
        return list(dict.fromkeys(asked)), ""
    installed = installed_solvers()
    missing = [name for name in SOLVERS if name not in installed]
    notes = [f"{name} is left out: it is not installed; pip install '{name}'" for name in missing]
    return list(installed), "; ".join(notes)


def show(rows: Sequence[BenchRow], console: Console) -> None:
    """Print the rows as tables that fit the console, and the ratios."""
    cases = {
        f"{solver}, {count} neighbours{suffix}": _cells(rows, count, solver, suffix)
        for suffix in ("", *(f", {mode}" for mode in SWAPS), _OBSTACLE)
        for count, solver in dict.fromkeys((r.neighbours, r.solver) for r in rows if r.name == "tick" + suffix)
    }
    names, each = list(cases), max(1, (console.width - _PART_WIDTH) // _CASE_WIDTH)
    console.print("one tick: p50 (p99) [ms]", markup=False)
    for shown in (names[first : first + each] for first in range(0, len(names), each)):
        table = Table("", *(Column(name, min_width=_CASE_WIDTH - 3, justify="right") for name in shown), box=SIMPLE)
        for part, *cells in zip(PARTS, *(cases[name] for name in shown), strict=True):
            table.add_row(part, *cells)
        console.print(table)
    alone = [r for r in rows if r.name.startswith("solve x-y")]
    console.print("x-y problems of a flight, 2 neighbours + 1 obstacle [ms]", markup=False)
    table = Table("problem", "solver", "p50", "p99", box=SIMPLE)
    for r in alone:
        table.add_row(r.name.removesuffix(_OBSTACLE), r.solver, f"{r.p50_ms:.3f}", f"{r.p99_ms:.3f}")
    console.print(table)
    for nonlinear in (r for r in alone if r.solver == "slsqp"):
        for r in (r for r in alone if r.solver != "slsqp"):
            name = nonlinear.name.removesuffix(_OBSTACLE)
            console.print(
                f"{r.solver}: {nonlinear.p50_ms / r.p50_ms:.0f} times as fast as slsqp, {name} (p50 of all problems)"
            )


def _cells(rows: Sequence[BenchRow], count: int, solver: str, suffix: str) -> list[str]:
    """Return what each part of a tick takes with so many neighbours."""
    found = {r.name: r for r in rows if (r.neighbours, r.solver) == (count, solver)}
    return [f"{r.p50_ms:.2f} ({r.p99_ms:.2f})" for r in (found[name + suffix] for name in PARTS)]


def write(rows: Sequence[BenchRow], directory: Path) -> Path:
    """Write `bench.json` to `directory`, which is made if necessary, and return its path."""
    (path,) = write_texts({"bench.json": json_rows(rows)}, directory)
    return path


def run(options: argparse.Namespace) -> int:
    """Measure what the command line asks for, show and write it; return the exit code.

    Raises:
        StartError: the folder can't be written to; nothing is measured then.
    """
    make_folder(options.out)
    console = Console()
    note = busy_note(os.getloadavg()[0], os.cpu_count() or 1)
    solvers, left_out = chosen_solvers(options.solver or ())
    if left_out and not options.scale:
        console.print(left_out, markup=False)
    if options.scale:
        written = _run_scale(options, solvers[0], console)
    else:
        rows = bench(options.neighbours, solvers, options.ticks, options.slsqp is not False, console=console)
        show(rows, console)
        written = [write(rows, options.out)]
    if note:
        console.print(note)
    console.print("\n".join(map(str, written)), markup=False, soft_wrap=True)
    return EXIT_OK


def _run_scale(options: argparse.Namespace, solver: str, console: Console) -> list[Path]:
    """Measure how costs grow; return what was written."""
    with Progress(transient=True, console=console, disable=not console.is_terminal) as bar:
        counts = len(options.neighbours) + scale.SWARMS * len(options.agents) + len(options.hosts)
        task = bar.add_task(f"counts, {solver}", total=counts)
        rows = scale.neighbour_rows(options.neighbours, solver, options.ticks, partial(bar.advance, task))
        rows += scale.agent_rows(options.agents, solver, options.ticks, partial(bar.advance, task))
        rows += scale.host_rows(options.hosts, solver, partial(bar.advance, task))
    scale.show(rows, console)
    return scale.write(rows, options.out)
