"""Projection onto a polyhedron agrees with a general solver, in every dimension that is used."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from swarmctl.control.collision.projection import Row, project, project_or_violate_least


def random_rows(rng: np.random.Generator, dims: int, count: int, inside: bool) -> list[Row]:
    rows = []
    for _ in range(count):
        normal = rng.normal(size=dims)
        offset = -abs(rng.normal()) if inside else rng.normal(scale=0.7)
        rows.append((tuple(normal.tolist()), float(offset)))
    return rows


@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_the_projection_is_the_nearest_point(dims: int) -> None:
    rng = np.random.default_rng(dims)
    for _ in range(25):
        rows = random_rows(rng, dims, 3 * dims, inside=True)
        wanted = rng.normal(scale=3.0, size=dims)
        found = project(tuple(wanted.tolist()), rows)
        assert found is not None
        a, b = np.array([n for n, _ in rows]), np.array([o for _, o in rows])
        assert (a @ np.array(found) - b).min() > -1e-7
        best = minimize(
            lambda x, w=wanted: np.sum((x - w) ** 2),
            np.zeros(dims),
            jac=lambda x, w=wanted: 2.0 * (x - w),
            constraints={"type": "ineq", "fun": lambda x, a=a, b=b: a @ x - b, "jac": lambda x, a=a: a},
            method="SLSQP",
        )
        assert math.dist(found, wanted.tolist()) == pytest.approx(math.sqrt(best.fun), abs=1e-4)


def test_the_projection_is_none_exactly_for_an_empty_polyhedron() -> None:
    rng = np.random.default_rng(5)
    seen = set()
    for _ in range(120):
        rows = random_rows(rng, 3, 8, inside=False)
        a, b = np.array([n for n, _ in rows]), np.array([o for _, o in rows])
        feasible = linprog(np.zeros(3), A_ub=-a, b_ub=-b, bounds=[(None, None)] * 3).status == 0
        assert (project((0.0, 0.0, 0.0), rows) is not None) == feasible
        seen.add(feasible)
    assert seen == {True, False}


def test_violation_is_shared_evenly_and_hard_rows_are_met() -> None:
    soft: list[Row] = [((1.0, 0.0), 2.0), ((-1.0, 0.0), 0.0)]  # x >= 2 and x <= 0
    hard: list[Row] = [((0.0, 1.0), -1.0), ((0.0, -1.0), -1.0)]
    x, y = project_or_violate_least((5.0, 3.0), soft, hard, 1e4)
    assert x == pytest.approx(1.0, abs=1e-3)
    assert y == pytest.approx(1.0, abs=1e-9)


def test_a_point_inside_is_returned_unchanged() -> None:
    wanted = (0.1, 0.2, 0.3)
    assert project(wanted, [((1.0, 0.0, 0.0), 0.0)]) is wanted
