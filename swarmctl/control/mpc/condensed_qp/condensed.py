"""Condensed linear MPC over input increments for one, two or three axes (thesis 3.9-3.31).

The decision variables are the increments of the inputs over the control horizon, scaled to about [-1, 1], and slacks.
This module lists the constraints and reads the plan from the solution. The problem does not depend on which axis is
which.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from swarmctl.control.mpc.condensed_qp.axes import (
    AxesProblem,
    AxesSolution,
    Axis,
    Faces,
    HalfSpaces,
    Horizon,
    Penalties,
)
from swarmctl.control.mpc.condensed_qp.constraints import (
    IncrementBounds,
    InputBounds,
    KeepOutHalfSpaces,
    TerminalConditions,
    VolumeFaces,
    slack_m,
)
from swarmctl.control.mpc.condensed_qp.prediction import Forecast, Prediction
from swarmctl.control.mpc.condensed_qp.program import ConstraintBlock, Program
from swarmctl.control.mpc.condensed_qp.session import Relaxation, SolverSession
from swarmctl.control.mpc.condensed_qp.tracking_cost import TrackingCost
from swarmctl.control.mpc.solvers.qp import QpParams, QpSolution
from swarmctl.core.types import Array

_SLACK_USED_M = 1e-3


def _usable(solution: QpSolution) -> Array | None:
    """Return the solution's variables; None without one, and where a number is not finite: no bound refuses those."""
    x = solution.x
    return x if x is not None and math.isfinite(x @ x) else None


class CondensedMpc:
    """Solves one family of problems with fixed sparsity, one of them every tick.

    Args:
        axes: weights and bounds of each axis.
        horizon: lengths and sample time.
        max_keep_outs: largest number of half-space families (neighbours and obstacles).
        relax_01: see `KeepOutHalfSpaces`.
        penalties: weights of softened constraints.
        qp: solver settings.
        stopwatch_ns: measures the solver and has no influence.
        faces: to stay inside of; None for none.
    """

    def __init__(
        self,
        axes: tuple[Axis, ...],
        horizon: Horizon,
        max_keep_outs: int,
        relax_01: float,
        *,
        penalties: Penalties,
        qp: QpParams,
        stopwatch_ns: Callable[[], int],
        faces: Faces | None = None,
    ) -> None:
        self.prediction = Prediction(axes, horizon)
        self._cost = TrackingCost(self.prediction)
        self._ends = TerminalConditions(self.prediction, penalties, self._cost.scale)
        self.half_spaces = KeepOutHalfSpaces(
            self.prediction, max_keep_outs, relax_01, penalties, cost_scale=self._cost.scale
        )
        self._softened: list[ConstraintBlock] = [self.half_spaces]  # what ends give way to
        if faces is not None:
            scale = self._cost.scale
            self._softened.append(VolumeFaces(self.prediction, faces, penalties, cost_scale=scale))
        blocks = (IncrementBounds(self.prediction), InputBounds(self.prediction), self._ends, *self._softened)
        self._program = Program(self._cost.pattern(), blocks)
        if max_keep_outs == 0 and faces is None:  # a small problem: tight tolerances cost less than polishing
            qp = qp.model_copy(update={"polish": False, "eps": 0.01 * qp.eps, "eps_relative": 0.01 * qp.eps_relative})
        self.session = SolverSession(self._program, list(self._relaxations()), qp, stopwatch_ns)

    def _relaxations(self) -> Iterator[Relaxation]:
        """Yield what gives way: end velocities, then all ends, where infeasible; all ends where they cost distance."""
        ends, rows = self._ends, self._program.rows
        for softened in (ends.velocities, ends.every):
            if len(softened):
                yield Relaxation(lambda found: not found.exact, partial(ends.soften, rows[ends], softened))
        if len(ends.every):
            yield Relaxation(self._uses_slack, partial(ends.give_up, rows[ends]))

    def _uses_slack(self, solution: QpSolution) -> bool:
        return any(slack_m(self._program.rows[block], solution) > _SLACK_USED_M for block in self._softened)

    def solve(self, asked: AxesProblem, half_spaces: HalfSpaces | None = None) -> AxesSolution:
        """Solve one receding-horizon step, with at most `max_keep_outs` families of half-spaces; None for none."""
        return self.solve_from(self.prediction.forecast(asked, half_spaces))

    def solve_from(self, forecast: Forecast) -> AxesSolution:
        """Solve one receding-horizon step from its forecast, which has the half-spaces."""
        program = self._program
        self._cost.fill(program.hessian, program.slope, forecast)
        program.fill(forecast)
        solution, solve_us = self.session.solve()
        return self._plan(forecast, solution, solve_us)

    def _plan(self, forecast: Forecast, solution: QpSolution, solve_us: float) -> AxesSolution:
        """Return the motion under the increments of a solution, with what it violates."""
        x, ahead = _usable(solution), self.prediction
        increments = ahead.increments(x, forecast.u_prev)
        scaled = ahead.scaled(increments)
        motion = forecast.free + np.einsum("qakc,ac->qka", forecast.response, increments)
        residual_m = gap_m = math.inf
        if x is not None:
            flown = x.copy()
            flown[: increments.size] = scaled
            residual_m = self._program.residual_m(flown)
            gap_m = self._ends.gap(self._program.rows[self._ends], forecast, flown)
        return AxesSolution(
            solved=x is not None,
            status=solution.status,
            iterations=solution.iterations,
            u=forecast.u_prev + ahead.hold @ increments.T,
            increments=scaled.reshape(increments.shape),
            pos_m=motion[0],
            vel_m_s=motion[1],
            slack_m=slack_m(self._program.rows[self.half_spaces], solution),
            residual_m=residual_m,
            terminal_gap_m=max(gap_m, self._cost.outside_m(forecast, motion, increments)),
            solve_us=solve_us,
        )
