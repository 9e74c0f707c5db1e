"""One problem for three axes has the right signs, agrees with the thesis' two, and favours no axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.collision.separation import SeparationParams, certify
from swarmctl.control.model import acceleration
from swarmctl.control.mpc.condensed_qp.axes import Terminal
from swarmctl.control.mpc.joint_mpc import JointMpc
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.control.mpc.swarm_mpc import SwarmMpc
from swarmctl.core.types import Array, Plan, PlanStatus, Reference
from tests import builders

G = 9.81
HERE = np.array([1.0, 2.0, -10.0])
DAQP = QpParams(solver="daqp")  # exact, so that equal problems have equal answers
FREE_END = "none"
Point = Sequence[float] | Array  # (3,)


def problem(
    goal: Point,
    keep_outs: Sequence[KeepOut] = (),
    *,
    pos: Array = HERE,
    vel: Point = (0.0, 0.0, 0.0),
    virtual_control: Point = (0.0, 0.0, G),
    wind: Point = (0.0, 0.0, 0.0),
    guess: Array | None = None,
) -> Problem:
    """Go to `goal`, metres from HERE, and be at rest there."""
    reference = Reference(np.tile(HERE + np.array(goal), (61, 1)), np.zeros((61, 3)), 0.0)
    return Problem(
        start=builders.start(pos_ned_m=pos, vel_ned_m_s=np.array(vel), virtual_control=np.array(virtual_control)),
        reference=reference,
        disturbance_ned_m_s2=np.array(wind),
        keep_outs=tuple(keep_outs),
        guess_ned_m=guess,
    )


def joint(max_keep_outs: int = 4, separation: SeparationParams | None = None, **params: Any) -> JointMpc:
    params.setdefault("z", {"q_pos": 2.0, "q_vel": 0.05, "r": 0.01})  # as configs/improved_5_circle_dmpc3.toml
    return JointMpc(
        MpcParams(**params),
        builders.controller_setup(separation=separation, max_keep_outs=max_keep_outs),
    )


def four_places(kind: type[JointMpc] | type[SwarmMpc], params: MpcParams) -> JointMpc | SwarmMpc:
    return kind(params, builders.controller_setup(max_keep_outs=4))


def ball(offset: Point, any_height: bool = False, priority_id: int = -1) -> KeepOut:
    """Return a keep-out of 0.9 m (hard minimum 0.8 m) at `offset` from HERE; an obstacle unless it has an id."""
    return builders.keep_out(
        pos_ned_m=np.tile(HERE + np.array(offset), (41, 1)), any_height=any_height, priority_id=priority_id
    )


def distances(path: Array, keep_out: KeepOut) -> Array:
    apart = path - keep_out.pos_ned_m[: len(path)]
    return np.asarray(np.linalg.norm(apart[:, : 2 if keep_out.any_height else 3], axis=1))


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_first_command_accelerates_towards_the_reference(axis: int, sign: float) -> None:
    goal = np.zeros(3)
    goal[axis] = sign
    plan = joint(terminal_z=FREE_END, qp=DAQP).plan(problem(goal))
    assert plan.status is PlanStatus.OK
    virtual_control = plan.virtual_control[0] - [0.0, 0.0, G]
    assert (
        sign * virtual_control[axis] < -0.02
    )  # x'' = -f u_x, y'' = -f u_y, z'' = g - f: north, east, down are all minus
    assert sign * acceleration(plan.virtual_control[0])[axis] > 0.2
    assert sign * (plan.pos_ned_m[-1] - HERE)[axis] > 0.1
    np.testing.assert_allclose(np.delete(virtual_control, axis), 0.0, atol=1e-6)


def test_at_its_reference_it_hovers_and_leans_against_wind() -> None:
    plan = joint().plan(problem((0.0, 0.0, 0.0)))
    np.testing.assert_allclose(plan.virtual_control, np.tile([0.0, 0.0, G], (40, 1)), atol=5e-3)
    np.testing.assert_allclose(plan.pos_ned_m, np.tile(HERE, (41, 1)), atol=2e-3)
    leant = joint().plan(problem((0.0, 0.0, 0.0), wind=(1.0, -0.5, 0.4))).virtual_control[-1]
    assert leant[0] > 0.02 > 0.0 > leant[1]
    assert leant[2] > G + 0.2


def test_bounds_of_thrust_and_tilt_hold() -> None:
    for goal in ((50.0, -50.0, -10.0), (0.0, 50.0, 100.0)):
        plan = joint().plan(problem(goal))
        assert plan.status is PlanStatus.OK
        assert np.abs(plan.virtual_control[:, :2]).max() <= 0.2 + 1e-9
        assert np.abs(np.diff(plan.virtual_control[:, :2], axis=0, prepend=np.zeros((1, 2)))).max() <= 0.05 + 1e-9
        assert np.abs(np.diff(plan.virtual_control[:, 2], prepend=G)).max() <= 5.0 + 1e-9
        assert 0.0 - 1e-9 <= plan.virtual_control[:, 2].min() <= plan.virtual_control[:, 2].max() <= 20.0 + 1e-9


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_invalid_numbers_are_a_status_and_not_an_exception(bad: float) -> None:
    mpc = joint()
    with np.errstate(invalid="ignore"):
        for nonsense in (problem((bad, 0.0, 0.0)), problem((0.0, 0.0, 0.0), vel=(0.0, 0.0, bad))):
            assert mpc.plan(nonsense).status is PlanStatus.SOLVER_FAILED
    assert mpc.plan(problem((0.1, 0.0, 0.0))).status is PlanStatus.OK


@pytest.mark.parametrize("terminal", ["none", "position", "position_velocity", "region"])
@pytest.mark.parametrize("goal", [(0.4, -0.7, 0.0), (0.0, 0.0, 0.03), (0.0, 0.0, -2.0)])
def test_with_nothing_near_it_plans_what_the_two_problems_of_the_thesis_do(
    terminal: Terminal, goal: tuple[float, float, float]
) -> None:
    same = MpcParams(control_z=6, horizon_z=40, terminal_z=terminal, qp=DAQP)  # as x-y, which dmpc3 takes for all
    both = [four_places(kind, same).plan(problem(goal)) for kind in (JointMpc, SwarmMpc)]
    assert both[0].status is both[1].status is PlanStatus.OK
    np.testing.assert_allclose(both[0].virtual_control, both[1].virtual_control, atol=1e-5)
    np.testing.assert_allclose(both[0].pos_ned_m, both[1].pos_ned_m, atol=1e-6)
    np.testing.assert_allclose(both[0].vel_ned_m_s, both[1].vel_ned_m_s, atol=1e-5)
    assert both[0].terminal_gap_m == pytest.approx(both[1].terminal_gap_m, abs=1e-5)


def test_a_little_climb_changes_little_sideways() -> None:
    same = MpcParams(control_z=6, horizon_z=40, terminal_z="none", qp=DAQP)
    both = [four_places(kind, same).plan(problem((0.4, 0.0, -0.02))) for kind in (JointMpc, SwarmMpc)]
    np.testing.assert_allclose(both[0].pos_ned_m, both[1].pos_ned_m, atol=5e-3)


@pytest.mark.parametrize("climb_m", [0.2, 3.0, -3.0])
def test_the_planned_path_is_the_motion_of_its_own_virtual_controls(climb_m: float) -> None:
    asked = problem((2.0, 0.0, -climb_m))
    plan = joint(terminal_z=FREE_END, qp=DAQP).plan(asked)
    np.testing.assert_allclose(motion(asked, plan), plan.pos_ned_m, atol=0.01)


def test_the_certified_path_is_the_motion_of_the_inputs() -> None:
    near = ball((1.1424, 0.4675, -1.7551), priority_id=1)
    state = {"vel": (-0.1647, -0.4631, 1.3129), "virtual_control": (-0.0542, -0.1913, 7.899)}
    asked = problem((3.2193, 1.9425, -1.0748), [near], **state)  # type: ignore[arg-type]
    plan = joint(terminal_z=FREE_END, qp=DAQP).plan(asked)
    assert plan.status is PlanStatus.NOT_CERTIFIED or certify(motion(asked, plan), [near], 6) >= 0.0


def motion(asked: Problem, plan: Plan) -> Array:
    """Positions (steps+1, 3) of x'' = -f u_x, y'' = -f u_y, z'' = g - f under the plan's virtual controls."""
    pos, vel, path = asked.start.pos_ned_m, asked.start.vel_ned_m_s, [asked.start.pos_ned_m]
    for u_x, u_y, thrust in plan.virtual_control:
        accel = np.array([-thrust * u_x, -thrust * u_y, G - thrust]) + asked.disturbance_ned_m_s2
        pos, vel = pos + 0.02 * vel + 0.5 * 0.02**2 * accel, vel + 0.02 * accel
        path.append(pos)
    return np.array(path)


