"""Of many keep-outs those that bounded increments can't violate have no rows, and plans are the same without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, AxesSolution, HalfSpaces
from swarmctl.control.mpc.condensed_qp.prediction import Forecast, Prediction
from swarmctl.control.mpc.condensed_qp.sized_mpc import FEW, SizedMpc, rooms, within_reach
from swarmctl.core.types import Array
from tests.benches.condensed_problems import AXIS, GAIN, HORIZON, mpc

AXES = (AXIS, replace(AXIS, u_min=-0.15, r=0.05))
FAMILIES = 20
TOLERANCE_M = 1e-9
ANSWER = AxesSolution(
    solved=True,
    status="",
    iterations=0,
    u=np.zeros((1, 2)),
    increments=np.zeros((2, 6)),
    pos_m=np.zeros((1, 2)),
    vel_m_s=np.zeros((1, 2)),
    slack_m=0.0,
    residual_m=0.0,
    terminal_gap_m=0.0,
    solve_us=0.0,
)


def asked(rng: np.random.Generator) -> AxesProblem:
    steps = HORIZON.prediction
    return AxesProblem(
        pos_m=rng.normal(size=2),
        vel_m_s=rng.normal(size=2),
        u_prev=rng.uniform(-0.15, 0.15, 2),
        gain_m_s2=np.full((steps, 2), GAIN),
        drift_m_s2=rng.normal(scale=0.3, size=2),
        ref_pos_m=np.tile(rng.normal(scale=2.0, size=2), (steps, 1)),
        ref_vel_m_s=np.zeros((steps, 2)),
    )


def families(rng: np.random.Generator, pos_m: Array) -> HalfSpaces:
    """Lines at -0.2 to 1.5 m from a position, on all sides, each the same at all steps."""
    angle = rng.uniform(0.0, 2.0 * np.pi, FAMILIES)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offset_m = normal @ pos_m - rng.uniform(-0.2, 1.5, FAMILIES)
    steps = HORIZON.prediction
    return HalfSpaces(
        normal=np.repeat(normal[:, None], steps, axis=1),
        offset_m=np.repeat(offset_m[:, None], steps, axis=1),
        stop_s=rng.uniform(0.0, 0.5, FAMILIES),
        stop_offset_m=offset_m,
    )


def shortfalls_m(ahead: Prediction, step: Forecast, spaces: HalfSpaces, increments: Array) -> Array:
    """By how much rows (families, checks) are violated under increments (axes, Hc), from positions and velocities."""
    accel = GAIN * (step.u_prev + ahead.hold @ increments.T) + step.asked.drift_m_s2
    pos, vel = ahead.motion(step.asked.pos_m, step.asked.vel_m_s, accel)  # (Hp, 2) each
    within = spaces.offset_m - np.einsum("ska,ka->sk", spaces.normal, pos)
    end = pos[-1] + spaces.stop_s[:, None] * vel[-1]
    to_stop = spaces.stop_offset_m - np.einsum("sa,sa->s", spaces.normal[:, -1], end)
    return np.column_stack([within[:, ahead.checked], to_stop])


def increments_within_bounds(rng: np.random.Generator, ahead: Prediction, u_prev: Array) -> Array:
    """Random ones, and at times the largest towards some direction (axes, Hc)."""
    wanted = rng.uniform(-1.0, 1.0, (2, HORIZON.control))
    if rng.random() < 0.5:
        wanted = np.sign(rng.normal(size=(2, 1))) * np.ones_like(wanted)
    return ahead.increments(wanted.ravel(), u_prev)


@pytest.mark.parametrize("seed", range(20))
def test_what_has_no_rows_is_never_violated_and_what_has_some_can_be(seed: int) -> None:
    rng = np.random.default_rng([16, seed])
    ahead, problem = Prediction(AXES, HORIZON), asked(rng)
    spaces = families(rng, problem.pos_m)
    step = ahead.forecast(problem, None)
    near, extremes = within_reach(spaces, ahead, step), ahead.extremes(step.u_prev)
    kept = np.isin(spaces.stop_s, near.stop_s)
    assert 0 < kept.sum() == len(near.normal) < FAMILIES
    violated = np.zeros(FAMILIES, bool)
    for _ in range(300):
        increments = increments_within_bounds(rng, ahead, step.u_prev)
        violated |= (shortfalls_m(ahead, step, spaces, increments) > TOLERANCE_M).any(axis=1)
    assert not (violated & ~kept).any()
    for family, normal in zip(np.flatnonzero(kept), near.normal[:, -1], strict=True):
        against = np.where((normal * GAIN < 0.0)[:, None], extremes[0], extremes[1])
        assert shortfalls_m(ahead, step, spaces, against)[family].max() > 0.0


def sized(most: int = FAMILIES) -> SizedMpc:
    return SizedMpc(lambda room: mpc(*AXES, max_keep_outs=room, relax_01=0.9), most)


@pytest.mark.parametrize("seed", range(20))
def test_plans_are_the_same_with_rows_of_all_keep_outs(seed: int) -> None:
    rng = np.random.default_rng([17, seed])
    problem = asked(rng)
    spaces, whole = families(rng, problem.pos_m), sized()
    ours, theirs = whole.solve(problem, spaces), whole.sizes[FAMILIES].solve(problem, spaces)
    assert ours.solved and theirs.solved
    np.testing.assert_allclose(ours.u, theirs.u, atol=2e-4)
    np.testing.assert_allclose(ours.pos_m, theirs.pos_m, atol=1e-3)


def test_a_number_that_is_none_is_not_taken_for_out_of_reach() -> None:
    rng = np.random.default_rng(19)
    problem = asked(rng)
    spaces, whole = families(rng, problem.pos_m), sized()
    spaces.offset_m[3] = np.nan
    assert not whole.solve(problem, spaces).solved


def test_rooms_double_up_to_the_most() -> None:
    assert [rooms(most) for most in (0, 3, 16, 17, 30, 100)] == [
        [0],
        [3],
        [16],
        [16, 17],
        [16, 30],
        [16, 25, 50, 100],
    ]


@pytest.mark.parametrize(
    ("within", "given", "room"), [(0, 20, 16), (16, 20, 16), (17, 20, 20), (0, 17, 16), (3, 9, 16)]
)
def test_the_smallest_problem_with_room_is_solved(
    within: int, given: int, room: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keep-outs are around the vehicle, or farther than any way."""
    step = asked(np.random.default_rng(18))
    spaces = families(np.random.default_rng(18), step.pos_m)
    apart_m = np.where(np.arange(FAMILIES) < within, -0.3, 50.0)
    offset_m = spaces.normal[:, 0] @ step.pos_m - apart_m
    spaces = HalfSpaces(
        normal=spaces.normal[:given],
        offset_m=np.repeat(offset_m[:given, None], HORIZON.prediction, 1),
        stop_s=spaces.stop_s[:given],
        stop_offset_m=offset_m[:given],
    )
    problem, solved = sized(), dict[int, int]()
    for size, found in problem.sizes.items():

        def solve(forecast: Forecast, size: int = size) -> AxesSolution:
            assert forecast.half_spaces is not None
            solved[size] = len(forecast.half_spaces.normal)
            return ANSWER

        monkeypatch.setattr(found, "solve_from", solve)
    assert problem.solve(step, spaces) is ANSWER
    assert solved == {room: within if given > FEW else given}
