"""The quadratic program of a condensed MPC: arrays of fixed sparsity, assembled from blocks of constraints.

Columns are the scaled increments of all axes (`moves`), axis after axis, then the slacks of all blocks. Rows are those
of blocks without slacks, the bounds of all slacks, then the rows of blocks with slacks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.mpc.condensed_qp.prediction import Forecast
from swarmctl.control.mpc.solvers.qp import INFINITY, pattern_index
from swarmctl.core.types import Array

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Holds the views of the program that belong to one block of constraints, `lower <= coefficients x <= upper`."""

    coefficients: Array  # (rows, columns) of all variables, only to be read
    moves: Array  # (rows, moves) coefficients of increments
    lower: Array  # (rows,)
    upper: Array  # (rows,)
    slope: Array  # (moves,) linear cost of increments, only to be read
    slack_slope: Array  # (slacks,) linear cost of own slacks
    slack_max: Array  # (slacks,) upper bounds of own slacks, which are never negative
    slack_columns: slice  # own slacks among all variables


class ConstraintBlock(ABC):
    """Yields rows of one kind of constraint.

    Args:
        uses: (rows, moves) increments that each row may involve.
        slacks: (rows, slacks) constant coefficients of own slacks; None for a block without any.
        slack_curvature: quadratic cost of each own slack.
    """

    def __init__(self, uses: Mask, slacks: Array | None = None, slack_curvature: float = 0.0) -> None:
        self.uses, self.slack_curvature = uses, slack_curvature
        self.slacks = np.zeros((len(uses), 0)) if slacks is None else slacks

    def prepare(self, rows: Rows) -> None:
        """Write what is the same at every step; bounds are infinite before."""
        return

    @abstractmethod
    def fill(self, rows: Rows, forecast: Forecast) -> None:
        """Write what depends on the step; the cost is filled before."""

    def residual_m(self, rows: Rows, flown: Array) -> float:
        """Return the largest violation [m] by the variables `flown` (columns,), increments and inputs in bounds."""
        return 0.0


class Program:
    """Holds the arrays of the problem: minimise 1/2 x'Px + q'x subject to l <= Ax <= u.

    Args:
        cost: (moves, moves) entries of the Hessian of increments that may differ from 0.
        blocks: all constraints; rows and slacks are in their order, those without slacks first.
    """

    def __init__(self, cost: Mask, blocks: Sequence[ConstraintBlock]) -> None:
        moves, slacks = len(cost), sum(block.slacks.shape[1] for block in blocks)
        columns, rows = moves + slacks, slacks + sum(len(block.uses) for block in blocks)
        self.hessian, self.slope = np.zeros((columns, columns)), np.zeros(columns)
        self.coefficients = np.zeros((rows, columns))
        self.lower, self.upper = np.full(rows, -INFINITY), np.full(rows, INFINITY)
        self.hessian_pattern, self.pattern = np.eye(columns, dtype=bool), np.zeros((rows, columns), bool)
        self.hessian_pattern[:moves, :moves] = cost
        self.rows = dict(self._placed(sorted(blocks, key=lambda block: block.slacks.shape[1] > 0), moves, slacks))
        self._filled = [(block, rows) for block, rows in self.rows.items() if len(block.uses)]
        self._hessian_index = np.ravel_multi_index(pattern_index(self.hessian_pattern, upper=True), (columns, columns))
        self._index = np.ravel_multi_index(pattern_index(self.pattern), (rows, columns))

    def _placed(
        self, blocks: Sequence[ConstraintBlock], moves: int, slacks: int
    ) -> Iterator[tuple[ConstraintBlock, Rows]]:
        """Write the constants of each block, and yield it with its views."""
        row, column = sum(len(block.uses) for block in blocks if not block.slacks.shape[1]), np.arange(slacks)
        bound_rows = slice(row, row + slacks)
        self.pattern[row + column, moves + column] = True
        self.coefficients[row + column, moves + column] = 1.0
        self.lower[bound_rows] = 0.0
        next_row, next_slack = 0, 0
        for block in blocks:
            count, own_slacks = block.slacks.shape
            first = next_row + (slacks if own_slacks else 0)
            own, extra = slice(first, first + count), slice(moves + next_slack, moves + next_slack + own_slacks)
            self.pattern[own, :moves], self.pattern[own, extra] = block.uses, block.slacks != 0.0
            self.coefficients[own, extra] = block.slacks
            np.fill_diagonal(self.hessian[extra, extra], block.slack_curvature)
            rows = Rows(
                coefficients=self.coefficients[own],
                moves=self.coefficients[own, :moves],
                lower=self.lower[own],
                upper=self.upper[own],
                slope=self.slope[:moves],
                slack_slope=self.slope[extra],
                slack_max=self.upper[bound_rows][next_slack : next_slack + own_slacks],
                slack_columns=extra,
            )
            block.prepare(rows)
            yield block, rows
            next_row, next_slack = next_row + count, next_slack + own_slacks

    def fill(self, forecast: Forecast) -> None:
        """Write the constraints of one step; the cost is written before."""
        for block, rows in self._filled:
            block.fill(rows, forecast)

    def matrices(self) -> tuple[Array, Array]:
        """Return the values of Hessian and coefficients in the order of `QpSolver.solve`."""
        return self.hessian.take(self._hessian_index), self.coefficients.take(self._index)

    def residual_m(self, flown: Array) -> float:
        """Return the largest violation [m] of any constraint by the variables `flown` (columns,)."""
        return max([block.residual_m(rows, flown) for block, rows in self._filled])
