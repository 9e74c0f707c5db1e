"""One step of the swarm MPC has the signs of the thesis' equations, and every status of a plan has its cause."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.collision.separation import SeparationParams, certify
from swarmctl.control.controllers.discovery import ControllerParams, make_controller
from swarmctl.control.model import VehicleModelParams, acceleration
from swarmctl.control.mpc.attempts import closest_keep_outs
from swarmctl.control.mpc.condensed_qp.axes import AxesSolution
from swarmctl.control.mpc.judgement import RESIDUAL_LIMIT_M
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.mpc.solvers.qp import QpParams
from swarmctl.control.mpc.swarm_mpc import SwarmMpc
from swarmctl.control.rollout import ModelledVehicle
from swarmctl.core.types import Array, Plan, PlanStatus, Reference
from tests import builders

G = 9.81
HERE = np.array([1.0, 2.0, -3.0])


def start(
    pos: Array = HERE, vel: tuple[float, ...] = (0.0, 0.0, 0.0), virtual_control: tuple[float, ...] = (0.0, 0.0, G)
) -> Start:
    return builders.start(
        t_us=5_000_000, pos_ned_m=pos, vel_ned_m_s=np.array(vel), virtual_control=np.array(virtual_control)
    )


def reference(offset: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Reference:
    return Reference(np.tile(HERE + offset, (101, 1)), np.zeros((101, 3)), 0.0)


def problem(
    offset: tuple[float, ...] = (0.0, 0.0, 0.0),
    *keep_outs: KeepOut,
    wind: tuple[float, ...] = (0.0, 0.0, 0.0),
    begin: Start | None = None,
) -> Problem:
    return Problem(
        start=begin or start(),
        reference=reference(offset),
        disturbance_ned_m_s2=np.array(wind),
        keep_outs=keep_outs,
        guess_ned_m=None,
    )


def plan_to(
    offset: tuple[float, ...],
    *keep_outs: KeepOut,
    wind: tuple[float, ...] = (0.0, 0.0, 0.0),
    begin: Start | None = None,
    **params: Any,
) -> Plan:
    mpc = SwarmMpc(MpcParams(**params), builders.controller_setup())
    return mpc.plan(problem(offset, *keep_outs, wind=wind, begin=begin))


def fixed(place: Array, allowed_m: float = 0.8, steps: int = 40) -> KeepOut:
    return builders.keep_out(
        pos_ned_m=np.tile(place, (steps + 1, 1)), radius_m=allowed_m + 0.1, hard_min_distance_m=allowed_m
    )


@pytest.mark.parametrize(("axis", "sign"), [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)])
def test_a_reference_to_the_north_tilts_the_body_axis_south(axis: int, sign: float) -> None:
    # (3.17) x'' = -(f/m) u_x and y'' = -(f/m) u_y: to accelerate north, u_x must be negative
    offset = [0.0, 0.0, 0.0]
    offset[axis] = sign
    plan = plan_to((offset[0], offset[1], offset[2]))
    assert plan.status is PlanStatus.OK
    assert sign * plan.virtual_control[0, axis] < -0.02
    assert sign * acceleration(plan.virtual_control[0])[axis] > 0.2
    assert sign * (plan.pos_ned_m[-1, axis] - HERE[axis]) > 0.1
    np.testing.assert_allclose(plan.virtual_control[:, 1 - axis], 0.0, atol=2e-3)


@pytest.mark.parametrize("up_m", [0.5, -0.5])
def test_a_reference_above_takes_more_thrust_than_the_weight(up_m: float) -> None:
    plan = plan_to((0.0, 0.0, -up_m))
    assert (plan.virtual_control[0, 2] - G) * up_m > 0.1
    assert (plan.pos_ned_m[-1, 2] - HERE[2]) * -up_m > 0.04  # three increments that end at rest reach 0.1 m


def test_a_vehicle_at_its_reference_hovers() -> None:
    plan = plan_to((0.0, 0.0, 0.0))
    np.testing.assert_allclose(plan.virtual_control, np.tile([0.0, 0.0, G], (40, 1)), atol=5e-3)
    np.testing.assert_allclose(plan.pos_ned_m, np.tile(HERE, (41, 1)), atol=2e-3)
    assert (plan.t0_us, plan.dt_us, plan.status) == (5_000_000, 20_000, PlanStatus.OK)


def test_a_tilted_vehicle_needs_more_thrust_to_hover() -> None:
    # (3.11): z'' = g - (f/m) c with c frozen; held at c = 0.9 the equilibrium is g / 0.9
    begin = builders.start(pos_ned_m=HERE, cos_tilt=0.9, virtual_control=np.array([0.0, 0.0, G / 0.9]))
    plan = plan_to((0.0, 0.0, 0.0), begin=begin)
    np.testing.assert_allclose(plan.virtual_control[:, 2], G / 0.9, atol=5e-3)


def test_the_plan_leans_against_wind() -> None:
    plan = plan_to((0.0, 0.0, 0.0), wind=(1.0, -0.5, 0.4))
    first_to_last = plan.virtual_control[-1]
    assert first_to_last[0] > 0.02 > 0.0 > first_to_last[1]  # wind to the north: body axis north, thrust south
    assert first_to_last[2] > G + 0.2


def test_bounds_of_thrust_and_tilt_hold() -> None:
    plan = plan_to((50.0, -50.0, -10.0))
    assert plan.status is PlanStatus.OK
    assert np.abs(plan.virtual_control[:, :2]).max() <= 0.2 + 2e-3
    assert np.abs(np.diff(plan.virtual_control[:, :2], axis=0, prepend=np.zeros((1, 2)))).max() <= 0.05 + 1e-9
    assert np.abs(np.diff(plan.virtual_control[:, 2], prepend=G)).max() <= 5.0 + 1e-9


@pytest.mark.parametrize("kind", ["dmpc", "dmpc3", "mpc"])
def test_no_plan_uses_thrust_that_the_vehicle_has_not(kind: Literal["dmpc", "dmpc3", "mpc"]) -> None:
    heavy = VehicleModelParams(hover_thrust_01=0.8)
    mpc = make_controller(ControllerParams(kind=kind), builders.controller_setup(vehicle=heavy))
    most_m_s2 = heavy.thrust_range_m_s2()[1]
    thrust_m_s2 = mpc.plan(problem((0.0, 0.0, -3.0))).virtual_control[:, 2]
    assert thrust_m_s2.max() == pytest.approx(most_m_s2, abs=1e-6)
    level_m_s2 = MpcParams(u_max=0.9).accel_max_m_s2(heavy.model_copy(update={"tilt_max_rad": 1.2}))
    assert math.hypot(level_m_s2, G) == pytest.approx(most_m_s2, abs=0.01)


@pytest.mark.parametrize("down_m", [-100.0, -20.0, 20.0, 100.0])
def test_a_far_reference_is_planned_for_within_the_bounds_of_thrust(down_m: float) -> None:
    plan = plan_to((0.0, 0.0, down_m))
    assert plan.status is PlanStatus.OK
    assert plan.virtual_control[:, 2].max() <= 20.0 + 0.05
    assert plan.virtual_control[:, 2].min() >= -0.05  # a rotor can't pull
    assert (plan.virtual_control[0, 2] - G) * down_m < 0.0


@pytest.mark.parametrize("cos_tilt", [1.0, 0.9])
@pytest.mark.parametrize("ahead", ["planned", "held"])
def test_the_planned_path_is_the_motion_of_its_own_virtual_controls(ahead: str, cos_tilt: float) -> None:
    wind, vel = np.array([0.3, -0.2, 0.1]), np.array([0.2, 0.1, 0.3])
    begin = builders.start(
        pos_ned_m=HERE, vel_ned_m_s=vel, cos_tilt=cos_tilt, virtual_control=np.array([0.05, 0.0, 8.0])
    )
    plan = plan_to((0.5, -0.3, -0.4), begin=begin, wind=tuple(wind), thrust_ahead=ahead)
    assert (
        np.ptp(plan.virtual_control[:, 2]) > 1.0
    )  # the thrust is not constant, so it matters which one x-y is predicted with
    pos = HERE.copy()
    for k in range(40):
        thrust = plan.virtual_control[k if ahead == "planned" else 0, 2]  # held: the thesis' f_t of now
        across, up = -thrust * plan.virtual_control[k, :2], G - cos_tilt * plan.virtual_control[k, 2]
        accel = np.array([*across, up]) + wind
        pos, vel = pos + 0.02 * vel + 0.5 * 0.02**2 * accel, vel + 0.02 * accel
        np.testing.assert_allclose(plan.pos_ned_m[k + 1], pos, atol=1e-9)
        np.testing.assert_allclose(plan.vel_ned_m_s[k + 1], vel, atol=1e-9)


def test_only_a_thrust_that_changes_makes_held_and_planned_differ() -> None:
    level = [plan_to((0.5, 0.0, 0.0), thrust_ahead=ahead) for ahead in ("planned", "held")]
    np.testing.assert_allclose(level[0].pos_ned_m, level[1].pos_ned_m, atol=1e-3)
    brisk = {"q_pos": 2.0, "q_vel": 0.05, "r": 0.01}
    climbing = [plan_to((2.0, 0.0, -0.5), thrust_ahead=ahead, z=brisk) for ahead in ("planned", "held")]
    assert np.abs(climbing[0].pos_ned_m - climbing[1].pos_ned_m).max() > 0.02


def test_a_neighbour_ahead_is_avoided() -> None:
    neighbour = fixed(HERE + np.array([1.3, 0.0, 0.0]))
    free, kept = plan_to((1.3, 0.0, 0.0)), plan_to((1.3, 0.0, 0.0), neighbour)
    assert free.status is kept.status is PlanStatus.OK
    near = np.linalg.norm(kept.pos_ned_m - neighbour.pos_ned_m, axis=1).min()
    assert near > 0.9 - 0.02
    assert certify(free.pos_ned_m, [neighbour], 6) < certify(kept.pos_ned_m, [neighbour], 6)


def test_a_plan_that_cannot_avoid_is_not_certified_and_reports_its_slack() -> None:
    rushing = start(vel=(4.0, 0.0, 0.0))
    plan = plan_to((5.0, 0.0, 0.0), fixed(HERE + np.array([2.0, 0.0, 0.0])), begin=rushing)
    assert plan.status is PlanStatus.NOT_CERTIFIED
    assert certify(plan.pos_ned_m, [fixed(HERE + np.array([2.0, 0.0, 0.0]))], 6) < 0.0


def test_a_keep_out_beyond_the_slots_is_still_certified() -> None:
    near = [fixed(HERE + np.array([0.0, e, 0.0]), 0.8) for e in (0.5, -0.5)]  # nearest two take both max_keep_outs
    wall = [fixed(HERE + np.array([3.0, 0.6, 0.0]), 0.8)]
    plan = plan_to((5.0, 0.0, 0.0), *near, *wall, begin=start(vel=(4.0, 0.0, 0.0)))
    assert plan.status is PlanStatus.NOT_CERTIFIED


def test_no_plan_is_certified_beside_a_keep_out_without_a_place() -> None:
    nowhere = fixed(np.full(3, math.nan))
    away = [fixed(HERE + np.array([20.0 + k, 0.0, 0.0])) for k in range(3)]  # they take the slots
    assert plan_to((0.1, 0.0, 0.0), *away).status is PlanStatus.OK
    assert plan_to((0.1, 0.0, 0.0), *away, nowhere).status is PlanStatus.NOT_CERTIFIED


def test_a_solver_that_breaks_down_is_a_status_and_not_an_exception() -> None:
    for bad in (math.nan, math.inf):
        plan = plan_to((1.0, 0.0, 0.0), begin=start(vel=(bad, 0.0, 0.0)))
        assert plan.status is PlanStatus.SOLVER_FAILED
    plan = plan_to((math.nan, 0.0, 0.0))
    assert plan.status is PlanStatus.SOLVER_FAILED


def solution(residual_m: float, solved: bool = True) -> AxesSolution:
    two = np.zeros((40, 2))
    return AxesSolution(
        solved=solved,
        status="",
        iterations=1,
        u=two,
        increments=np.zeros((2, 6)),
        pos_m=np.tile(HERE[:2], (40, 1)),
        vel_m_s=two,
        slack_m=0.0,
        residual_m=residual_m,
        terminal_gap_m=0.0,
        solve_us=0.0,
    )


@pytest.mark.parametrize(
    ("residual_m", "solved", "status"),
    [
        (RESIDUAL_LIMIT_M, True, PlanStatus.OK),
        (1.01 * RESIDUAL_LIMIT_M, True, PlanStatus.RESIDUAL),
        (math.inf, True, PlanStatus.RESIDUAL),
        (0.0, False, PlanStatus.SOLVER_FAILED),
    ],
)
def test_every_solver_status_is_checked(
    monkeypatch: pytest.MonkeyPatch, residual_m: float, solved: bool, status: PlanStatus
) -> None:
    mpc = SwarmMpc(MpcParams(), builders.controller_setup())
    monkeypatch.setattr(mpc._xy_alone, "solve", lambda *_, **__: solution(residual_m, solved))
    assert mpc.plan(problem()).status is status


def test_a_solver_that_is_stopped_too_early_has_a_residual() -> None:
    qp = QpParams(max_iterations=10, polish=False)
    plan = plan_to((5.0, 0.5, 0.0), fixed(HERE + np.array([1.0, 0.3, 0.0])), begin=start(vel=(1.5, 0.0, 0.0)), qp=qp)
    assert plan.status in (PlanStatus.RESIDUAL, PlanStatus.SOLVER_FAILED, PlanStatus.NOT_CERTIFIED)
    assert plan.residual_m > RESIDUAL_LIMIT_M


@pytest.mark.parametrize("horizon_xy", [2, 6])
def test_a_control_horizon_as_long_as_the_prediction_can_be_flown(horizon_xy: int) -> None:
    """A longer one, too: plans that track commitments have ten changes of thrust, however short they are."""
    neighbour = fixed(HERE + np.array([3.0, 0.0, 0.0]), steps=horizon_xy)
    assert plan_to((0.1, 0.0, 0.0), neighbour, horizon_xy=horizon_xy).status is PlanStatus.OK


def test_z_longer_or_shorter_than_xy_gives_a_plan_of_xy_length() -> None:
    for horizon_z in (10, 60):
        plan = plan_to((0.0, 0.0, -0.2), horizon_z=horizon_z)
        assert plan.pos_ned_m.shape == (41, 3)
        assert np.isfinite(plan.pos_ned_m).all()
        assert plan.virtual_control.shape == (40, 3)


@pytest.mark.parametrize("drag_1_s", [0.0, 0.5])
@pytest.mark.parametrize("climb_m_s", [3.0, -2.0])
def test_behind_a_shorter_horizon_of_z_the_vehicle_brakes_by_the_inputs_of_the_plan(
    climb_m_s: float, drag_1_s: float
) -> None:
    """Its path, which others keep clear of and which is certified, does not stop dead in height."""
    vehicle = VehicleModelParams(drag_1_s=drag_1_s, thrust_min_01=0.0)
    mpc = SwarmMpc(MpcParams(horizon_z=10), builders.controller_setup(vehicle=vehicle))
    asked = problem((0.0, 0.0, -5.0 * climb_m_s), begin=start(vel=(0.0, 0.0, -climb_m_s)), wind=(0.0, 0.0, 0.4))
    plan, flown = mpc.plan(asked), ModelledVehicle(asked.start, vehicle, asked.disturbance_ned_m_s2)
    for k in range(40):
        flown.step(plan.virtual_control[k], 0.02)
    assert plan.pos_ned_m[-1, 2] == pytest.approx(flown.pos_ned_m[2], abs=0.03)
    assert plan.vel_ned_m_s[-1, 2] == pytest.approx(flown.vel_ned_m_s[2], abs=0.03)
    assert np.abs(np.diff(plan.vel_ned_m_s[:, 2])).max() < 0.21, "it does not stop dead"
    assert abs(plan.vel_ned_m_s[-1, 2]) < abs(plan.vel_ned_m_s[10, 2])


def test_a_peer_in_the_way_up_is_seen_behind_a_shorter_horizon_of_z() -> None:
    above = fixed(HERE + np.array([0.0, 0.0, -2.2]))
    asked = problem((0.0, 0.0, -6.0), above, begin=start(vel=(0.0, 0.0, -3.0)))
    plans = [SwarmMpc(MpcParams(horizon_z=n), builders.controller_setup()).plan(asked) for n in (40, 10)]
    assert [plan.status for plan in plans] == [PlanStatus.NOT_CERTIFIED] * 2


def test_the_controller_without_neighbours_ignores_them_and_the_distributed_one_does_not() -> None:
    neighbour = fixed(HERE + np.array([0.5, 0.0, 0.0]), 0.8)
    alone = make_controller(
        ControllerParams(kind="mpc"),
        builders.controller_setup(),
    )
    together = make_controller(
        ControllerParams(kind="dmpc"),
        builders.controller_setup(),
    )
    free, kept = (c.plan(problem((0.5, 0.0, 0.0), neighbour)) for c in (alone, together))
    assert free.status is PlanStatus.OK
    assert free.virtual_control[5, 0] < -0.02  # towards the reference
    assert kept.virtual_control[5, 0] > 0.02  # away from the neighbour that is too near


def test_times_are_measured_with_the_stopwatch() -> None:
    now_ns = iter(range(0, 10**9, 1000))  # every reading is 1 us after the last
    mpc = SwarmMpc(MpcParams(), builders.controller_setup(stopwatch_ns=lambda: next(now_ns)))
    neighbour = fixed(HERE + np.array([1.3, 0.0, 0.0]))
    times = mpc.plan(problem((0.1, 0.0, 0.0), neighbour)).times
    # read round both solves, the half-spaces and the certificate
    assert (times.spaces_us, times.solve_us, times.certify_us) == (1.0, 2.0, 1.0)


@pytest.mark.parametrize("horizon_z", [3, 40])
def test_one_move_for_two_conditions_at_the_end_is_planned_and_not_an_exception(horizon_z: int) -> None:
    plan = plan_to((0.0, 0.0, -0.1), control_z=1, horizon_z=horizon_z, terminal_z="position_velocity")
    assert plan.status is PlanStatus.OK
    assert plan.terminal_gap_m > 0.0


@pytest.mark.parametrize("terminal", ["position", "position_velocity"])
@pytest.mark.parametrize("ahead", ["planned", "held"])
def test_falling_without_thrust_is_planned_and_not_an_exception(ahead: str, terminal: str) -> None:
    falling = start(virtual_control=(0.0, 0.0, 0.0))  # no thrust now, none wanted: tilting moves nothing
    plan = plan_to((0.0, 0.0, 100.0), begin=falling, terminal_xy=terminal, thrust_ahead=ahead)
    assert plan.virtual_control[0, 2] == pytest.approx(0.0, abs=0.1)
    assert plan.status is PlanStatus.OK


def test_on_its_side_a_vehicle_gets_a_plan_and_not_an_exception() -> None:
    plan = plan_to(
        (0.0, 0.0, -0.1),
        begin=builders.start(pos_ned_m=HERE, cos_tilt=0.0, virtual_control=np.array([0.0, 0.0, G])),
    )
    assert np.isfinite(plan.pos_ned_m).all()


def wide(place: Array, radius_m: float, any_height: bool = False) -> KeepOut:
    return builders.keep_out(
        pos_ned_m=np.tile(place, (41, 1)), radius_m=radius_m, hard_min_distance_m=radius_m - 0.1, any_height=any_height
    )


@pytest.mark.parametrize(
    "pressing",
    [wide(HERE + np.array([4.2, 0.0, 0.0]), 4.0), wide(HERE + np.array([1.0, 0.0, 9.0]), 0.9, any_height=True)],
    ids=["large", "at any height"],
)
def test_slots_go_to_the_keep_outs_with_the_nearest_surface(pressing: KeepOut) -> None:
    harmless = wide(HERE + np.array([0.0, 2.0, 0.0]), 0.9)
    guess = np.tile(HERE, (41, 1))
    assert closest_keep_outs([harmless, pressing], guess, 1)[0] is pressing


@pytest.mark.parametrize("terminal", ["position", "position_velocity"])
def test_distances_have_priority_over_the_terminal_condition(terminal: str) -> None:
    # the reference has moved into a neighbour's place; the end can be met in time, by flying into it
    neighbour = fixed(HERE + np.array([0.9, 0.0, 0.0]))
    plan = plan_to((0.03, 0.0, 0.0), neighbour, terminal_xy=terminal, terminal_z="none")
    assert plan.slack_m < 0.01
    assert np.linalg.norm(plan.pos_ned_m - neighbour.pos_ned_m, axis=1).min() > 0.9 - 0.01


@pytest.mark.parametrize("kind", ["dmpc", "dmpc3"])
def test_from_rest_peers_beyond_the_gate_are_avoided(kind: Literal["dmpc", "dmpc3"]) -> None:
    """Two peers and the reference go round a circle; the guess stands still, farther than the gate from all of them.

    Of three PX4 one that had stopped found no plan for 5 s, until it gave up.
    """

    def on_circle(begins_ned_m: tuple[float, float, float], steps: int) -> Array:
        turned = 0.5 * 0.05 * np.arange(steps + 1)  # 0.5 rad/s
        c, s, (n, e, d) = np.cos(turned), np.sin(turned), begins_ned_m
        return np.stack([c * n - s * e, s * n + c * e, np.full(steps + 1, d)], axis=1)

    peers = [on_circle(begins, 40) for begins in ((-0.75, 4.91, -3.3), (0.92, 4.89, -3.3))]
    ahead = on_circle((-0.1, 5.0, -3.4), 100)
    along = Reference(ahead, np.gradient(ahead, 0.05, axis=0), 0.0)
    params = ControllerParams(kind=kind, mpc=MpcParams(dt_s=0.05, control_xy=20, u_max=0.75))
    mpc = make_controller(params, builders.controller_setup(separation=SeparationParams(radius_m=1.6), agent=1))
    keep_outs = tuple(
        builders.keep_out(pos_ned_m=path, radius_m=1.6, hard_min_distance_m=1.55, priority_id=priority_id)
        for path, priority_id in zip(peers, (0, 2), strict=True)
    )
    at_rest = start(np.array([0.45, -0.13, -2.5]))
    assert (
        mpc.plan(
            Problem(
                start=at_rest, reference=along, disturbance_ned_m_s2=np.zeros(3), keep_outs=keep_outs, guess_ned_m=None
            )
        ).status
        is PlanStatus.OK
    )