# -- passing above and below ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Flight:
    path: Array  # (ticks+1, 3)
    plans: list[Plan]

    def arc_length_m(self, keep_outs: Sequence[KeepOut]) -> float:
        return min(float(distances(self.path, _lasting(k, len(self.path))).min()) for k in keep_outs)


def _lasting(keep_out: KeepOut, points: int) -> KeepOut:
    still = np.tile(keep_out.pos_ned_m[0], (points, 1))
    return builders.keep_out(
        pos_ned_m=still,
        radius_m=keep_out.radius_m,
        hard_min_distance_m=keep_out.hard_min_distance_m,
        any_height=keep_out.any_height,
        priority_id=keep_out.priority_id,
    )


def fly(mpc: JointMpc | SwarmMpc, goal: Point, keep_outs: Sequence[KeepOut], ticks: int = 350) -> Flight:
    """Closed loop with x'' = -f u_x, y'' = -f u_y, z'' = g - f, which is not what dmpc3 predicts with."""
    pos, vel, virtual_control, guess = HERE.copy(), np.zeros(3), np.array([0.0, 0.0, G]), None
    path, plans = [pos], []
    for _ in range(ticks):
        plan = mpc.plan(problem(goal, keep_outs, pos=pos, vel=vel, virtual_control=virtual_control, guess=guess))
        virtual_control = plan.virtual_control[0]
        accel = np.array(
            [-virtual_control[2] * virtual_control[0], -virtual_control[2] * virtual_control[1], G - virtual_control[2]]
        )
        pos, vel = pos + 0.02 * vel + 0.5 * 0.02**2 * accel, vel + 0.02 * accel
        guess = np.vstack([plan.pos_ned_m[1:], plan.pos_ned_m[-1] + 0.02 * plan.vel_ned_m_s[-1]])
        path.append(pos)
        plans.append(plan)
    return Flight(np.array(path), plans)


