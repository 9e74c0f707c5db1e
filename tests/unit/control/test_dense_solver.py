"""The condensed problems have the solution that a dense solver finds for the thesis' own formulation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize

from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, HalfSpaces, Horizon
from swarmctl.control.mpc.condensed_qp.condensed import CondensedMpc
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.core.types import Array
from tests.benches.condensed_problems import AXIS, GAIN, HORIZON, mpc, simulate

FIELDS = ("normal", "offset_m", "stop_s", "stop_offset_m")


def same_gain(steps: int, axes: int) -> Array:
    """GAIN at every step of every axis."""
    return np.full((steps, axes), GAIN)


def from_rest(ref_pos_m: Array) -> AxesProblem:
    """From rest at the origin to a reference (Hp, 2) that stands still."""
    origin = np.zeros(2)
    return AxesProblem(
        pos_m=origin,
        vel_m_s=origin,
        u_prev=origin,
        gain_m_s2=same_gain(*ref_pos_m.shape),
        drift_m_s2=origin,
        ref_pos_m=ref_pos_m,
        ref_vel_m_s=np.zeros_like(ref_pos_m),
    )


def dense(
    problem: CondensedMpc,
    pos: Array,
    vel: Array,
    u_prev: Array,
    gain: Array,
    ref: Array,
    spaces: HalfSpaces | None,
    rows: NDArray[np.intp],
    starts: Sequence[int] | None = None,
) -> tuple[Array, Array, Array]:
    """Hard-constrained optimum by SLSQP on simulated motion: inputs, positions, velocities (Hp, 2).

    Inputs may change at `starts` (the first steps, where None), by as much as in the steps since the change before.
    """
    horizon, axes = problem.prediction.horizon, problem.prediction.axes
    hc, hp = horizon.control, horizon.prediction
    starts = range(hc) if starts is None else starts
    steps = [now - before for before, now in zip((-1, *starts), starts, strict=False)]

    def motion(moves: Array) -> tuple[Array, Array, Array]:
        columns = []
        for i, part in enumerate(moves.reshape(len(axes), hc)):
            u = np.full(hp, u_prev[i])
            for start, increment in zip(starts, part, strict=True):
                u[start:] += increment
            columns.append((u, *simulate(float(pos[i]), float(vel[i]), u, gain, 0.0, horizon.dt_s, horizon.euler)))
        return tuple(np.stack(c, axis=1) for c in zip(*columns, strict=True))  # type: ignore[return-value]

    def cost(moves: Array) -> float:
        _, p, v = motion(moves)
        total = 0.0
        for i, axis in enumerate(axes):
            total += axis.q_pos * float(np.sum((p[:, i] - ref[i]) ** 2)) + axis.q_vel * float(np.sum(v[:, i] ** 2))
            total += axis.r * float(np.sum(moves.reshape(len(axes), hc)[i] ** 2 / steps))
        return total

    def inside(moves: Array) -> Array:
        u, p, v = motion(moves)
        parts = [(0.2 - u[list(starts)]).ravel(), (0.2 + u[list(starts)]).ravel()]
        if spaces is not None:
            for s in range(len(spaces.normal)):
                gap = np.einsum("kc,kc->k", spaces.normal[s], p) - spaces.offset_m[s]
                parts.append(gap[rows])
                stopped = p[-1] + spaces.stop_s[s] * v[-1]
                parts.append(np.array([spaces.normal[s, -1] @ stopped - spaces.stop_offset_m[s]]))
        finite = np.concatenate(parts)
        return finite[np.isfinite(finite)]

    found = optimize.minimize(
        cost,
        np.zeros(len(axes) * hc),
        method="SLSQP",
        bounds=[(-a.du_max * taken, a.du_max * taken) for a in axes for taken in steps],
        constraints=[{"type": "ineq", "fun": inside}],
        options={"maxiter": 300, "ftol": 1e-12},
    )
    assert found.success, found.message
    return motion(found.x)


def wall(normal: tuple[float, float], offset_m: float, steps: int, stop_s: float = 0.0) -> HalfSpaces:
    unit = np.array(normal) / math.hypot(*normal)
    return HalfSpaces(
        normal=np.tile(unit, (1, steps, 1)),
        offset_m=np.full((1, steps), offset_m),
        stop_s=np.array([stop_s]),
        stop_offset_m=np.array([offset_m]),
    )


@pytest.mark.parametrize("starts", [None, (0, 1, 4, 9, 16)], ids=["first steps", "spread"])
@pytest.mark.parametrize("gain", [np.full(25, GAIN), np.linspace(-5.0, -15.0, 25)], ids=["same", "varying"])
@pytest.mark.parametrize("euler", [False, True])
@pytest.mark.parametrize(
    ("normal", "offset_m", "stop_s"),
    [
        ((-1.0, 0.0), -0.08, 0.0),  # stay south of 0.08 m while the reference is 0.5 m north
        ((-1.0, -1.0), -0.09, 0.0),  # oblique: slides along
        ((-1.0, 0.0), -0.1, 0.4),  # the stopping row decides
        ((0.0, 1.0), -5.0, 0.0),  # never active
    ],
)
def test_half_spaces_against_a_dense_solver(
    euler: bool, normal: tuple[float, float], offset_m: float, stop_s: float, gain: Array, starts: Sequence[int] | None
) -> None:
    horizon = Horizon(control=5, prediction=25, dt_s=0.02, euler=euler, spread=starts is not None)
    problem = mpc(AXIS, replace(AXIS, q_pos=1.0), horizon=horizon, max_keep_outs=2)
    pos, vel, u_prev, ref = np.array([0.0, 0.0]), np.array([0.2, 0.1]), np.array([0.01, -0.02]), np.array([0.5, 0.3])
    spaces = wall(normal, offset_m, 25, stop_s)
    tick = AxesProblem(
        pos_m=pos,
        vel_m_s=vel,
        u_prev=u_prev,
        gain_m_s2=np.stack([gain, gain], axis=1),
        drift_m_s2=np.zeros(2),
        ref_pos_m=np.tile(ref, (25, 1)),
        ref_vel_m_s=np.zeros((25, 2)),
    )
    ours = problem.solve(tick, spaces)
    u, p, _ = dense(problem, pos, vel, u_prev, gain, ref, spaces, problem.prediction.checked, starts)
    np.testing.assert_allclose(ours.pos_m, p, atol=5e-4)
    np.testing.assert_allclose(ours.u, u, atol=3e-3)
    assert ours.slack_m < 1e-3
    assert ours.residual_m < 1e-3
    unit = spaces.normal[0, 0]
    assert ((ours.pos_m @ unit)[problem.prediction.checked] >= offset_m - 1e-3).all()
    assert unit @ (ours.pos_m[-1] + stop_s * ours.vel_m_s[-1]) >= offset_m - 1e-3
    free = problem.solve(tick)
    active = bool(np.abs(free.pos_m - ours.pos_m).max() > 0.005)
    assert active == (offset_m > -1.0)  # the constraint mattered, and left no trace in the next solve


def test_rows_are_at_the_end_of_the_horizon_and_none_before_it_can_be_influenced() -> None:
    problem = mpc(AXIS, AXIS, max_keep_outs=1)
    assert problem.prediction.checked[-1] == 39
    assert problem.prediction.checked[0] >= 6
    assert np.diff(problem.prediction.checked).max() * HORIZON.dt_s <= 0.081  # between samples the certificate looks


def test_rows_that_cannot_be_met_give_slack_and_not_failure() -> None:
    problem = mpc(AXIS, AXIS, max_keep_outs=2, qp=QpParams())
    north, south = wall((1.0, 0.0), 0.1, 40), wall((-1.0, 0.0), 0.1, 40)  # north of 0.1 m and south of -0.1 m
    both = HalfSpaces(**{name: np.concatenate([getattr(w, name) for w in (north, south)]) for name in FIELDS})
    solution = problem.solve(
        from_rest(np.zeros((40, 2))),
        both,
    )
    assert solution.solved
    assert solution.slack_m == pytest.approx(0.1, abs=0.02)  # each gives way by half of what is asked
    assert solution.residual_m < 0.02
    np.testing.assert_allclose(solution.pos_m[-1], 0.0, atol=0.02)


@pytest.mark.parametrize("ref_m", [1.0, 10.0, 50.0])
def test_no_reference_is_worth_any_slack_where_the_rows_can_be_met(ref_m: float) -> None:
    problem = mpc(AXIS, AXIS, max_keep_outs=1, qp=QpParams())
    reference = np.tile([ref_m, 0.0], (40, 1))
    spaces = wall((-1.0, 0.0), -0.1, 40)  # stay south of 0.1 m
    solution = problem.solve(
        from_rest(reference),
        spaces,
    )
    assert solution.slack_m < 0.005
    assert solution.pos_m[-1, 0] < 0.1 + 0.02


def test_relaxed_rows_ask_for_no_more_than_can_be_reached() -> None:
    problem = mpc(AXIS, AXIS, max_keep_outs=1, relax_01=0.9, qp=QpParams())
    spaces = wall((1.0, 0.0), 2.0, 40)
    solution = problem.solve(
        from_rest(np.zeros((40, 2))),
        spaces,
    )
    assert solution.slack_m < 0.02
    reach, _ = simulate(0.0, 0.0, np.clip(-0.05 * np.arange(1, 41), -0.2, None), GAIN, 0.0, 0.02, False)
    assert solution.pos_m[-1, 0] >= 0.9 * reach[-1] - 0.02
    assert (solution.pos_m[problem.prediction.checked, 0] >= 0.9 * reach[problem.prediction.checked] - 0.02).all()
