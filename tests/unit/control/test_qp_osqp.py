"""OSQP without its Python class gives what that class gives, bit for bit; what it does not finish DAQP solves."""

from __future__ import annotations

import sys
from itertools import pairwise

import numpy as np
import osqp
import pytest
from scipy import sparse

from swarmctl.config import load
from swarmctl.control.mpc.solvers.qp import INFINITY, QpParams, pattern_index
from swarmctl.control.mpc.solvers.qp_osqp import OsqpSolver
from swarmctl.control.mpc.solvers.registry import make_solver
from swarmctl.core.types import Array

PARAMS = QpParams()
VARIABLES, ROWS = 4, 9
SQUARE, DENSE = np.ones((VARIABLES, VARIABLES), bool), np.ones((ROWS, VARIABLES), bool)
Values = tuple[Array, Array, Array, Array, Array]


def values(rng: np.random.Generator) -> Values:
    """A feasible problem (0 is inside), some of its upper bounds missing."""
    root, rows = rng.normal(size=(VARIABLES, VARIABLES)), rng.normal(size=(ROWS, VARIABLES))
    hessian = (root @ root.T + np.eye(VARIABLES))[pattern_index(SQUARE, upper=True)]
    lower, upper = -rng.uniform(0.05, 1.0, ROWS), rng.uniform(0.05, 1.0, ROWS)
    upper[rng.random(ROWS) < 0.3] = INFINITY
    return hessian, rng.normal(size=VARIABLES), rows[pattern_index(DENSE)], lower, upper


def set_up_by_the_class(problem: Values, scaling: int) -> osqp.OSQP:
    hessian, rows = sparse.csc_matrix(np.triu(SQUARE).astype(float)), sparse.csc_matrix(DENSE.astype(float))
    hessian.data, slope, rows.data, lower, upper = problem
    solver = osqp.OSQP(algebra="builtin")
    solver.setup(
        hessian,
        slope,
        rows,
        lower,
        upper,
        verbose=False,
        eps_abs=PARAMS.eps,
        eps_rel=PARAMS.eps_relative,
        max_iter=PARAMS.max_iterations,
        polishing=PARAMS.polish,
        rho=PARAMS.rho,
        adaptive_rho=True,
        adaptive_rho_interval=PARAMS.adaptive_rho_interval,
        check_termination=PARAMS.check_every,
        scaling=scaling,
        check_dualgap=False,
        warm_starting=True,
    )
    return solver


@pytest.mark.parametrize("scaling", [0, 2])
@pytest.mark.parametrize("seed", range(3))
def test_a_series_of_problems_has_the_answers_of_the_python_class(seed: int, scaling: int) -> None:
    rng = np.random.default_rng(seed)
    problems = [values(rng) for _ in range(20)]
    params = PARAMS.model_copy(update={"scaling": scaling})
    ours, theirs = OsqpSolver(SQUARE, DENSE, params), set_up_by_the_class(problems[0], scaling)
    answers = []
    for k, (hessian, slope, rows, lower, upper) in enumerate(problems):
        if k > 0:
            theirs.update(Px=hessian, q=slope, Ax=rows, l=lower, u=upper)
        found, expected = ours.solve(hessian, slope, rows, lower, upper), theirs.solve(raise_error=False)
        assert found.exact and found.x is not None
        np.testing.assert_array_equal(found.x, expected.x)
        assert (found.status, found.iterations) == (expected.info.status, expected.info.iter)
        answers.append(found.x)
    assert all((one != other).any() for one, other in pairwise(answers)), "each problem has its own answer"


UNFINISHED = QpParams(solver="osqp", eps=1e-9, eps_relative=1e-9, polish=False, max_iterations=10, check_every=1)


def test_what_osqp_does_not_finish_is_solved_by_the_exact_solver() -> None:
    problem = values(np.random.default_rng(1))
    exact = make_solver(SQUARE, DENSE, QpParams(solver="daqp")).solve(*problem)
    stopped = make_solver(SQUARE, DENSE, UNFINISHED.model_copy(update={"retry": "osqp"})).solve(*problem)
    found = make_solver(SQUARE, DENSE, UNFINISHED).solve(*problem)
    assert exact.x is not None and found.x is not None
    assert found.exact and not stopped.exact
    np.testing.assert_allclose(found.x, exact.x, atol=1e-12)


def test_without_its_package_osqp_tries_again(monkeypatch: pytest.MonkeyPatch) -> None:
    first = QpParams(solver="osqp")
    assert first.retry_solver == QpParams(solver="daqp").retry_solver == QpParams().retry_solver == "daqp"
    monkeypatch.setitem(sys.modules, "daqp", None)
    assert first.retry_solver == "osqp"
    solver = make_solver(SQUARE, DENSE, first)
    assert solver.solve(*values(np.random.default_rng(1))).exact


def test_the_one_that_is_asked_is_named_in_the_summary() -> None:
    assert load(None).rules().solver_retry == "daqp"
    assert (
        load(None, ["controller.mpc.qp.solver='osqp'", "controller.mpc.qp.retry='osqp'"]).rules().solver_retry == "osqp"
    )