def wall(lower_m: float, any_height: bool = False) -> list[KeepOut]:
    """Three balls side by side, 2 m north, their gaps closed; centres `lower_m` below the straight way."""
    return [ball((2.0, east_m, lower_m), any_height) for east_m in (0.0, 1.2, -1.2)]


@pytest.mark.parametrize("terminal", ["none", "region", "position_velocity"])
@pytest.mark.parametrize("lower_m", [0.2, -0.2, 0.02])
def test_a_wall_is_passed_above_or_below_with_every_plan_certified(lower_m: float, terminal: str) -> None:
    keep_outs = wall(lower_m)
    flight = fly(joint(terminal_z=terminal), (4.0, 0.0, 0.0), keep_outs, ticks=250)
    assert all(plan.status is PlanStatus.OK for plan in flight.plans)
    assert min(certify(plan.pos_ned_m, keep_outs, 6) for plan in flight.plans) >= 0.0
    assert flight.arc_length_m(keep_outs) > 0.85  # true distances of what was flown; 0.9 asked, 0.8 certified
    assert np.linalg.norm(flight.path[-1] - HERE - [4.0, 0.0, 0.0]) < 0.2
    height_m = HERE[2] - flight.path[:, 2]
    over = height_m[np.abs(flight.path[:, 0] - HERE[0] - 2.0) < 0.2]
    assert (np.sign(over) == np.sign(lower_m)).all()  # on the side that is shorter
    assert np.abs(over).min() > 0.5


