"""Every block of constraints says in rows what it promises in words, and a new block needs no other module."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, Axis, Faces, HalfSpaces, Horizon, Penalties, Terminal
from swarmctl.control.mpc.condensed_qp.constraints import (
    IncrementBounds,
    InputBounds,
    KeepOutHalfSpaces,
    TerminalConditions,
    VolumeFaces,
    slack_m,
)
from swarmctl.control.mpc.condensed_qp.prediction import Forecast, Prediction
from swarmctl.control.mpc.condensed_qp.program import ConstraintBlock, Program, Rows
from swarmctl.control.mpc.condensed_qp.session import Relaxation, SolverSession
from swarmctl.control.mpc.condensed_qp.tracking_cost import TrackingCost
from swarmctl.control.mpc.solvers.qp import INFINITY, QpParams, QpSolution
from swarmctl.core.types import Array

AXIS = Axis(
    q_pos=1.5, q_vel=0.5, r=0.01, u_min=-0.2, u_max=0.15, du_max=0.05, u_rest=0.0, gain_m_s2=9.81, terminal="none"
)
HORIZON = Horizon(control=6, prediction=40, dt_s=0.02, euler=False)
EXACT = QpParams(eps=1e-8, eps_relative=1e-8, max_iterations=20_000)
U_PREV = np.array([0.12, -0.03])


def prediction(terminal_x: Terminal = "none", terminal_y: Terminal = "none") -> Prediction:
    axes = tuple(replace(AXIS, terminal=terminal) for terminal in (terminal_x, terminal_y))
    return Prediction(axes, HORIZON)


def forecast(ahead: Prediction, spaces: HalfSpaces | None = None, ref_m: float = 0.3, east_m: float = -0.2) -> Forecast:
    steps = HORIZON.prediction
    asked = AxesProblem(
        pos_m=np.array([0.1, east_m]),
        vel_m_s=np.array([0.5, 0.1]),
        u_prev=U_PREV,
        gain_m_s2=np.full((steps, 2), -9.81),
        drift_m_s2=np.array([0.2, 0.0]),
        ref_pos_m=np.full((steps, 2), ref_m),
        ref_vel_m_s=np.zeros((steps, 2)),
    )
    return ahead.forecast(asked, spaces)


def filled(ahead: Prediction, block: ConstraintBlock, step: Forecast) -> Rows:
    program = Program(TrackingCost(ahead).pattern(), (block,))
    program.fill(step)
    return program.rows[block]


def flown(ahead: Prediction, step: Forecast, moves: Array) -> Array:
    """Positions and velocities (2, Hp, 2) under scaled increments (moves,)."""
    increments = (moves.reshape(2, HORIZON.control) * ahead.du_max).T  # (Hc, 2)
    accel = -9.81 * (step.u_prev + ahead.hold @ increments) + step.asked.drift_m_s2
    return ahead.motion(step.asked.pos_m, step.asked.vel_m_s, accel)


def some_moves(seed: int) -> Array:
    return np.random.default_rng([12, seed]).uniform(-1.0, 1.0, 2 * HORIZON.control)


def test_increments_are_bounded_by_one() -> None:
    ahead = prediction()
    rows = filled(ahead, IncrementBounds(ahead), forecast(ahead))
    moves = some_moves(0)
    np.testing.assert_array_equal(rows.moves @ moves, moves)
    assert (rows.lower == -1.0).all()
    assert (rows.upper == 1.0).all()


@pytest.mark.parametrize("seed", range(5))
def test_rows_of_inputs_hold_exactly_where_inputs_are_in_their_bounds(seed: int) -> None:
    ahead = prediction()
    rows, moves = filled(ahead, InputBounds(ahead), forecast(ahead)), some_moves(seed)
    u = U_PREV + np.cumsum((moves.reshape(2, -1) * ahead.du_max).T, axis=0)  # (Hc, 2)
    value = rows.moves @ moves
    np.testing.assert_array_equal((value >= rows.lower) & (value <= rows.upper), ((u >= -0.2) & (u <= 0.15)).T.ravel())


def test_terminal_rows_ask_for_the_end_until_they_are_softened_and_again_at_the_next_step() -> None:
    ahead = prediction("position_velocity", "position")
    block = TerminalConditions(ahead, Penalties(), 1.0)
    step, moves = forecast(ahead, ref_m=0.45, east_m=-0.6), some_moves(3)
    program = Program(TrackingCost(ahead).pattern(), (block,))
    program.fill(step)
    rows = program.rows[block]
    pos, vel = flown(ahead, step, moves)
    gaps = np.array([pos[-1, 0] - 0.45, pos[-1, 1] - 0.45, vel[-1, 0]])  # positions first
    wanted = rows.moves[::2] @ moves - gaps
    np.testing.assert_allclose(block.gap(rows, step, moves), np.abs(gaps).max(), atol=1e-12)
    np.testing.assert_array_equal(rows.lower, rows.upper)
    reached = np.isclose(rows.lower[::2], wanted)
    assert reached[0]
    assert not reached[1], "1.05 m east in 0.8 s is out of reach, so that another end is asked for"
    assert (rows.slack_max == 0.0).all()

    block.soften(rows, block.velocities)
    assert (rows.upper[4], rows.lower[5]) == (INFINITY, -INFINITY)
    np.testing.assert_array_equal(rows.slack_max, [0.0, 0.0, INFINITY])
    np.testing.assert_array_equal(rows.lower[:4], rows.upper[:4])
    block.give_up(rows)
    assert (rows.slack_max == INFINITY).all()
    assert (rows.slack_slope == 0.0).all()
    program.fill(step)
    np.testing.assert_array_equal(rows.lower, rows.upper)
    assert (rows.slack_max == 0.0).all()
    assert (rows.slack_slope > 0.0).all()


def spaces(offset_m: float) -> HalfSpaces:
    """One family: south-west of a line at 45 degrees, at every step."""
    normal = np.tile(-np.sqrt(0.5) * np.ones(2), (1, HORIZON.prediction, 1))
    return HalfSpaces(
        normal=normal,
        offset_m=np.full((1, HORIZON.prediction), offset_m),
        stop_s=np.array([0.3]),
        stop_offset_m=np.array([offset_m]),
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_residual_of_half_spaces_is_the_depth_in_metres(seed: int) -> None:
    ahead, moves = prediction(), some_moves(seed)
    block = KeepOutHalfSpaces(ahead, 2, 1.0, Penalties(), cost_scale=1.0)
    step = forecast(ahead, spaces(0.05))
    pos, vel = flown(ahead, step, moves)
    along = np.append((pos @ (-np.sqrt(0.5) * np.ones(2)))[ahead.checked], 0.0)
    along[-1] = (pos[-1] + 0.3 * vel[-1]) @ (-np.sqrt(0.5) * np.ones(2))
    depth_m = float((0.05 - along).max())
    program = Program(TrackingCost(ahead).pattern(), (block,))
    program.fill(step)
    without_slack = np.concatenate([moves, np.zeros(2)])
    assert depth_m > 0.1
    relaxed = program.rows[block].lower.max() < 0.0  # whether rows ask for less, since no increments reach it
    assert relaxed or program.residual_m(without_slack) == pytest.approx(depth_m, abs=1e-9)
    given_way = np.concatenate([moves, [depth_m / 0.1, 0.0]])  # slacks are in units of 0.1 m
    assert program.residual_m(given_way) == pytest.approx(0.0, abs=1e-9)
    assert slack_m(program.rows[block], QpSolution(x=given_way, exact=True, status="", iterations=1)) == (
        pytest.approx(depth_m)
    )
    program.fill(forecast(ahead))
    assert (program.rows[block].lower == -INFINITY).all()
    assert program.residual_m(without_slack) == 0.0


class EndVelocity(ConstraintBlock):
    """Bounds the velocity of every axis at the end of the horizon: all that a new constraint takes."""

    def __init__(self, ahead: Prediction, most_m_s: float) -> None:
        self._ahead, self._most_m_s = ahead, most_m_s
        super().__init__(np.kron(np.eye(len(ahead.axes)), np.ones(ahead.horizon.control)).astype(bool))

    def fill(self, rows: Rows, forecast: Forecast) -> None:
        for i, axis in enumerate(self._ahead.axes):
            rows.moves[i, self._ahead.columns(i)] = axis.du_max * forecast.vel_response[i, -1]
        rows.lower[:] = -self._most_m_s - forecast.free_vel_m_s[-1]
        rows.upper[:] = self._most_m_s - forecast.free_vel_m_s[-1]

    def residual_m(self, rows: Rows, flown: Array) -> float:
        value = rows.coefficients @ flown
        return float(np.maximum(value - rows.upper, rows.lower - value).max(initial=0.0))


def solved(ahead: Prediction, step: Forecast, *more: ConstraintBlock) -> tuple[Program, Array]:
    cost = TrackingCost(ahead)
    half_spaces = KeepOutHalfSpaces(ahead, 1, 1.0, Penalties(), cost_scale=cost.scale)
    program = Program(cost.pattern(), (IncrementBounds(ahead), InputBounds(ahead), half_spaces, *more))
    cost.fill(program.hessian, program.slope, step)
    program.fill(step)
    solution, _ = SolverSession(program, (), EXACT, lambda: 0).solve()
    assert solution.x is not None
    return program, solution.x


def test_a_new_block_is_obeyed_and_judged() -> None:
    ahead = prediction()
    step = forecast(ahead, ref_m=3.0)
    _, free = solved(ahead, step)
    bound = EndVelocity(ahead, 0.4)
    program, kept = solved(ahead, step, bound)
    moves = 2 * HORIZON.control
    assert np.abs(flown(ahead, step, free[:moves])[1][-1]).max() > 0.5  # the negative control
    assert np.abs(flown(ahead, step, kept[:moves])[1][-1]).max() == pytest.approx(0.4, abs=1e-4)
    assert program.residual_m(kept) < 1e-4
    assert program.residual_m(free) > 0.1


def test_rows_are_those_without_slacks_then_bounds_of_slacks_then_those_with_slacks() -> None:
    ahead = prediction("position", "position")
    ends, last = TerminalConditions(ahead, Penalties(), 1.0), EndVelocity(ahead, 1.0)
    program = Program(TrackingCost(ahead).pattern(), (ends, IncrementBounds(ahead), last))
    moves = 2 * HORIZON.control
    assert program.pattern.shape == (moves + 2 + 2 + 4, moves + 2)
    np.testing.assert_array_equal(program.pattern[:moves, :moves], np.eye(moves, dtype=bool))
    np.testing.assert_array_equal(program.pattern[moves + 2 : moves + 4, moves:], np.eye(2, dtype=bool))
    np.testing.assert_array_equal(program.lower[moves + 2 : moves + 4], 0.0)
    assert np.shares_memory(program.rows[ends].moves, program.coefficients[moves + 4 :])


@pytest.mark.parametrize("seed", range(5))
def test_rows_of_a_face_are_violated_by_how_far_a_plan_or_its_stop_is_outside(seed: int) -> None:
    """The face is that far away that no increments can be asked for more than they can reach."""
    ahead, normals = prediction(), np.array([[0.8, -0.6]])
    step, moves = forecast(ahead), some_moves(seed)
    pos, vel = flown(ahead, step, moves)
    inside, towards, brake_m_s2 = pos @ normals[0], np.maximum(0.0, -vel[-1] @ normals[0]), 1.5
    stop_m = float(inside[-1] - towards**2 / (2.0 * brake_m_s2))
    offset_m = min(float(inside.min()), stop_m) + 0.02
    block = VolumeFaces(
        ahead,
        Faces(normals=normals, offsets_m=np.array([offset_m]), brakes_m_s2=np.array([brake_m_s2])),
        Penalties(),
        cost_scale=1.0,
    )
    rows = filled(ahead, block, step)
    depth_m = block.residual_m(rows, np.append(moves, 0.0))
    assert 0.02 - 0.06 <= depth_m - max(0.0, offset_m - stop_m) <= 0.02, "tangents miss less than their gap"
    assert block.residual_m(rows, np.append(moves, 1.0)) == 0.0, "one unit of slack is 0.1 m"


def test_faces_out_of_reach_are_disabled() -> None:
    ahead = prediction()
    far = Faces(normals=np.array([[1.0, 0.0]]), offsets_m=np.array([-50.0]), brakes_m_s2=np.array([1.5]))
    rows = filled(ahead, VolumeFaces(ahead, far, Penalties(), cost_scale=1.0), forecast(ahead))
    assert (rows.lower == -INFINITY).all()


def test_a_session_relaxes_in_order_and_only_what_is_needed() -> None:
    ahead = prediction()
    step, applied = forecast(ahead), list[str]()
    cost = TrackingCost(ahead)
    program = Program(cost.pattern(), (IncrementBounds(ahead), EndVelocity(ahead, 1e-6)))
    cost.fill(program.hessian, program.slope, step)
    program.fill(step)
    program.lower[-2:], program.upper[-2:] = 50.0, 60.0  # no increments reach it

    def release() -> None:
        applied.append("release")
        program.lower[-2:] = -INFINITY

    relaxations = (
        Relaxation(lambda found: found.exact, lambda: applied.append("unneeded")),
        Relaxation(lambda found: not found.exact, release),
        Relaxation(lambda found: not found.exact, lambda: applied.append("late")),
    )
    solution, took_us = SolverSession(program, relaxations, EXACT, lambda: 0).solve()
    assert solution.exact
    assert applied == ["release"]
    assert took_us == 0.0
