"""Solver interface to DAQP: a dual active-set method, exact up to rounding, dense, fast for tens of variables.

Imported with the first solver: a system without a wheel of it flies with OSQP alone.
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from swarmctl.control.mpc.solvers.qp import INFINITY, NOT_FINITE, QpParams, QpSolution, is_finite, pattern_index
from swarmctl.core.types import Array

_UNBOUNDED = 1e30  # DAQP's value for a missing bound
_PROXIMAL_IF_SINGULAR = -1e-6  # `eps_prox`: negative is automatic, positive would regularise every problem
_OPTIMAL = 1
_STATUS = {  # DAQP's exit flags
    1: "solved",
    2: "solved softly",
    -1: "infeasible",
    -2: "cycling",
    -3: "unbounded",
    -4: "iteration limit",
    -5: "not convex",
    -6: "overdetermined start",
    -7: "time limit",
}


class DaqpSolver:
    """Solves with DAQP; see `OsqpSolver` for the arguments.

    The working set of the last solution is the warm start of the next. DAQP needs a positive definite Hessian, and
    this one is: increments cost at least r, and every slack has a quadratic weight (1e-3 for a terminal condition, more
    for a half-space). A weight r near 0 makes it singular in floating point; only for that case DAQP's automatic
    proximal regularisation is on, which leaves solutions of positive definite problems unchanged, bit for bit.
    """

    def __init__(self, p_pattern: NDArray[np.bool_], a_pattern: NDArray[np.bool_], params: QpParams) -> None:
        self._p_index, self._a_index = pattern_index(p_pattern, upper=True), pattern_index(a_pattern)
        self._p, self._a = np.zeros(p_pattern.shape), np.zeros(a_pattern.shape)
        self._limit = params.max_iterations
        self._model: daqp.Model | None = None

    def solve(self, p_values: Array, q: Array, a_values: Array, lower: Array, upper: Array) -> QpSolution:
        if not is_finite(p_values, q, a_values, lower, upper):
            return NOT_FINITE
        rows, columns = self._p_index
        self._p[rows, columns] = p_values
        self._p[columns, rows] = p_values
        self._a[self._a_index] = a_values
        low = np.where(lower <= -INFINITY, -_UNBOUNDED, lower)
        high = np.where(upper >= INFINITY, _UNBOUNDED, upper)
        if self._model is not None:
            solution = self._warm(self._model, q, low, high)
            if solution.exact:
                return solution
        return self._cold(q, low, high)  # an old working set can be a bad start: failures are retried cold

    def _warm(self, model: daqp.Model, q: Array, low: Array, high: Array) -> QpSolution:
        flag = model.update(H=self._p, f=q, A=self._a, bupper=high, blower=low)
        return self._run(model) if flag >= 0 else _failed(flag)

    def _cold(self, q: Array, low: Array, high: Array) -> QpSolution:
        model = daqp.Model()
        model.settings = {"iter_limit": self._limit, "eps_prox": _PROXIMAL_IF_SINGULAR}
        # copies: the model keeps references, and the next call overwrites these arrays
        flag, _ = model.setup(self._p.copy(), q.copy(), self._a.copy(), high, low)
        return self._run(model) if flag >= 0 else _failed(flag)

    def _run(self, model: daqp.Model) -> QpSolution:
        x, _, flag, info = model.solve()
        if flag != _OPTIMAL or not np.isfinite(x).all():
            self._model = None  # the next solve is a cold start
            failed = _failed(flag)
            return QpSolution(x=None, exact=False, status=failed.status, iterations=int(info["iterations"]))
        self._model = model
        return QpSolution(x=x, exact=True, status=_STATUS[_OPTIMAL], iterations=int(info["iterations"]))


def _failed(flag: int) -> QpSolution:
    return QpSolution(x=None, exact=False, status=_STATUS.get(int(flag), f"exit flag {flag}"), iterations=0)