def test_the_thesis_controller_cannot_pass_that_wall() -> None:
    flight = fly(
        SwarmMpc(MpcParams(), builders.controller_setup(max_keep_outs=4)),
        (4.0, 0.0, 0.0),
        wall(0.2),
        ticks=200,
    )
    assert (flight.path[:, 0] < HERE[0] + 2.0).all()
    assert np.abs(flight.path[:, 2] - HERE[2]).max() < 0.01


@pytest.mark.parametrize("lower_m", [0.2, -0.2])
def test_a_keep_out_at_every_height_is_never_passed_above(lower_m: float) -> None:
    keep_outs = wall(lower_m, any_height=True)
    flight = fly(joint(terminal_z=FREE_END), (4.0, 0.0, 0.0), keep_outs)
    assert all(plan.status is PlanStatus.OK for plan in flight.plans)
    assert flight.arc_length_m(keep_outs) > 0.85  # horizontally
    assert (flight.path[:, 0] < HERE[0] + 2.0).all()  # and so not past it
    assert np.abs(flight.path[:, 2] - HERE[2]).max() < 0.01  # nor is climbing tried
    alone = [ball((2.0, 0.0, lower_m), any_height=True)]
    round_it = fly(joint(terminal_z=FREE_END), (4.0, 0.0, 0.0), alone)
    assert round_it.arc_length_m(alone) > 0.85
    assert np.linalg.norm(round_it.path[-1] - HERE - [4.0, 0.0, 0.0]) < 0.2  # round is allowed
    assert np.abs(round_it.path[:, 2] - HERE[2]).max() < 0.01


def test_above_its_place_it_stays_above_when_the_reference_falls_into_a_keep_out() -> None:
    below = ball((0.0, 0.0, 1.2), priority_id=1)
    for terminal in ("none", "region"):
        plan = joint(terminal_z=terminal).plan(problem((0.0, 0.0, 1.2), [below], vel=(0.0, 0.0, 0.3)))
        assert plan.status is PlanStatus.OK
        assert distances(plan.pos_ned_m, below).min() > 0.9 - 0.02


@pytest.mark.parametrize("terminal", ["position", "position_velocity"])  # the second is the default
def test_distances_have_priority_over_the_terminal_condition(terminal: str) -> None:
    below = ball((0.0, 0.0, 0.9), priority_id=1)
    plan = joint(terminal_z=terminal).plan(problem((0.0, 0.0, 0.08), [below]))
    assert plan.slack_m < 0.01
    assert distances(plan.pos_ned_m, below).min() > 0.9 - 0.01


# -- no favourite axis ------------------------------------------------------------------------------------------------

SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # clockwise seen from above
FLIP = np.diag([1.0, 1.0, -1.0])


def mirrored(asked: Problem, by: Array) -> Problem:
    """The same problem in space turned or mirrored round HERE; of thrust, what differs from hovering."""

    def turned(points: Array) -> Array:
        return np.asarray(HERE + (points - HERE) @ by.T)

    start, reference = asked.start, asked.reference
    rest = np.array([0.0, 0.0, G])
    return Problem(
        start=builders.start(
            pos_ned_m=turned(start.pos_ned_m),
            vel_ned_m_s=by @ start.vel_ned_m_s,
            virtual_control=rest + by @ (start.virtual_control - rest),
        ),
        reference=Reference(turned(reference.pos_ned_m), reference.vel_ned_m_s @ by.T, 0.0),
        disturbance_ned_m_s2=by @ asked.disturbance_ned_m_s2,
        keep_outs=tuple(
            builders.keep_out(pos_ned_m=turned(k.pos_ned_m), any_height=k.any_height, priority_id=k.priority_id)
            for k in asked.keep_outs
        ),
        guess_ned_m=None if asked.guess_ned_m is None else turned(asked.guess_ned_m),
    )


def random_problem(seed: int, priority_id: int) -> Problem:
    rng = np.random.default_rng([seed, 0, 9])
    places = rng.uniform(-1.0, 1.0, (3, 3)) + np.array([1.6, 0.0, 0.0])
    keep_outs = [ball(place, any_height=k == 2, priority_id=priority_id) for k, place in enumerate(places)]
    virtual_control = (*rng.uniform(-0.1, 0.1, 2), G)
    goal, wind = rng.uniform(-3.0, 3.0, 3), rng.uniform(-0.5, 0.5, 3)
    vel = rng.uniform(-0.6, 0.6, 3) + np.array([1.0, 0.0, 0.0])  # towards them
    return problem(goal, keep_outs, vel=vel, virtual_control=virtual_control, wind=wind)


