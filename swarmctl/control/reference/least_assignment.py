"""The linear assignment problem: every row gets a column of its own, and the sum of the costs is the least.

Rows are added one by one on shortest augmenting paths, by prices under which no way is cheaper than free (D. F. Crouse,
On implementing 2D rectangular assignment algorithms, 2016). Of equal sums it chooses as SciPy does, whose
`linear_sum_assignment` brings 37 MiB into an agent.
"""

from __future__ import annotations

import math

from swarmctl.core.types import Array

_NOBODY = -1


def least_assignment(costs: Array) -> list[int]:
    """Return the column of each row.

    Args:
        costs: (N, N) finite; sums of whole numbers are exact, so that rounding decides no tie.
    """
    assignment = _Assignment(costs.tolist())
    for row in range(len(costs)):
        assignment.add(row)
    return assignment.column_of


class _Assignment:
    """Holds the cheapest assignment of the rows added so far.

    Args:
        costs: of each row in each column.
    """

    def __init__(self, costs: list[list[float]]) -> None:
        self._costs, count = costs, len(costs)
        self._row_prices, self._column_prices = [0.0] * count, [0.0] * count
        self._row_of, self.column_of = [_NOBODY] * count, [_NOBODY] * count

    def add(self, new: int) -> None:
        """Give a row a column, for which others on the shortest path to a free one change theirs."""
        count, prices, row_of = len(self._costs), self._column_prices, self._row_of
        lengths, before = [math.inf] * count, [new] * count  # of the path to each column, and the row before it
        left, passed = list(range(count - 1, -1, -1)), list[int]()  # columns; the order of `left` decides ties
        row, shortest = new, 0.0
        while row != _NOBODY:
            costs, spent = self._costs[row], shortest - self._row_prices[row]
            place, shortest = 0, math.inf
            for i, column in enumerate(left):
                length, by_row = lengths[column], spent + costs[column] - prices[column]
                if by_row < length:
                    lengths[column], before[column] = by_row, row
                    length = by_row
                if length < shortest or (length == shortest and row_of[column] == _NOBODY):
                    place, shortest = i, length
            passed.append(left[place])
            left[place] = left[-1]
            left.pop()
            row = row_of[passed[-1]]
        self._change_prices(new, passed, lengths)
        self._exchange(new, passed[-1], before)

    def _change_prices(self, new: int, passed: list[int], lengths: list[float]) -> None:
        """Make the path free, by what it is longer than the way to each column that was passed."""
        shortest = lengths[passed[-1]]
        self._row_prices[new] += shortest
        for column in passed[:-1]:
            self._column_prices[column] -= shortest - lengths[column]
            self._row_prices[self._row_of[column]] += shortest - lengths[column]

    def _exchange(self, new: int, column: int, before: list[int]) -> None:
        """Assign along the path, backwards from its end."""
        row = _NOBODY
        while row != new:
            row = before[column]
            self._row_of[column] = row
            self.column_of[row], column = column, self.column_of[row]
