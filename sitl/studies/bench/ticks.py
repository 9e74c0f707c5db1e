"""Durations of ticks: of one agent among neighbours that are paths on the bus, and of agents that swap places.

Solvers take turns tick by tick, so that their ratios are fair on a busy machine. Ticks are timed by the wall clock, as
in flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial

import numpy as np

from sitl.lockstep import Lockstep
from sitl.studies.bench.captured import settled_garbage
from sitl.studies.bench.formation import Formation, formation_config
from sitl.studies.campaign.conditions.scenarios import layout_of
from sitl.studies.campaign.flight import config_of
from sitl.studies.campaign.trials import Cell
from swarmctl.config import Config
from swarmctl.core.recorded.tick_record import TickTiming
from swarmctl.core.types import Array, Phase
from swarmctl.errors import MissionError

PARTS = ("sense", "setup", "commitment", "spaces", "solve", "certify", "barrier", "send", "tick")
SWAPS = {"swap": "default", "guaranteed": "guaranteed"}  # what campaigns call them, by name of the row
_WARM_UP_S = 5.0  # mission time for catching up with the circle
_READY_WITHIN_TICKS = 1500
_ENDLESS_S = 3600.0


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
        get_under_way(f"an agent with {solver}", formation.step, partial(_is_warm, formation))
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


def measure_swaps(
    neighbours: int, solvers: Sequence[str], ticks: int, on_tick: Callable[[], None] = lambda: None
) -> dict[str, dict[str, Array]]:
    """Measure `neighbours + 1` agents in a swap, in each separation mode; (ticks, 9) [ms] over all agents, by solver.

    The neighbours of `measure_ticks` are paths only and can't commit, so every neighbour is a whole agent here, in both
    modes, which take turns: what commitments cost is the ratio of the two.
    """
    modes = [(mode, solver) for mode in SWAPS for solver in solvers]
    crowds = {each: Lockstep(_swap_config(*each, neighbours + 1)) for each in modes}
    timings: dict[tuple[str, str], list[tuple[float, ...]]] = {each: [] for each in modes}
    for (mode, solver), crowd in crowds.items():
        get_under_way(f"{neighbours + 1} agents with {solver}, {mode}", crowd.step, partial(tracks, crowd))
    with settled_garbage():
        for _ in range(0, ticks, neighbours + 1):
            for each, crowd in crowds.items():
                crowd.step()
                timings[each] += [_parts(agent.timing) for agent in crowd.agents if agent is not None]
            for _ in range(neighbours + 1):
                on_tick()
    return {mode: {solver: np.array(timings[mode, solver][:ticks]) for solver in solvers} for mode in SWAPS}


def _swap_config(mode: str, solver: str, agents: int) -> Config:
    cell = Cell(
        scenario="symmetric",
        agents=agents,
        delay_ms=0.0,
        loss=0.0,
        noise="exact",
        wind_m_s=0.0,
        protections=SWAPS[mode],
    )
    extra = (f"controller.mpc.qp.solver='{solver}'", f"mission.duration_s={_ENDLESS_S}")
    return config_of(cell, 1, layout_of(cell.scenario, 1, agents), agents, extra=extra)


def tracks(crowd: Lockstep, agent: int = 0) -> bool:
    """Return whether an agent flies its mission."""
    return int(crowd.logs[agent].rows[-1]["phase"][0]) == Phase.TRACK


def _is_warm(formation: Formation) -> bool:
    return formation.mission_t_s >= _WARM_UP_S


def get_under_way(who: str, step: Callable[[], None], ready: Callable[[], bool]) -> None:
    """Step until `ready`.

    Raises:
        MissionError: that takes too long.
    """
    for _ in range(_READY_WITHIN_TICKS):
        step()
        if ready():
            return
    raise MissionError(f"bench: {who} did not begin within {_READY_WITHIN_TICKS} ticks")


def _parts(timing: TickTiming) -> tuple[float, ...]:
    return (*astuple(timing), timing.tick_ms)