@pytest.mark.parametrize(
    ("by", "priority_id", "right_of_way_rad"),
    [
        pytest.param(SWAP, -1, 0.35, id="x and y, obstacles"),  # passed on the side one is on, whichever that is
        pytest.param(SWAP, 1, 0.0, id="x and y, peers without the traffic rule"),
        pytest.param(QUARTER, -1, 0.35, id="quarter turn, obstacles"),
        pytest.param(QUARTER, 1, 0.35, id="quarter turn, peers"),  # the rule has a hand, so only turns keep it
    ],
)
def test_a_mirrored_problem_has_the_mirrored_plan(by: Array, priority_id: int, right_of_way_rad: float) -> None:
    separation, matters = SeparationParams(right_of_way_rad=right_of_way_rad), 0
    for seed in range(12):
        asked = random_problem(seed, priority_id)
        alone = replace(asked, keep_outs=())
        one, two, free = (
            joint(3, separation, terminal_z=FREE_END, qp=DAQP).plan(p) for p in (asked, mirrored(asked, by), alone)
        )
        assert one.status is two.status
        assert one.slack_m == pytest.approx(two.slack_m, abs=1e-6)
        np.testing.assert_allclose(two.pos_ned_m - HERE, (one.pos_ned_m - HERE) @ by.T, atol=1e-5)
        np.testing.assert_allclose(
            two.virtual_control - [0.0, 0.0, G], (one.virtual_control - [0.0, 0.0, G]) @ by.T, atol=1e-3
        )
        matters += bool(np.abs(one.pos_ned_m - free.pos_ned_m).max() > 0.01)
    assert matters >= 5  # plans that the keep-outs have changed


@pytest.mark.parametrize("any_room", [True, False])
@pytest.mark.parametrize("goal_m", [0.05, 0.6, 3.0])
def test_up_and_down_are_mirrored_where_there_is_as_much_thrust_for_both(goal_m: float, any_room: bool) -> None:
    # straight up and down: sideways more thrust does more, whatever is planned
    room: dict[str, Any] = {"thrust_min_m_s2": G - 8.0, "thrust_max_m_s2": G + 8.0}
    mpc = joint(terminal_z=FREE_END, qp=DAQP, **room)
    plans = []
    for sign in (-1.0, 1.0):
        in_the_way = () if any_room else (ball((0.0, 0.0, 1.2 * sign), priority_id=1),)
        plans.append(mpc.plan(problem((0.0, 0.0, goal_m * sign), in_the_way, vel=(0.0, 0.0, 0.3 * sign))))
    up, down = plans
    assert up.status is down.status is PlanStatus.OK
    np.testing.assert_allclose((up.pos_ned_m - HERE) @ FLIP, down.pos_ned_m - HERE, atol=1e-6)
    np.testing.assert_allclose(up.virtual_control[:, 2] - G, G - down.virtual_control[:, 2], atol=1e-5)
    if not any_room:
        assert np.abs(up.pos_ned_m[:, 2] - HERE[2]).max() < 0.3 + 0.01


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
@pytest.mark.parametrize("goal", [(0.05, 0.02, 0.0), (0.3, -0.2, 0.0)])
def test_it_comes_to_its_place_as_exactly_as_the_two_problems_do(goal: tuple[float, float, float], solver: str) -> None:
    ends = []
    for kind in (JointMpc, SwarmMpc):
        params = MpcParams(terminal_z="none", qp=QpParams(solver=solver))  # type: ignore[arg-type]
        path = fly(
            four_places(kind, params),
            goal,
            (),
            ticks=200,
        ).path
        ends.append(float(np.linalg.norm(path[-25:] - HERE - goal, axis=1).mean()))
    assert ends[1] < 0.004
    assert ends[0] < 0.004
