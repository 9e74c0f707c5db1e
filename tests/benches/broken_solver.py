"""A QP solver that answers wrongly for a while, in an agent of a lockstep flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sitl.lockstep import Lockstep
from swarmctl.control.mpc.solvers.qp import QpSolution
from swarmctl.control.mpc.swarm_mpc import SwarmMpc

Spoil = Callable[[QpSolution], QpSolution]


def no_answer(solution: QpSolution) -> QpSolution:
    return QpSolution(x=None, exact=False, status="broken", iterations=0)


def wrong_answer(solution: QpSolution) -> QpSolution:
    """Return numbers that solve something else, and say that they are the solution."""
    return solution if solution.x is None else replace(solution, x=solution.x + 5.0, exact=False)


def not_numbers(solution: QpSolution) -> QpSolution:
    """Return what is not finite, and say that it is the solution."""
    return solution if solution.x is None else replace(solution, x=np.full_like(solution.x, np.nan))


def break_solver(running: Lockstep, agent: int, lasts_s: float, spoil: Spoil = no_answer) -> None:
    """Spoil the answers of one agent's solver for a while."""
    until_s = running.clock.now_us() * 1e-6 + lasts_s
    flown = running.agents[agent]
    assert flown is not None
    planner = flown._planner.controller
    assert isinstance(planner, SwarmMpc)
    for solver in (mpc.session.solver for mpc in (planner._xy_alone, *planner._xy.sizes.values())):
        solver.solve = partial(_solve, running, until_s, spoil, solver.solve)  # type: ignore[method-assign]


def _solve(
    running: Lockstep, until_s: float, spoil: Spoil, solve: Callable[..., QpSolution], *values: object
) -> QpSolution:
    solution = solve(*values)
    return solution if running.clock.now_us() * 1e-6 >= until_s else spoil(solution)
