"""The bench measures a real agent among plausible neighbours, and one problem for all solvers."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy import optimize

from sitl.studies.bench import bench, bus_over_hosts, command, formation, scale, ticks
from sitl.studies.bench.captured import Captured, capture, circle_with_obstacle, measure_xy, tapped
from sitl.studies.bench.formation import Formation, Neighbours, formation_config, places_m
from sitl.studies.bench.slsqp import KEPT_M, NonlinearXy
from swarmctl.agent.mission import start_conditions
from swarmctl.control.estimation import accuracy
from swarmctl.control.failsafe.overload import Readiness
from swarmctl.core.types import Array, PlanStatus
from swarmctl.errors import MissionError, StartError

SPEED_M_S = formation.RADIUS_M * formation.OMEGA_RAD_S


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without waiting until estimates and processors are steady or the agent has caught up, and as short as asked."""
    monkeypatch.setattr(accuracy, "_WINDOW_US", 0)
    monkeypatch.setattr(start_conditions, "_APART_FOR_US", 0)
    monkeypatch.setattr(Readiness, "unmet", lambda *_: "")
    monkeypatch.setattr(ticks, "_WARM_UP_S", 0.1)
    monkeypatch.setattr(scale, "_SETTLE_STEPS", 5)
    monkeypatch.setattr(scale, "_LEAST_S", 0.4)
    monkeypatch.setattr(scale, "_HOSTS_S", 0.5)
    monkeypatch.setattr(bus_over_hosts, "_SETTLES_S", 0.5)


@pytest.fixture(scope="module")
def captured() -> Captured:
    """The problems of a whole flight."""
    return capture(circle_with_obstacle())


@pytest.mark.usefixtures("quick")
def test_parts_of_a_tick_among_paths_add_up_to_it() -> None:
    parts = ticks.measure_ticks(2, ["osqp"], 10)["osqp"]
    assert parts.shape == (10, len(ticks.PARTS))
    np.testing.assert_allclose(parts[:, :-1].sum(axis=1), parts[:, -1], atol=1e-6)


@pytest.mark.usefixtures("quick")
def test_parts_of_a_tick_of_a_swap_add_up_to_it() -> None:
    measured = ticks.measure_swaps(2, ["osqp"], 10)
    for mode, guaranteed in (("swap", False), ("guaranteed", True)):
        parts = measured[mode]["osqp"]
        assert parts.shape == (10, len(ticks.PARTS))
        commitment = ticks.PARTS.index("commitment")
        assert (np.delete(parts, commitment, axis=1) > 0.0).all()
        assert (parts[:, commitment] > 0.0).all() == guaranteed
        np.testing.assert_allclose(parts[:, :-1].sum(axis=1), parts[:, -1], atol=1e-6)


@pytest.mark.usefixtures("quick")
def test_a_tick_without_a_plan_is_no_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Formation, "planned", property(lambda self: False))
    with pytest.raises(MissionError, match="daqp with 1 neighbours: a tick without a plan"):
        ticks.measure_ticks(1, ["daqp"], 3)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--neighbours", "2,x"],
        ["--neighbours", "-1"],
        ["--neighbours", "100"],
        ["--ticks", "0"],
        ["--solver", "qp"],
        ["--agents", "1", "--scale"],
        ["--agents", "101", "--scale"],
        ["--hosts", "1,2"],
        ["--hosts", "13", "--scale"],
        ["--agents", "3"],
        ["--scale", "--no-slsqp"],
        ["--scale", "--solver", "osqp", "--solver", "daqp"],
    ],
)
def test_bad_usage_is_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        command.main(arguments)
    assert caught.value.code == 2
    assert arguments[0] in capsys.readouterr().err


def test_a_solver_that_is_not_installed_is_left_out_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert bench.chosen_solvers([]) == (["osqp", "daqp"], "")
    monkeypatch.setitem(sys.modules, "daqp", None)
    solvers, left_out = bench.chosen_solvers([])
    assert solvers == ["osqp"]
    assert "daqp is left out" in left_out and "pip install 'daqp'" in left_out
    assert bench.chosen_solvers(["daqp", "daqp"]) == (["daqp"], ""), "what is asked for by name is refused, not dropped"


def test_without_daqp_the_problems_are_timed_with_osqp(captured: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "daqp", None)
    few = Captured(captured.config, captured.problems[:22], captured.tick_ms[:22])
    assert list(measure_xy(few, slsqp=False).qp_ms) == ["osqp"]


