"""The terminal region by its docstring's own claims, proven numerically, and the MPC that ends in it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, AxesSolution, Axis, Horizon, Penalties
from swarmctl.control.mpc.condensed_qp.condensed import CondensedMpc
from swarmctl.control.mpc.condensed_qp.terminal import TerminalRegion, terminal_region, transition
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.core.types import Array

EXACT = QpParams(solver="daqp")
DT_S = 0.02
GAIN = -9.81
LATERAL = Axis(
    q_pos=1.5, q_vel=0.5, r=0.01, u_min=-0.2, u_max=0.2, du_max=0.05, u_rest=0.0, gain_m_s2=9.81, terminal="region"
)
VERTICAL = Axis(
    q_pos=2.0, q_vel=0.05, r=0.01, u_min=0.0, u_max=20.0, du_max=5.0, u_rest=9.81, gain_m_s2=1.0, terminal="region"
)
WIDE = replace(LATERAL, u_min=-50.0, u_max=50.0, du_max=50.0)  # no bound is ever active
Weights = tuple[float, float, float, float, float, float]
CASES: dict[str, Weights] = {  # q_pos, q_vel, r, largest acceleration and increment [m/s2], step [s]
    "lateral": (1.5, 0.5, 0.01 / 9.81**2, 1.962, 0.4905, 0.02),  # its increments are what limits the region
    "vertical": (2.0, 0.05, 0.01, 9.81, 5.0, 0.02),  # its acceleration is
    "slow": (1.0, 0.0, 3.0, 2.0, 0.5, 0.1),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Weights:
    return CASES[request.param]


def region_of_case(case: Weights) -> TerminalRegion:
    return terminal_region(*case[:4], daccel_max_m_s2=case[4], dt_s=case[5])


def move(error: Array, increment: float, dt_s: float) -> Array:
    """One step of position, velocity and acceleration under an acceleration held over it; by hand."""
    pos, vel, accel = (float(x) for x in error)
    accel += increment
    return np.array([pos + dt_s * vel + 0.5 * dt_s * dt_s * accel, vel + dt_s * accel, accel])


def value(region: TerminalRegion, error: Array) -> float:
    return float(error @ region.cost_to_go @ error)


def boundary(region: TerminalRegion, count: int, seed: int) -> Array:
    """States (count, 3) with V = alpha, evenly all around the ellipsoid."""
    sphere = np.random.default_rng([seed, 0, 7]).normal(size=(count, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    return np.asarray(math.sqrt(region.level) * np.linalg.solve(np.linalg.cholesky(region.cost_to_go).T, sphere.T).T)


# -- the derivation ---------------------------------------------------------------------------------------------------


def test_the_error_model_is_the_motion_under_a_held_acceleration() -> None:
    a, b = transition(0.1)
    for error, increment in ((np.array([1.0, -2.0, 0.5]), 0.0), (np.array([0.3, 0.2, -4.0]), 1.5)):
        np.testing.assert_allclose(a @ error + b[:, 0] * increment, move(error, increment, 0.1), atol=1e-12)


def test_cost_to_go_solves_the_riccati_equation(case: Weights) -> None:
    q_pos, q_vel, r, _, _, dt_s = case
    region = region_of_case(case)
    p, k = region.cost_to_go, region.gain[None]
    a, b = transition(dt_s)
    scale = np.abs(p).max()
    np.testing.assert_allclose(k, (b.T @ p @ a) / (r + b.T @ p @ b), rtol=1e-7, atol=1e-9 * np.abs(k).max())
    residual = np.diag([q_pos, q_vel, 0.0]) + a.T @ p @ a - a.T @ p @ b @ k - p
    assert np.abs(residual).max() < 1e-9 * scale
    np.testing.assert_array_equal(p, p.T)
    assert np.linalg.eigvalsh(p).min() > 0.0


def test_cost_to_go_falls_by_the_stage_cost_and_is_the_sum_of_all_that_follow(case: Weights) -> None:
    q_pos, q_vel, r, _, _, dt_s = case
    region = region_of_case(case)
    error = np.array([0.3, -0.2, 0.4])
    first, total = value(region, error), 0.0
    for _ in range(3000):
        increment = -float(region.gain @ error)
        stage = q_pos * error[0] ** 2 + q_vel * error[1] ** 2 + r * increment**2
        after = move(error, increment, dt_s)
        assert value(region, after) - value(region, error) == pytest.approx(-stage, abs=1e-9 * first)
        error, total = after, total + stage
    assert total == pytest.approx(first, rel=1e-6)


def test_no_law_is_cheaper_than_the_cost_to_go(case: Weights) -> None:
    q_pos, q_vel, r, _, _, dt_s = case
    region = region_of_case(case)
    rng = np.random.default_rng([0, 0, 3])
    for _ in range(50):  # Bellman: any increment now, the best afterwards
        error = rng.normal(size=3)
        best = -float(region.gain @ error)
        for off in (-0.1, 0.1):
            increment = best + off * (1.0 + abs(best))
            stage = q_pos * error[0] ** 2 + q_vel * error[1] ** 2 + r * increment**2
            assert stage + value(region, move(error, increment, dt_s)) > value(region, error)


def test_every_state_of_the_set_keeps_the_bounds_and_the_set_is_the_largest(case: Weights) -> None:
    _, _, _, accel_max, step_max, _ = case
    region = region_of_case(case)
    states = boundary(region, 20_000, 1)
    steps, accels = np.abs(states @ region.gain) / step_max, np.abs(states[:, 2]) / accel_max
    assert max(steps.max(), accels.max()) <= 1.0 + 1e-9
    assert max(steps.max(), accels.max()) > 0.99  # one of the two touches, by sampling
    inverse = np.linalg.inv(region.cost_to_go)  # and exactly: the states that press hardest
    touching = []
    for direction, most in ((region.gain, step_max), (np.array([0.0, 0.0, 1.0]), accel_max)):
        worst = inverse @ direction * math.sqrt(region.level / float(direction @ inverse @ direction))
        assert value(region, worst) == pytest.approx(region.level)
        touching.append(abs(float(direction @ worst)) / most)
    assert max(touching) == pytest.approx(1.0, rel=1e-6)


def test_increments_limit_the_lateral_region_and_acceleration_the_vertical_one() -> None:
    lateral, vertical = region_of_case(CASES["lateral"]), region_of_case(CASES["vertical"])
    more = region_of_case((*CASES["lateral"][:4], 2 * 0.4905, 0.02))
    assert more.level == pytest.approx(4.0 * lateral.level)
    assert region_of_case((*CASES["vertical"][:4], 10.0, 0.02)).level == pytest.approx(vertical.level)
    assert region_of_case((*CASES["vertical"][:3], 4.905, 5.0, 0.02)).level == pytest.approx(vertical.level / 4.0)


def test_a_state_inside_stays_inside_within_the_bounds_and_comes_to_rest(case: Weights) -> None:
    _, _, _, accel_max, step_max, dt_s = case
    region = region_of_case(case)
    shrink = np.random.default_rng([0, 0, 8]).uniform(0.0, 1.0, (400, 1)) ** (1.0 / 3.0)
    states = np.concatenate([boundary(region, 400, 2) * shrink, boundary(region, 100, 3)])
    level = np.einsum("ni,ij,nj->n", states, region.cost_to_go, states)
    for _ in range(600):
        increments = -states @ region.gain
        assert np.abs(increments).max() <= step_max * (1.0 + 1e-9)
        accel = states[:, 2] + increments
        assert np.abs(accel).max() <= accel_max * (1.0 + 1e-9)
        pos = states[:, 0] + dt_s * states[:, 1] + 0.5 * dt_s**2 * accel
        states = np.stack([pos, states[:, 1] + dt_s * accel, accel], axis=1)
        after = np.einsum("ni,ij,nj->n", states, region.cost_to_go, states)
        assert (after <= level * (1.0 + 1e-9) + 1e-18).all()
        level = after
    assert level.max() < 1e-4 * region.level


def test_outside_is_measured_in_metres_of_position(case: Weights) -> None:
    region = region_of_case(case)
    edge_m = math.sqrt(region.level / float(region.cost_to_go[0, 0]))
    for sign in (1.0, -1.0):
        for beyond_m in (1e-4, 0.1, 7.0):
            error = np.array([sign * (edge_m + beyond_m), 0.0, 0.0])
            assert region.outside_m(error) == pytest.approx(beyond_m, rel=1e-6)
        assert region.outside_m(np.array([sign * 0.999 * edge_m, 0.0, 0.0])) == 0.0
    assert region.outside_m(np.zeros(3)) == 0.0
    for state in boundary(region, 200, 4):
        assert region.outside_m(0.999 * state) == 0.0
        assert region.outside_m(2.0 * state) == pytest.approx(edge_m)  # costs as much as twice the edge


# -- the MPC that ends in it ------------------------------------------------------------------------------------------


def mpc(axis: Axis, control: int, prediction: int, qp: QpParams) -> CondensedMpc:
    return CondensedMpc(
        (axis,),
        Horizon(control=control, prediction=prediction, dt_s=DT_S, euler=False),
        0,
        1.0,
        penalties=Penalties(),
        qp=qp,
        stopwatch_ns=lambda: 0,
    )


def region_of(axis: Axis) -> TerminalRegion:
    gain, room = axis.gain_m_s2, min(axis.u_max - axis.u_rest, axis.u_rest - axis.u_min)
    return terminal_region(
        axis.q_pos, axis.q_vel, axis.r / gain**2, gain * room, daccel_max_m_s2=gain * axis.du_max, dt_s=DT_S
    )


def solve(problem: CondensedMpc, pos: float, vel: float, u: float) -> AxesSolution:
    """Towards rest at 0; gravity acts where hovering takes an input."""
    axis, steps = problem.prediction.axes[0], problem.prediction.horizon.prediction
    gain, still = -axis.gain_m_s2, np.zeros((steps, 1))
    drift = np.array([-gain * axis.u_rest])
    return problem.solve(
        AxesProblem(
            pos_m=np.array([pos]),
            vel_m_s=np.array([vel]),
            u_prev=np.array([u]),
            gain_m_s2=still + gain,
            drift_m_s2=drift,
            ref_pos_m=still,
            ref_vel_m_s=still,
        )
    )


def first_increment(problem: CondensedMpc, error: Array) -> float:
    """Of the acceleration [m/s2]."""
    axis = problem.prediction.axes[0]
    u = axis.u_rest - float(error[2]) / axis.gain_m_s2
    return -axis.gain_m_s2 * float(solve(problem, float(error[0]), float(error[1]), u).u[0, 0] - u)


@pytest.mark.parametrize("steps", [1, 5, 40, 100])
def test_away_from_all_bounds_it_is_the_infinite_horizon_regulator_whatever_its_horizon(steps: int) -> None:
    problem, region = mpc(WIDE, steps, steps, EXACT), region_of(WIDE)
    error = np.array([0.02, -0.01, 0.05])
    for _ in range(40):
        increment = first_increment(problem, error)
        small = 1e-8 * math.sqrt(value(region, error))
        assert increment == pytest.approx(-float(region.gain @ error), rel=1e-6, abs=small)
        error = move(error, increment, DT_S)


@pytest.mark.parametrize("terminal", ["region", "none"])
def test_a_horizon_so_long_that_its_end_does_not_matter_is_the_same_regulator(
    terminal: Literal["region", "none"],
) -> None:
    problem, region = mpc(replace(WIDE, terminal=terminal), 200, 200, EXACT), region_of(WIDE)
    for error in (np.array([0.02, -0.01, 0.05]), np.array([0.0, 0.1, -0.3])):
        assert first_increment(problem, error) == pytest.approx(-float(region.gain @ error), rel=1e-5)


def test_planned_cost_falls_every_step_by_at_least_the_stage_cost() -> None:
    problem, region = mpc(VERTICAL, 40, 40, EXACT), region_of(VERTICAL)
    error, last = np.array([0.05, 0.2, -1.0]), math.inf
    for _ in range(60):
        u = 9.81 - float(error[2])
        solution = solve(problem, float(error[0]), float(error[1]), u)
        assert solution.terminal_gap_m == 0.0  # ends inside: what is claimed for
        moves = -np.diff(solution.u[:, 0], prepend=u)
        state, stages = error, []
        for increment in moves:
            stages.append(2.0 * float(state[0]) ** 2 + 0.05 * float(state[1]) ** 2 + 0.01 * float(increment) ** 2)
            state = move(state, float(increment), DT_S)
        cost = sum(stages) + value(region, state)
        assert cost <= last + 1e-9
        last = cost - stages[0]
        error = move(error, float(moves[0]), DT_S)
    assert cost < 1e-3


def settle(axis: Axis, control: int, prediction: int, start_m: float, steps: int) -> tuple[Array, Array, float]:
    """Closed loop from rest: positions, inputs, and what it has cost."""
    problem = mpc(axis, control, prediction, QpParams())
    gain, pos, vel, u, cost = -axis.gain_m_s2, start_m, 0.0, axis.u_rest, 0.0
    positions, inputs = [], [u]
    for _ in range(steps):
        u_next = float(solve(problem, pos, vel, u).u[0, 0])
        cost += axis.q_pos * pos**2 + axis.q_vel * vel**2 + axis.r * (u_next - u) ** 2
        u, accel = u_next, gain * (u_next - axis.u_rest)
        pos, vel = pos + DT_S * vel + 0.5 * DT_S**2 * accel, vel + DT_S * accel
        positions.append(pos)
        inputs.append(u)
    return np.array(positions), np.array(inputs), cost


@pytest.mark.parametrize("axis", [LATERAL, VERTICAL], ids=["lateral", "vertical"])
def test_with_a_short_horizon_it_settles_within_bounds_and_without_the_region_it_does_not(axis: Axis) -> None:
    positions, inputs, cost = settle(axis, 3, 5, 0.3, 200)
    assert np.abs(positions[-50:]).max() < 0.009  # after 3 s: within 3 % of the way
    assert positions.min() > -0.03
    assert inputs.min() >= axis.u_min - 1e-9
    assert inputs.max() <= axis.u_max + 1e-9
    assert np.abs(np.diff(inputs)).max() <= axis.du_max + 1e-9
    long, _, best = settle(axis, 30, 100, 0.3, 200)  # nothing of the region in it
    assert cost < 1.05 * best
    assert np.abs(long[-50:]).max() < 0.009
    slow, _, bare = settle(replace(axis, terminal="none"), 3, 5, 0.3, 200)
    assert bare > 1.5 * best
    late = np.flatnonzero(np.abs(slow) > 0.009)[-1] - np.flatnonzero(np.abs(positions) > 0.009)[-1]
    assert late * DT_S > 1.0


@pytest.mark.parametrize("control", [3, 6, 40])
def test_the_distance_of_the_plans_end_from_the_region_is_reported(control: int) -> None:
    problem, region = mpc(VERTICAL, control, 40, QpParams()), region_of(VERTICAL)
    for start_m in (0.01, 0.3, 5.0, -20.0):
        solution = solve(problem, start_m, 0.0, 9.81)
        accel = -(float(solution.u[-1, 0]) - 9.81)
        end = np.array([solution.pos_m[-1, 0], solution.vel_m_s[-1, 0], accel])
        assert solution.terminal_gap_m == pytest.approx(region.outside_m(end), abs=1e-9)
    assert solve(problem, 0.01, 0.0, 9.81).terminal_gap_m == 0.0
    assert solve(problem, 5.0, 0.0, 9.81).terminal_gap_m > 0.1


def test_increments_that_come_after_the_prediction_do_not_act_in_it() -> None:
    wide, narrow = (mpc(LATERAL, control, 3, EXACT) for control in (6, 3))
    for start_m in (0.3, 0.005):
        more, same = solve(wide, start_m, 0.0, 0.0), solve(narrow, start_m, 0.0, 0.0)
        np.testing.assert_allclose(more.u, same.u, atol=1e-9)
        assert more.terminal_gap_m == pytest.approx(same.terminal_gap_m)


@pytest.mark.parametrize("wind_m_s2", [0.0, 2.0, -2.0])
def test_from_where_a_plan_ends_inside_the_regulator_keeps_the_bounds_of_the_input(wind_m_s2: float) -> None:
    problem, region = mpc(VERTICAL, 1, 2, EXACT), region_of(VERTICAL)
    rest, still, ended_inside = 9.81 + wind_m_s2, np.zeros((2, 1)), 0
    for error in boundary(region, 400, 5) * 0.97:
        u = np.array([np.clip(rest - error[2], 0.0, 20.0)])
        plan = problem.solve(
            AxesProblem(
                pos_m=error[:1],
                vel_m_s=error[1:2],
                u_prev=u,
                gain_m_s2=still - 1.0,
                drift_m_s2=np.array([rest]),
                ref_pos_m=still,
                ref_vel_m_s=still,
            )
        )
        if plan.terminal_gap_m > 0.0:
            continue
        ended_inside += 1
        end = np.array([plan.pos_m[-1, 0], plan.vel_m_s[-1, 0], rest - float(plan.u[-1, 0])])
        for _ in range(50):
            end = move(end, -float(region.gain @ end), DT_S)
            assert -1e-6 <= rest - float(end[2]) <= 20.0 + 1e-6
    assert ended_inside > 100
