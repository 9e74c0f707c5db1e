"""Assignments have the least sum, and are those that SciPy finds, also where several have it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from swarmctl.control.reference.least_assignment import least_assignment


@pytest.mark.parametrize("different", [1, 2, 4, 10**9])
@pytest.mark.parametrize("count", [1, 2, 3, 6, 12, 40])
def test_it_chooses_as_scipy_does_where_costs_are_whole(count: int, different: int) -> None:
    random = np.random.default_rng([count, different])
    for _ in range(20):
        costs = random.integers(0, different, (count, count)).astype(float)
        assert least_assignment(costs) == linear_sum_assignment(costs)[1].tolist()


def test_no_permutation_has_a_smaller_sum() -> None:
    costs = np.random.default_rng(7).uniform(-1.0, 1.0, (6, 6))
    chosen = least_assignment(costs)
    assert sorted(chosen) == list(range(6))
    sums = [costs[range(6), order].sum() for order in itertools.permutations(range(6))]
    assert costs[range(6), chosen].sum() == pytest.approx(min(sums), abs=1e-12)
