"""The `bench` verb: measures the duration of an agent's tick, split into parts, for growing swarms and each QP solver.

Its options are in `command`.

One real agent among neighbours that are paths on the bus (see `formation`), no process, no socket: what is measured is
the work of a tick. Solvers take turns tick by tick, so that their ratios are fair on a busy machine. Ticks are timed by
the wall clock, as in flight, x-y problems alone on the processor (see `captured`). Garbage collection is on, as in
flight. Writes `bench.json`, a list of rows of five keys.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress
from rich.table import Column, Table

from sitl.lockstep import Lockstep
from sitl.studies.bench.captured import (
    MOST_PROBLEMS,
    WARM_UP,
    Times,
    XyTimes,
    capture,
    circle_with_obstacle,
    measure_xy,
    settled_garbage,
    times_of,
)
from sitl.studies.bench.formation import Formation, formation_config
from sitl.studies.campaign.flight import config_of
from sitl.studies.campaign.scenarios import layout_of
from sitl.studies.campaign.trials import Cell
from swarmctl.config import Config
from swarmctl.control.mpc.solvers.qp import SOLVERS, installed_solvers
from swarmctl.core.tick_record import TickTiming
from swarmctl.core.types import Array, Phase
from swarmctl.errors import EXIT_OK, ConfigError, MissionError
from swarmctl.files import replace_text

PARTS = ("sense", "setup", "commitment", "spaces", "solve", "certify", "barrier", "send", "tick")
_BESIDE_PILLAR = 2  # neighbours in the scenario with an obstacle
_WARM_UP_S = 5.0  # mission time for catching up with the circle
_READY_WITHIN_TICKS = 1500
_OBSTACLE = ", 1 obstacle"
_GUARANTEED = ", guaranteed"
_GUARANTEED_NEIGHBOURS = 9  # neighbours in the scenario with commitments
_PART_WIDTH, _CASE_WIDTH = 16, 21  # of columns in the terminal, with the room between them
_ENDLESS_S = 3600.0
_BUSY_LOAD = 0.7  # one-minute load average


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchRow:
    """One line of `bench.json`."""

    name: str
    solver: str
    neighbours: int
    p50_ms: float
    p99_ms: float


def measure_ticks(
    neighbours: int,
    solvers: Sequence[str],
    ticks: int,
    pillar: bool = False,
    *,
    on_tick: Callable[[], None] = lambda: None,
) -> dict[str, Array]:
    """Return the parts of `ticks` ticks, (ticks, 9) [ms] in the order of `PARTS`, by solver.

    Raises:
        MissionError: an agent did not reach the mission, or had no plan at a counted tick, which would be no valid
        figure.
    """
    formations = {solver: Formation(formation_config(solver, neighbours, pillar)) for solver in solvers}
    for solver, formation in formations.items():
        _get_under_way(solver, formation.step, partial(_is_warm, formation))
    timings: dict[str, list[tuple[float, ...]]] = {solver: [] for solver in solvers}
    with settled_garbage():
        for _ in range(ticks):
            for solver, formation in formations.items():
                formation.step()
                if not formation.planned:
                    raise MissionError(f"bench: {solver} with {neighbours} neighbours: a tick without a plan")
                timings[solver].append(_parts(formation.timing))
            on_tick()
    return {solver: np.array(rows) for solver, rows in timings.items()}


def measure_commitments(
    neighbours: int, solvers: Sequence[str], ticks: int, on_tick: Callable[[], None] = lambda: None
) -> dict[str, Array]:
    """Measure `neighbours + 1` agents in a swap with guaranteed commitments; (ticks, 9) [ms] over all agents.

    The neighbours of `measure_ticks` are paths only and can't commit, so every neighbour is a whole agent here.
    """
    crowds = {solver: Lockstep(_swap_config(solver, neighbours + 1)) for solver in solvers}
    timings: dict[str, list[tuple[float, ...]]] = {solver: [] for solver in solvers}
    for solver, crowd in crowds.items():
        _get_under_way(solver, crowd.step, partial(_tracks, crowd))
    with settled_garbage():
        for _ in range(0, ticks, neighbours + 1):
            for solver, crowd in crowds.items():
                crowd.step()
                timings[solver] += [_parts(agent.timing) for agent in crowd.agents if agent is not None]
            for _ in range(neighbours + 1):
                on_tick()
    return {solver: np.array(rows[:ticks]) for solver, rows in timings.items()}


def _swap_config(solver: str, agents: int) -> Config:
    cell = Cell(
        scenario="symmetric",
        agents=agents,
        delay_ms=0.0,
        loss=0.0,
        noise="exact",
        wind_m_s=0.0,
        protections="guaranteed",
    )
    extra = (f"controller.mpc.qp.solver='{solver}'", f"mission.duration_s={_ENDLESS_S}")
    return config_of(cell, 1, layout_of(cell.scenario, 1, agents), agents, extra=extra)


def _tracks(crowd: Lockstep) -> bool:
    return int(crowd.logs[0].rows[-1]["phase"][0]) == Phase.TRACK


def _is_warm(formation: Formation) -> bool:
    return formation.mission_t_s >= _WARM_UP_S


def _get_under_way(solver: str, step: Callable[[], None], ready: Callable[[], bool]) -> None:
    for _ in range(_READY_WITHIN_TICKS):
        step()
        if ready():
            return
    raise MissionError(f"bench: the agent with {solver} did not begin within {_READY_WITHIN_TICKS} ticks")


def _parts(timing: TickTiming) -> tuple[float, ...]:
    return (*astuple(timing), timing.tick_ms)


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
    guaranteed = min(_GUARANTEED_NEIGHBOURS, max(1, *neighbours, 0))
    with Progress(transient=True, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("ticks", total=ticks * (len(neighbours) + 2))

        def on_tick() -> None:
            bar.advance(task)

        for count in neighbours:
            bar.update(task, description=f"{count} neighbours")
            rows += tick_rows(measure_ticks(count, solvers, ticks, on_tick=on_tick), count)
        bar.update(task, description=f"{guaranteed} neighbours{_GUARANTEED}")
        rows += tick_rows(measure_commitments(guaranteed, solvers, ticks, on_tick), guaranteed, _GUARANTEED)
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
    notes = [f"{name} is left out: it is not installed; in the checkout, pip install '.[{name}]'" for name in missing]
    return list(installed), "; ".join(notes)


def show(rows: Sequence[BenchRow], console: Console) -> None:
    """Print the rows as tables that fit the console, and the ratios."""
    cases = {
        f"{solver}, {count} neighbours{suffix}": _cells(rows, count, solver, suffix)
        for suffix in ("", _GUARANTEED, _OBSTACLE)
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
    try:
        directory.mkdir(parents=True, exist_ok=True)
        path = directory / "bench.json"
        replace_text(path, json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    except OSError as error:
        raise ConfigError("--out", [f"{directory}: can't be written: {error.strerror}"]) from error
    return path


def run(options: argparse.Namespace) -> int:
    """Measure what the command line asks for, show and write it; return the exit code."""
    console = Console()
    note = busy_note(os.getloadavg()[0], os.cpu_count() or 1)
    solvers, left_out = chosen_solvers(options.solver or ())
    if left_out:
        console.print(left_out, markup=False)
    rows = bench(options.neighbours, solvers, options.ticks, options.slsqp, console=console)
    show(rows, console)
    if note:
        console.print(note)
    console.print(str(write(rows, options.out)))
    return EXIT_OK