def test_a_folder_that_cannot_be_made_is_an_error_in_words(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StartError, match="--out"):
        bench.write([], tmp_path / "file")


def test_a_busy_machine_is_said() -> None:
    assert bench.busy_note(0.1, 2) == ""
    assert "load 2.3 on 2 processors" in bench.busy_note(2.3, 2)


@pytest.mark.parametrize("count", [2, 3, 9, 31])
def test_places_are_as_close_as_vehicles_may_be_and_no_closer(count: int) -> None:
    places = places_m(count)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)[~np.eye(count, dtype=bool)]
    assert apart.min() == pytest.approx(formation.SPACING_M)
    np.testing.assert_allclose(places.mean(axis=0), 0.0, atol=1e-9)
    assert places[0, 1] == places[:, 1].min()
    assert np.linalg.norm(places, axis=1).max() < 0.8 * np.sqrt(count) * formation.SPACING_M, "a crowd, not a line"


def test_neighbours_move_as_vehicles_could() -> None:
    t_s = np.arange(0.0, 20.0, 0.02)
    paths = Neighbours(places_m(31)[1:], 1).positions_ned_m(t_s)
    assert paths.shape == (30, len(t_s), 3)
    speed = np.linalg.norm(np.diff(paths, axis=1), axis=2) / 0.02
    accel = np.linalg.norm(np.diff(paths, n=2, axis=1), axis=2) / 0.02**2
    assert speed.min() > 0.3 * SPEED_M_S and speed.max() < 1.8 * SPEED_M_S
    assert accel.max() < 3.0  # what the bounded tilt allows on each axis and both together
    apart = np.linalg.norm(paths[:, None] - paths[None], axis=3)[~np.eye(30, dtype=bool)]
    assert apart.min() > 0.85


@pytest.mark.parametrize(("neighbours", "pillar"), [(2, False), (2, True), (30, False)])
def test_the_agent_flies_pressed_against_its_neighbours(neighbours: int, pillar: bool) -> None:
    flown = Formation(formation_config("daqp", neighbours, pillar))
    while flown.mission_t_s < 4.5:
        flown.step()
    for _ in range(40):
        flown.step()
        assert flown.planned
        assert flown.record.peers == neighbours
        assert 0.88 < flown.record.nearest_peer_m < 0.95, "at the distance that is kept: active constraints"
        if pillar:
            assert 5.15 < flown.record.nearest_obstacle_m < 5.3
    assert flown.record.state is not None
    assert float(np.linalg.norm(flown.record.state.vel_ned_m_s)) == pytest.approx(SPEED_M_S, rel=0.6)


def test_captured_problems_have_two_neighbours_and_an_obstacle(captured: Captured) -> None:
    assert len(captured.problems) == len(captured.tick_ms) == 240
    for problem in captured.problems:
        assert [k.priority_id for k in problem.keep_outs].count(-1) == 1
        assert len(problem.keep_outs) == 3
    assert (captured.tick_ms > 0.0).all()


def moves_of(nonlinear: NonlinearXy, u: Array) -> Array:
    """Return the increments (2 Hc,) from the held input to inputs (>= Hc, 2)."""
    moves: Array = np.diff(u[: nonlinear._hc], axis=0, prepend=nonlinear._u_prev[None]).T.ravel()
    return moves


def nonlinear_series(captured: Captured, every: int) -> list[tuple[NonlinearXy, Array, Array]]:
    """The nonlinear problem, the increments of its QP's exact answer and the x-y plan (Hp, 2) made of them."""
    mpc, series = tapped(captured.config, "daqp"), []
    for problem in captured.problems[::every]:
        plan = mpc.plan(problem)
        nonlinear = mpc.nonlinear(problem, plan)
        series.append((nonlinear, moves_of(nonlinear, plan.virtual_control[:, :2]), plan.pos_ned_m[1:, :2]))
    return series


def test_the_nonlinear_problem_moves_as_the_controller_predicts(captured: Captured) -> None:
    for nonlinear, moves, planned in nonlinear_series(captured, 20):
        pos_m = (nonlinear._free_m + nonlinear._push @ moves).reshape(2, -1).T  # (Hp, 2)
        np.testing.assert_allclose(pos_m, planned, atol=1e-9)


