"""Solves one program tick after tick from a warm start, and relaxes it when a solution will not do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from swarmctl.control.mpc.condensed_qp.program import Program
from swarmctl.control.mpc.solvers.qp import QpParams, QpSolution
from swarmctl.control.mpc.solvers.registry import make_solver


@dataclass(frozen=True, slots=True)
class Relaxation:
    """Describes a change of the program after which it is solved again in the same tick."""

    needed: Callable[[QpSolution], bool]
    apply: Callable[[], None]  # changes bounds and slope only; the next tick fills all of them again


class SolverSession:
    """Keeps a solver for the program as it is filled, and another for the relaxed one, each warm-started by itself.

    Args:
        program: the problem, filled before each solution.
        relaxations: what is tried in this order.
        qp: solver settings.
        stopwatch_ns: measures the solver and has no influence.
    """

    def __init__(
        self, program: Program, relaxations: Sequence[Relaxation], qp: QpParams, stopwatch_ns: Callable[[], int]
    ) -> None:
        self._program, self._relaxations, self._stopwatch_ns = program, tuple(relaxations), stopwatch_ns
        self.solver = make_solver(program.hessian_pattern, program.pattern, qp)
        self._relaxed = make_solver(program.hessian_pattern, program.pattern, qp) if relaxations else self.solver

    def solve(self) -> tuple[QpSolution, float]:
        """Return the solution of the filled program, or of the relaxed one, and the time [us] that it took."""
        program = self._program
        hessian, coefficients = program.matrices()
        began_ns = self._stopwatch_ns()
        solution = self.solver.solve(hessian, program.slope, coefficients, program.lower, program.upper)
        for relaxation in self._relaxations:
            if relaxation.needed(solution):
                relaxation.apply()
                solution = self._relaxed.solve(hessian, program.slope, coefficients, program.lower, program.upper)
        return solution, (self._stopwatch_ns() - began_ns) * 1e-3
