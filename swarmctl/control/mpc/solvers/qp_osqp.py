"""Solver interface to OSQP, set up once and updated in place; every status is checked.

It is a first-order method: callers judge a solution by residuals in their own units, not by its status alone.
Wall-clock time must not influence the iterates, or runs would not repeat, hence the fixed `adaptive_rho_interval`.
"""

from __future__ import annotations

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from swarmctl.control.mpc.solvers.qp import NOT_FINITE, QpParams, QpSolution, is_finite
from swarmctl.core.types import Array

_RETRY_SCALINGS = 10  # scaling passes of a retry: they help problems that converge slowly, and no others
_SOLVED = osqp.SolverStatus.OSQP_SOLVED
_USABLE = frozenset(  # the last two statuses come with unfinished iterates
    int(status)
    for status in (_SOLVED, osqp.SolverStatus.OSQP_SOLVED_INACCURATE, osqp.SolverStatus.OSQP_MAX_ITER_REACHED)
)


class OsqpSolver:
    """Solves the QP of one tick with OSQP.

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
            return self._cold(p_values, q, a_values, lower, upper=upper, scaling=0)
        self._solver.update(Px=p_values, q=q, Ax=a_values, l=lower, u=upper)
        solution = self._run()
        if solution.exact:
            return solution
        # a warm start can end in false infeasibility or slow convergence: retry from scratch
        again = self._cold(p_values, q, a_values, lower, upper=upper, scaling=_RETRY_SCALINGS)
        return again if again.exact or solution.x is None else solution

    def _cold(
        self, p_values: Array, q: Array, a_values: Array, lower: Array, *, upper: Array, scaling: int
    ) -> QpSolution:
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
