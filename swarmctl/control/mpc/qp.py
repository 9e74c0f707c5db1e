"""The QP solver interface: minimise 1/2 x'Px + q'x subject to l <= Ax <= u, with a fixed sparsity pattern.

OSQP is set up once and updated in place; every status is checked. It is a first-order method: callers judge a solution
by residuals in their own units, not by its status alone. Wall-clock time must not influence the iterates, or runs
would not repeat, hence the fixed `adaptive_rho_interval`. DAQP, an exact active-set solver, is an optional extra.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import osqp
from numpy.typing import NDArray
from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError
from scipy import sparse

from swarmctl.core.params import Params
from swarmctl.core.types import Array

INFINITY = 1e20  # OSQP's value for a missing bound
SOLVERS = ("osqp", "daqp")
_RETRY_SCALINGS = 10  # scaling passes of a retry: they help problems that converge slowly, and no others
_SOLVED = osqp.SolverStatus.OSQP_SOLVED
_USABLE = frozenset(  # the last two statuses come with unfinished iterates
    int(status)
    for status in (_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE, osqp.SolverStatus.OSQP_MAX_ITER_REACHED)
)


class QpParams(Params):
    """Sets the solver and its parameters: all apply to OSQP; DAQP is exact and takes `max_iterations` only."""

    solver: Literal["osqp", "daqp"] = "osqp"  # daqp: faster on small swarms, needs the extra swarmctl[daqp]
    eps: float = Field(3e-3, gt=0, le=0.1)  # absolute; variables and rows are scaled to about 1
    eps_relative: float = Field(3e-4, ge=0, le=0.1)  # small: bounds far from active must not loosen the others
    max_iterations: int = Field(2500, ge=10, le=100000)
    polish: bool = True  # one more linear solve on the active set: exact for a correct guess
    rho: float = Field(0.01, gt=0, le=1e6)
    adaptive_rho_interval: int = Field(50, ge=1, le=10000)  # iterations, never seconds
    check_every: int = Field(10, ge=1, le=1000)

    @field_validator("solver")
    @classmethod
    def _installed(cls, solver: str) -> str:
        """Refuse a solver that is not installed, before the first agent starts."""
        if solver == "daqp" and not _daqp_is_usable():
            raise PydanticCustomError(
                "missing_package", "daqp is not installed; pip install 'swarmctl[daqp]', or use solver = 'osqp'"
            )
        return solver


@dataclass(frozen=True, slots=True, kw_only=True)
class QpSolution:
    """Holds the result of a solve: `x` is None without one, and an unfinished iterate to be judged unless `exact`."""

    x: Array | None
    exact: bool
    status: str
    iterations: int


NOT_FINITE = QpSolution(
    x=None, exact=False, status="not finite", iterations=0
)  # such values would spoil the next warm start


class QpSolver(Protocol):
    """Solves problems of one family; every call passes all values, in the pattern given at construction."""

    def solve(self, p_values: Array, q: Array, a_values: Array, lower: Array, upper: Array) -> QpSolution:
        """Solve for new values, warm-started from the last solution. Never raises for an infeasible problem."""


class OsqpSolver:
    """Solves with OSQP.

    Args:
        p_pattern: (n, n) boolean, upper triangle used.
        a_pattern: (m, n) boolean.
        params: solver settings.

    `p_values` and `a_values` of `solve` are the entries of the patterns in column-major order; see `pattern_index`.
    """

    def __init__(self, p_pattern: NDArray[np.bool_], a_pattern: NDArray[np.bool_], params: QpParams) -> None:
        self._p = sparse.csc_matrix(np.triu(p_pattern).astype(float))
        self._a = sparse.csc_matrix(a_pattern.astype(float))
        self._params = params
        self._solver: osqp.OSQP | None = None

    def solve(self, p_values: Array, q: Array, a_values: Array, lower: Array, upper: Array) -> QpSolution:
        if not is_finite(p_values, q, a_values, lower, upper):
            return NOT_FINITE
        if self._solver is None:
            return self._cold(p_values, q, a_values, lower, upper, 0)
        self._solver.update(Px=p_values, q=q, Ax=a_values, l=lower, u=upper)
        solution = self._run()
        if solution.exact:
            return solution
        # a warm start can end in false infeasibility or slow convergence: retry from scratch
        again = self._cold(p_values, q, a_values, lower, upper, _RETRY_SCALINGS)
        return again if again.exact or solution.x is None else solution

    def _cold(self, p_values: Array, q: Array, a_values: Array, lower: Array, upper: Array, scaling: int) -> QpSolution:
        p, a, params = self._p.copy(), self._a.copy(), self._params
        p.data, a.data = p_values.copy(), a_values.copy()
        self._solver = osqp.OSQP()
        self._solver.setup(
            p,
            q,
            a,
            lower,
            upper,
            verbose=False,
            eps_abs=params.eps,
            eps_rel=params.eps_relative,
            max_iter=params.max_iterations,
            polishing=params.polish,
            rho=params.rho,
            adaptive_rho=True,
            adaptive_rho_interval=params.adaptive_rho_interval,
            check_termination=params.check_every,
            scaling=scaling,
            check_dualgap=False,  # inactive slack rows keep it open; callers judge residuals
            warm_starting=True,
        )
        return self._run()

    def _run(self) -> QpSolution:
        assert self._solver is not None
        result = self._solver.solve(raise_error=False)
        x, status = result.x, result.info.status_val
        finite = bool(np.isfinite(x).all())
        if not finite:
            self._solver = None  # the next solve is a cold start
        usable = finite and status in _USABLE
        return QpSolution(
            x=x if usable else None,
            exact=status == _SOLVED,
            status=str(result.info.status),
            iterations=int(result.info.iter),
        )


def pattern_index(pattern: NDArray[np.bool_], upper: bool = False) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the stored values in column-major order, the order of values in `solve`."""
    kept = np.triu(pattern) if upper else pattern
    columns, rows = np.nonzero(kept.T)
    return rows, columns


def is_finite(*values: Array) -> bool:
    """Tell whether all numbers of all vectors are finite; missing bounds are `INFINITY`, which is finite."""
    return bool(np.isfinite(np.concatenate(values)).all())  # one call takes a third of the time of many


def make_solver(p_pattern: NDArray[np.bool_], a_pattern: NDArray[np.bool_], params: QpParams) -> QpSolver:
    """Return the solver that the configuration asks for."""
    if params.solver == "daqp":
        from swarmctl.control.mpc.qp_daqp import DaqpSolver  # an optional package

        return DaqpSolver(p_pattern, a_pattern, params)
    return OsqpSolver(p_pattern, a_pattern, params)


def installed_solvers() -> tuple[str, ...]:
    """Return the names of the QP solvers that can be imported: OSQP always, DAQP with the extra `swarmctl[daqp]`."""
    return tuple(name for name in SOLVERS if name == "osqp" or _daqp_is_usable())


def _daqp_is_usable() -> bool:
    try:
        return hasattr(importlib.import_module("daqp"), "Model")
    except ImportError:
        return False
