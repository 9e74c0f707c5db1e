"""Solver interface to OSQP, set up once and updated in place; every status is checked.

It is a first-order method: callers judge a solution by residuals in their own units, not by its status alone.
Wall-clock time must not influence the iterates, or runs would not repeat, hence the fixed `adaptive_rho_interval`.

OSQP is called by the extension module that its Python class is made of: the class checks and copies again what is
checked here, and lists some twenty results, which takes as long as a solution of the z problem.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from osqp import ext_builtin as osqp
from scipy import sparse

from swarmctl.control.mpc.solvers.qp import NOT_FINITE, QpParams, QpSolution, QpSolver, is_finite
from swarmctl.core.types import Array

_RETRY_SCALINGS = 10  # scaling passes of a retry: they help problems that converge slowly, and no others
_STATUS = osqp.osqp_status_type
_SOLVED = int(_STATUS.OSQP_SOLVED)
_USABLE = frozenset(  # the last two statuses come with unfinished iterates
    int(status) for status in (_STATUS.OSQP_SOLVED, _STATUS.OSQP_SOLVED_INACCURATE, _STATUS.OSQP_MAX_ITER_REACHED)
)


class OsqpSolver:
    """Solves the QP of one tick with OSQP.

    Args:
        p_pattern: (n, n) boolean, upper triangle used.
        a_pattern: (m, n) boolean.
        params: solver settings.
        retry: solves what it does not finish; None: OSQP itself from scratch.

    `p_values` and `a_values` of `solve` are the entries of the patterns in column-major order; see `pattern_index`.
    """

    def __init__(
        self,
        p_pattern: NDArray[np.bool_],
        a_pattern: NDArray[np.bool_],
        params: QpParams,
        retry: QpSolver | None = None,
    ) -> None:
        self._p = sparse.csc_matrix(np.triu(p_pattern).astype(float))
        self._a = sparse.csc_matrix(a_pattern.astype(float))
        self._params, self._retry = params, retry
        self._solver: osqp.OSQPSolver | None = None

    def solve(self, p_values: Array, q: Array, a_values: Array, lower: Array, upper: Array) -> QpSolution:
        if not is_finite(p_values, q, a_values, lower, upper):
            return NOT_FINITE
        if is_first := self._solver is None:
            solution = self._cold(p_values, q, a_values, lower, upper=upper, scaling=self._params.scaling)
        else:
            self._solver.update_data_vec(q=q, l=lower, u=upper)
            self._solver.update_data_mat(P_x=p_values, P_i=None, A_x=a_values, A_i=None)
            solution = self._run()
        if solution.exact or (is_first and self._retry is None):
            return solution
        if self._retry is not None:
            again = self._retry.solve(p_values, q, a_values, lower, upper)
        else:  # a warm start can end in false infeasibility or slow convergence: retry from scratch
            again = self._cold(p_values, q, a_values, lower, upper=upper, scaling=_RETRY_SCALINGS)
        return again if again.exact or solution.x is None else solution

    def _cold(
        self, p_values: Array, q: Array, a_values: Array, lower: Array, *, upper: Array, scaling: int
    ) -> QpSolution:
        p, a = self._p.copy(), self._a.copy()
        p.data, a.data = p_values.copy(), a_values.copy()
        rows, columns = a.shape
        settings = self._settings(scaling)
        self._solver = osqp.OSQPSolver(osqp.CSC(p), q, osqp.CSC(a), lower, upper, rows, columns, settings)
        self._solution = self._solver.solution
        return self._run()

    def _settings(self, scaling: int) -> osqp.OSQPSettings:
        settings, params = osqp.OSQPSettings(), self._params
        osqp.osqp_set_default_settings(settings)
        settings.verbose = False
        settings.eps_abs, settings.eps_rel = params.eps, params.eps_relative
        settings.max_iter, settings.check_termination = params.max_iterations, params.check_every
        settings.polishing = params.polish
        settings.rho, settings.adaptive_rho = params.rho, True
        settings.adaptive_rho_interval = params.adaptive_rho_interval
        settings.scaling = scaling
        settings.check_dualgap = False  # inactive slack rows keep it open; callers judge residuals
        settings.warm_starting = True
        return settings

    def _run(self) -> QpSolution:
        assert self._solver is not None
        self._solver.solve()
        x, info = self._solution.x, self._solver.info
        finite = bool(np.isfinite(x).all())
        if not finite:
            self._solver = None  # the next solve is a cold start
        status = info.status_val
        usable = finite and status in _USABLE
        return QpSolution(
            x=x if usable else None, exact=status == _SOLVED, status=str(info.status), iterations=int(info.iter)
        )
