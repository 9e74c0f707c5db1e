"""The QP solvers by the names that a configuration uses.

Each is imported with the first solver of its kind: OSQP takes 0.2 s, and most processes only read a configuration.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.mpc.solvers.qp import QpParams, QpSolver

Mask = NDArray[np.bool_]


def _daqp(hessian: Mask, rows: Mask, params: QpParams) -> QpSolver:
    from swarmctl.control.mpc.solvers.qp_daqp import DaqpSolver

    return DaqpSolver(hessian, rows, params)


def _osqp(hessian: Mask, rows: Mask, params: QpParams) -> QpSolver:
    from swarmctl.control.mpc.solvers.qp_osqp import OsqpSolver

    retry = _daqp(hessian, rows, params) if params.retry_solver == "daqp" else None
    return OsqpSolver(hessian, rows, params, retry)


MAKERS = {"osqp": _osqp, "daqp": _daqp}  # the same names as `qp.SOLVERS`


def make_solver(p_pattern: Mask, a_pattern: Mask, params: QpParams) -> QpSolver:
    """Return the solver that the configuration asks for, for Hessians (n, n) and rows (m, n) of these patterns."""
    return MAKERS[params.solver_name](p_pattern, a_pattern, params)
