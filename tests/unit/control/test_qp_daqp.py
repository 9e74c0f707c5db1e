"""DAQP behind the solver interface agrees with OSQP, is exact, and reports failure as a value."""

from __future__ import annotations

import subprocess
import sys
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl.config import load
from swarmctl.control.mpc.solvers.qp import INFINITY, SOLVERS, QpParams, is_finite, pattern_index
from swarmctl.control.mpc.solvers.qp_daqp import DaqpSolver
from swarmctl.control.mpc.solvers.qp_osqp import OsqpSolver
from swarmctl.control.mpc.solvers.registry import MAKERS, make_solver
from swarmctl.core.types import Array
from swarmctl.errors import ConfigError

EXACT = QpParams(solver="osqp", eps=1e-9, eps_relative=1e-9, max_iterations=50_000)
SIZES = [(3, 5), (6, 20), (15, 60)]
Pattern = NDArray[np.bool_]
Values = tuple[Array, Array, Array, Array, Array]


def patterns(n: int, m: int, rng: np.random.Generator) -> tuple[Pattern, Pattern]:
    """A Hessian of two blocks and a sparse A with the identity on top."""
    p = np.zeros((n, n), bool)
    p[: n // 2, : n // 2] = p[n // 2 :, n // 2 :] = True
    a = rng.random((m, n)) < 0.5
    a[:n] = np.eye(n, dtype=bool)
    return p, a


def values(p: Pattern, a: Pattern, rng: np.random.Generator) -> Values:
    """A feasible problem (0 is inside), some of its rows switched off."""
    n, m = len(p), len(a)
    root = np.where(p, rng.normal(size=(n, n)), 0.0)
    hessian = root @ root.T + 0.1 * np.eye(n)
    rows = np.where(a, rng.normal(size=(m, n)), 0.0)
    rows[:n] = np.eye(n)
    lower, upper = -rng.uniform(0.05, 1.0, m), rng.uniform(0.05, 1.0, m)
    lower[rng.random(m) < 0.3] = -INFINITY
    upper[rng.random(m) < 0.3] = INFINITY
    return hessian[pattern_index(p, upper=True)], rng.normal(size=n), rows[pattern_index(a)], lower, upper


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_both_solvers_agree(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng([seed, n, m])
    p, a = patterns(n, m, rng)
    exact, first_order = make_solver(p, a, QpParams(solver="daqp")), make_solver(p, a, EXACT)
    assert isinstance(exact, DaqpSolver) and isinstance(first_order, OsqpSolver)
    for _ in range(10):
        problem = values(p, a, rng)
        ours, theirs = exact.solve(*problem), first_order.solve(*problem)
        assert ours.exact and theirs.exact
        assert ours.x is not None and theirs.x is not None
        np.testing.assert_allclose(ours.x, theirs.x, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_a_warm_start_does_not_change_the_answer(seed: int) -> None:
    rng = np.random.default_rng([seed, 7])
    p, a = patterns(15, 60, rng)
    warm = DaqpSolver(p, a, QpParams())
    for _ in range(30):  # unrelated problems, rows switched on and off: the worst kind of warm start
        problem = values(p, a, rng)
        from_last, from_scratch = warm.solve(*problem), DaqpSolver(p, a, QpParams()).solve(*problem)
        assert from_last.exact and from_last.x is not None and from_scratch.x is not None
        np.testing.assert_allclose(from_last.x, from_scratch.x, atol=1e-8)


def test_a_warm_start_saves_iterations() -> None:
    rng = np.random.default_rng(1)
    p, a = patterns(15, 60, rng)
    solver = DaqpSolver(p, a, QpParams())
    problem = values(p, a, rng)
    first, again = solver.solve(*problem), solver.solve(*problem)
    assert first.iterations > 1
    assert again.iterations < first.iterations


def one_variable(lower: float, upper: float, weight: float = 1.0) -> Values:
    """Two rows `x >= lower` and `x <= upper` with minimum of the cost at 1."""
    none = INFINITY
    return np.array([weight]), np.array([-weight]), np.ones(2), np.array([lower, -none]), np.array([none, upper])


ONE, TWO = np.ones((1, 1), bool), np.ones((2, 1), bool)


def test_an_infeasible_problem_is_a_status_and_the_next_one_is_solved() -> None:
    solver = DaqpSolver(ONE, TWO, QpParams())
    assert solver.solve(*one_variable(-2.0, 2.0)).exact
    infeasible = solver.solve(*one_variable(3.0, 2.0))
    assert (infeasible.x, infeasible.exact, infeasible.status) == (None, False, "infeasible")
    after = solver.solve(*one_variable(1.5, 2.0))
    assert after.exact and after.x is not None
    assert after.x[0] == pytest.approx(1.5)


@pytest.mark.parametrize("which", range(5))
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_and_does_no_harm(which: int, bad: float) -> None:
    solver = DaqpSolver(ONE, TWO, QpParams())
    good = one_variable(-2.0, 2.0)
    poisoned = tuple(v.copy() for v in good)
    poisoned[which][0] = bad
    refused = solver.solve(*poisoned)
    assert (refused.x, refused.exact, refused.status) == (None, False, "not finite")
    after = solver.solve(*good)
    assert after.x is not None and after.x[0] == pytest.approx(1.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_bad_number_anywhere_is_found(bad: float) -> None:
    good = np.array([0.0, -INFINITY, INFINITY, 1e200])
    assert is_finite(good, np.zeros(0))
    for i in range(4):
        poisoned = good.copy()
        poisoned[i] = bad
        assert not is_finite(good, poisoned)
    assert not is_finite(np.array([np.inf, -np.inf]))


def test_arrays_may_be_reused_by_the_caller() -> None:
    solver = DaqpSolver(ONE, TWO, QpParams())
    problem = one_variable(-2.0, 2.0)
    first = solver.solve(*problem)
    problem[3][0] = 1.5
    second = solver.solve(*problem)
    assert first.x is not None and second.x is not None
    assert (first.x[0], second.x[0]) == (pytest.approx(1.0), pytest.approx(1.5))


def test_the_iteration_limit_is_kept() -> None:
    rng = np.random.default_rng(2)
    p, a = patterns(30, 120, rng)
    problem = values(p, a, rng)
    needed = DaqpSolver(p, a, QpParams()).solve(*problem).iterations
    assert needed > 10
    stopped = DaqpSolver(p, a, QpParams(max_iterations=10)).solve(*problem)
    assert (stopped.x, stopped.exact, stopped.status) == (None, False, "iteration limit")


def test_a_hessian_singular_in_floating_point_is_no_failure() -> None:
    p, a = np.ones((2, 2), bool), np.eye(2, dtype=bool)
    hessian = np.array([1.0, 1.0, 1.0 + 1e-17])  # upper triangle, column-major: rank one
    bounds = np.ones(2)
    solution = DaqpSolver(p, a, QpParams()).solve(hessian, -bounds, bounds, -bounds, bounds)
    assert solution.exact and solution.x is not None
    assert solution.x.sum() == pytest.approx(1.0, abs=1e-3)


def test_every_name_that_can_be_configured_has_a_solver() -> None:
    choices = get_args(QpParams.model_fields["solver"].annotation)
    assert [*choices] == ["auto", *SOLVERS]
    assert [*SOLVERS] == [*MAKERS]


def test_daqp_is_the_default_and_osqp_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert load(None).rules().solver_name == QpParams().solver_name == "daqp"
    assert isinstance(make_solver(ONE, TWO, QpParams()), DaqpSolver)
    monkeypatch.setitem(sys.modules, "daqp", None)
    assert load(None).rules().solver_name == QpParams().solver_name == "osqp"
    assert isinstance(make_solver(ONE, TWO, QpParams()), OsqpSolver)


def test_an_unknown_solver_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"qp\.solver = 'quadprog'.*'auto', 'osqp' or 'daqp'"):
        load(None, ["controller.mpc.qp.solver='quadprog'"])


def test_daqp_without_its_package_is_refused_with_the_config(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "daqp", None)
    with pytest.raises(ConfigError, match=r"controller\.mpc\.qp\.solver = 'daqp'.*pip install 'daqp'"):
        load(None, ["controller.mpc.qp.solver='daqp'"])
    load(None)


def test_daqp_is_imported_only_when_asked_for() -> None:
    code = "import sys, swarmctl.config as c; c.load(None); sys.exit('daqp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
