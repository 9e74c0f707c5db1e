"""The QP solver interface: minimise 1/2 x'Px + q'x subject to l <= Ax <= u, with a fixed sparsity pattern.

Solvers are in `qp_osqp.py` and `qp_daqp.py`, and `registry.py` makes the one that a configuration asks for.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from swarmctl.core.params import Params
from swarmctl.core.types import Array

INFINITY = 1e20  # OSQP's value for a missing bound


def _daqp_is_usable() -> bool:
    try:
        return hasattr(importlib.import_module("daqp"), "Model")
    except ImportError:
        return False


SOLVERS = {"osqp": lambda: True, "daqp": _daqp_is_usable}  # by name: whether it is installed


def installed_solvers() -> tuple[str, ...]:
    """Return the names of the QP solvers that can be imported: OSQP always, DAQP unless it is missing."""
    return tuple(name for name, is_installed in SOLVERS.items() if is_installed())


class QpParams(Params):
    """Sets the solver and its parameters: all apply to OSQP; DAQP is exact and takes `max_iterations` only."""

    solver: Literal["auto", "osqp", "daqp"] = "auto"  # auto: DAQP, which is exact and faster, unless it is missing
    eps: float = Field(3e-3, gt=0, le=0.1)  # absolute; variables and rows are scaled to about 1
    eps_relative: float = Field(3e-4, ge=0, le=0.1)  # small: bounds far from active must not loosen the others
    max_iterations: int = Field(2500, ge=10, le=100000)  # then the last iterate is judged by its residual
    polish: bool = True  # one more linear solve on the active set: exact for a correct guess
    rho: float = Field(0.01, gt=0, le=1e6)  # first step size of OSQP; adapted from then on
    adaptive_rho_interval: int = Field(50, ge=1, le=10000)  # iterations, never seconds
    check_every: int = Field(10, ge=1, le=1000)  # iterations between two looks at the residual
    scaling: int = Field(0, ge=0, le=100)  # passes of equilibration before each solve: two halve the iterations
    retry: Literal["auto", "osqp"] = "auto"  # auto: DAQP solves what OSQP does not finish, unless it is missing

    @property
    def solver_name(self) -> str:
        """Return the name of the solver that solves every problem first."""
        if self.solver != "auto":
            return self.solver
        return "daqp" if SOLVERS["daqp"]() else "osqp"

    @property
    def retry_solver(self) -> str:
        """Return the name of the solver of what the first one does not finish."""
        by_daqp = self.solver_name == "daqp" or (self.retry == "auto" and SOLVERS["daqp"]())
        return "daqp" if by_daqp else "osqp"

    @field_validator("solver")
    @classmethod
    def _installed(cls, solver: str) -> str:
        """Refuse a solver that is not installed, before the first agent starts."""
        if solver != "auto" and not SOLVERS[solver]():
            raise PydanticCustomError(
                "missing_package",
                "{solver} is not installed; pip install '{solver}', or use solver = 'osqp'",
                {"solver": solver},
            )
        return solver


@dataclass(frozen=True, slots=True, kw_only=True)
class QpSolution:
    """Holds the result of a solve: `x` is None without one, and an unfinished iterate to be judged unless `exact`."""

    x: Array | None
    exact: bool
    status: str
    iterations: int


# numbers that are not finite would spoil the next warm start
NOT_FINITE = QpSolution(x=None, exact=False, status="not finite", iterations=0)


class QpSolver(Protocol):
    """Solves problems of one family; every call passes all values, in the pattern given at construction."""

    def solve(self, p_values: Array, q: Array, a_values: Array, lower: Array, upper: Array) -> QpSolution:
        """Solve for new values, warm-started from the last solution. Never raises for an infeasible problem."""


def pattern_index(pattern: NDArray[np.bool_], upper: bool = False) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the stored values in column-major order, the order of values in `solve`."""
    kept = np.triu(pattern) if upper else pattern
    columns, rows = np.nonzero(kept.T)
    return rows, columns


def is_finite(*values: Array) -> bool:
    """Tell whether all numbers of all vectors are finite; missing bounds are `INFINITY`, which is finite."""
    return bool(np.isfinite(np.concatenate(values)).all())  # one call takes a third of the time of many