def test_its_cost_is_the_thesis_cost(captured: Captured) -> None:
    mpc, weights = tapped(captured.config, "daqp"), captured.config.controller.mpc.x
    for problem in captured.problems[::40]:
        plan = mpc.plan(problem)
        nonlinear = mpc.nonlinear(problem, plan)
        moves = moves_of(nonlinear, plan.virtual_control[:, :2])
        error = problem.reference.pos_ned_m[1:41, :2] - plan.pos_ned_m[1:, :2]
        vel_error = problem.reference.vel_ned_m_s[1:41, :2] - plan.vel_ned_m_s[1:, :2]
        terms = ((weights.q_pos, error), (weights.q_vel, vel_error), (weights.r, moves))
        assert nonlinear.cost(moves) == pytest.approx(sum(w * (e**2).sum() for w, e in terms), rel=1e-9)


def test_the_gradients_given_to_slsqp_are_right(captured: Captured) -> None:
    rng = np.random.default_rng(3)
    for nonlinear, moves, _ in nonlinear_series(captured, 40):
        at = moves + 0.005 * rng.normal(size=len(moves))
        differences = optimize.approx_fprime(at, nonlinear.margins_m, 1e-8)
        np.testing.assert_allclose(nonlinear.margin_gradients(at), differences, atol=1e-4)
        cost, slope = nonlinear.cost_and_gradient(at)
        assert cost == nonlinear.cost(at)
        np.testing.assert_allclose(slope, optimize.approx_fprime(at, nonlinear.cost, 1e-6), rtol=1e-3, atol=0.1)


def test_slsqp_keeps_distances_and_bounds_hard_or_says_so(captured: Captured) -> None:
    params, solved = captured.config.controller.mpc, 0
    for nonlinear, _, _ in nonlinear_series(captured, 8):
        answer = nonlinear.solve()
        assert answer.shortfall_m == nonlinear.shortfall_m(answer.moves)
        if not answer.solved:
            continue
        solved += 1
        assert answer.shortfall_m < 10 * KEPT_M  # SLSQP stops on the cost
        assert (np.abs(answer.moves) < params.du_max + 1e-9).all()
        u = nonlinear.inputs(answer.moves)
        assert (np.abs(u) < params.u_max + 10 * KEPT_M).all()
    assert solved >= 10  # of thirty; some flights ask where the distance is lost already


def test_slsqp_does_not_call_solved_what_has_no_solution(captured: Captured) -> None:
    mpc, problem = tapped(captured.config, "daqp"), captured.problems[40]
    plan = mpc.plan(problem)
    far = replace(problem, keep_outs=tuple(replace(k, radius_m=4.0) for k in problem.keep_outs))
    answer = mpc.nonlinear(far, plan).solve()
    assert not answer.solved
    assert answer.shortfall_m > 1.0


def test_slsqp_costs_no_more_than_a_qp_answer_that_keeps_them_too(captured: Captured) -> None:
    compared = 0
    for nonlinear, moves, _ in nonlinear_series(captured, 3):
        if nonlinear.shortfall_m(moves) < 1e-9:  # not so where half-spaces look at some steps only
            answer = nonlinear.solve(moves)
            assert answer.cost <= nonlinear.cost(moves) + 1e-3
            compared += 1
    assert compared >= 20


def test_an_optimum_found_with_gradients_is_one_for_finite_differences_too(captured: Captured) -> None:
    """Started at it: from anywhere else the two may end in different valleys, for the problem is not convex."""
    dearer = []
    for nonlinear, moves, _ in nonlinear_series(captured, 20):
        found = nonlinear.solve(moves, gradients=True)
        again = nonlinear.solve(found.moves)
        if found.solved and again.solved:
            dearer.append(again.cost / found.cost - 1.0)
    assert len(dearer) >= 5
    assert max(dearer) < 1e-4
    assert abs(float(np.median(dearer))) < 1e-6


def test_an_answer_is_shifted_by_one_step(captured: Captured) -> None:
    nonlinear = nonlinear_series(captured, 239)[0][0]
    moves = np.arange(12.0)
    np.testing.assert_array_equal(nonlinear.shifted(moves), [1, 2, 3, 4, 5, 0, 7, 8, 9, 10, 11, 0])
    np.testing.assert_array_equal(moves, np.arange(12.0))


def test_both_qp_solvers_agree_on_captured_problems(captured: Captured) -> None:
    exact, first_order = tapped(captured.config, "daqp"), tapped(captured.config, "osqp")
    apart_m = []
    for problem in captured.problems:
        one, other = exact.plan(problem), first_order.plan(problem)
        apart_m.append(np.abs(one.pos_ned_m - other.pos_ned_m).max())
        assert one.status is not PlanStatus.SOLVER_FAILED
    assert np.median(apart_m) < 0.003  # over the whole horizon
    assert np.quantile(apart_m, 0.95) < 0.02


def test_the_qp_is_much_faster_than_the_nonlinear_problem(captured: Captured) -> None:
    few = Captured(captured.config, captured.problems[80:140], captured.tick_ms[80:140])
    times = measure_xy(few)
    assert times.problems == 40
    fmincon, gradients = times.fmincon, times.gradients
    assert fmincon is not None and gradients is not None
    assert 0.0 < fmincon.solved_01 <= 1.0
    assert fmincon.kept.mean() > 0.5 and gradients.kept.mean() > 0.5
    assert times.speed_up() > 3.0  # measured 11
    assert times.speed_up("daqp") > 10.0  # measured 60
    assert times.speed_up("daqp", gradients=True) > 5.0
    assert fmincon.times.p50_ms > times.qp("osqp").p50_ms
    alone = measure_xy(few, ["osqp"], slsqp=False)
    assert alone.fmincon is None and np.isnan(alone.speed_up())


def test_the_tables_fit_80_columns_with_their_units() -> None:
    cases = [
        (suffix, solver, count) for suffix in ("", ", guaranteed") for solver in ("osqp", "daqp") for count in (0, 30)
    ]
    rows = [
        bench.BenchRow(name=part + suffix, solver=solver, neighbours=count, p50_ms=12.34, p99_ms=1234.56)
        for suffix, solver, count in cases
        for part in ticks.PARTS
    ]
    shown = io.StringIO()
    bench.show(rows, Console(file=shown, width=80))
    assert "\u2026" not in shown.getvalue(), "nothing is cut"
    assert shown.getvalue().count("12.34 (1234.56)") == len(rows)
    assert shown.getvalue().count("[ms]") == 2


@pytest.mark.parametrize("exponent", [0.0, 0.7, 1.0])
def test_the_exponent_of_a_power_is_found_whatever_zero_and_one_cost(exponent: float) -> None:
    counts = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0])
    costs = 3.0 * np.maximum(counts, 1.0) ** exponent
    costs[:2] = 100.0
    assert scale.fitted_power(counts, costs) == pytest.approx((3.0, exponent), abs=1e-9)
    assert np.isnan(scale.fitted_power(counts[:3], costs[:3])).all(), "two counts are needed"


@pytest.mark.usefixtures("quick")
def test_growth_is_measured_written_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    counts = ("--neighbours", "2,4", "--agents", "2,4", "--hosts", "2,3", "--ticks", "8")
    code = command.main(["--scale", *counts, "--out", str(tmp_path)])
    assert code == 0
    rows = json.loads((tmp_path / "scale.json").read_text())
    assert [(row["question"], row["count"]) for row in rows] == [
        *(("neighbours", count) for count in (2, 4)),
        *(("agents", count) for count in (2, 4)),
        *(("agents in groups", count) for count in (2, 4)),
        *(("hosts", count) for count in (2, 3)),
    ]
    assert all(0.0 < row["tick_p50_ms"] <= row["tick_p99_ms"] for row in rows[:6])
    assert all(row["real_time_per_core"] > 0.0 for row in rows[2:])
    assert all(row["bytes_per_agent_s"] > 1000.0 for row in rows[2:6])
    assert all(0.0 < row["path_age_p50_ms"] <= row["path_age_p99_ms"] for row in rows[6:])
    whole = 11 * (50 * 534 + 5 * 753)  # bytes of paths and statuses of all others
    assert [row["heard_bytes_per_agent_s"] for row in rows[6:]] == pytest.approx([whole, whole], rel=0.3)
    said = capsys.readouterr().out
    assert said.count("exponent") == 12 and "scale.html" in said
    assert (tmp_path / "scale.html").read_text().count("<figure>") == 12


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "bench", lambda *_, **__: pytest.fail("measured"))
    (tmp_path / "file").touch()
    assert command.main(["--out", str(tmp_path / "file" / "folder")]) == 3
    assert "can't be written: Not a directory. Choose another with --out" in capsys.readouterr().err


def test_growth_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StartError, match="can't be written"):
        scale.write([], tmp_path / "file")
