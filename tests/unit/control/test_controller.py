"""Every kind of controller a configuration can choose works behind the one interface."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import product
from typing import Any, Literal, get_args

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.controllers.discovery import CONTROLLERS, ControllerParams, make_controller
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.controllers.pid import PidParams
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.types import Array, Plan, PlanStatus, Reference
from tests import builders

G = 9.81
HERE = np.array([1.0, 2.0, -3.0])
Kind = Literal["dmpc", "dmpc3", "mpc", "pid", "open_loop"]
KINDS: tuple[Kind, ...] = get_args(Kind)
PLANNING: list[Kind] = ["dmpc", "dmpc3", "mpc"]


def make(kind: Kind, max_keep_outs: int = 2, **params: Any) -> Controller:
    return make_controller(
        ControllerParams(kind=kind, **params),
        builders.controller_setup(max_keep_outs=max_keep_outs, stopwatch_ns=time.perf_counter_ns),
    )


def hover(controller: Controller, offset: tuple[float, ...] = (0.0, 0.0, 0.0), *keep_outs: KeepOut) -> Problem:
    """At rest at HERE, asked to be `offset` from it; exactly as much reference as the controller says it needs."""
    points = controller.longest + 1
    reference = Reference(np.tile(HERE + offset, (points, 1)), np.zeros((points, 3)), 0.0)
    start = builders.start(t_us=7_000_000, pos_ned_m=HERE, virtual_control=np.array([0.0, 0.0, G]))
    return Problem(
        start=start, reference=reference, disturbance_ned_m_s2=np.zeros(3), keep_outs=keep_outs, guess_ned_m=None
    )


def near(controller: Controller, place: Array) -> KeepOut:
    return builders.keep_out(pos_ned_m=np.tile(place, (controller.steps + 1, 1)))


def check(controller: Controller, plan: Plan) -> None:
    steps = controller.steps
    assert plan.pos_ned_m.shape == plan.vel_ned_m_s.shape == (steps + 1, 3)
    assert plan.virtual_control.shape == (steps, 3)
    for values in (plan.pos_ned_m, plan.vel_ned_m_s, plan.virtual_control):
        assert np.isfinite(values).all()
    assert (plan.t0_us, plan.dt_us) == (7_000_000, controller.dt_us)
    np.testing.assert_array_equal(plan.pos_ned_m[0], HERE)
    assert min(plan.times.solve_us, plan.times.certify_us) >= 0.0


def test_the_kinds_are_those_tested_here() -> None:
    assert set(KINDS) == set(CONTROLLERS)


def test_every_section_with_parameters_belongs_to_a_kind() -> None:
    assert {kind.section: kind.params for kind in CONTROLLERS.values()} == {
        name: type(value) for name, value in ControllerParams() if name not in ("kind", "own")
    }
    assert [name for name, kind in CONTROLLERS.items() if not kind.follows_reference] == ["open_loop"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_plans_hovering(kind: Kind) -> None:
    controller = make(kind)
    plan = controller.plan(hover(controller))
    check(controller, plan)
    assert plan.status is PlanStatus.OK
    wanted = [0.0, 0.0, 0.0 if kind == "open_loop" else G]  # open loop is free fall (thesis 1.6)
    np.testing.assert_allclose(plan.virtual_control, np.tile(wanted, (controller.steps, 1)), atol=5e-3)


@pytest.mark.parametrize(
    ("terminal_z", "terminal_xy"), list(product(("none", "position", "position_velocity", "region"), repeat=2))
)
@pytest.mark.parametrize("kind", PLANNING)
def test_every_way_to_end_a_plan_can_be_chosen(kind: Kind, terminal_z: str, terminal_xy: str) -> None:
    controller = make(kind, mpc={"terminal_z": terminal_z, "terminal_xy": terminal_xy})
    for offset in ((0.0, 0.0, 0.0), (0.02, -0.01, 0.03), (3.0, 1.0, -2.0)):
        plan = controller.plan(hover(controller, offset))
        check(controller, plan)
        assert plan.status is PlanStatus.OK


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
@pytest.mark.parametrize(("control", "horizon"), [(2, 2), (6, 6), (6, 60), (20, 20)])
@pytest.mark.parametrize("discretisation", ["zoh", "euler"])
@pytest.mark.parametrize("kind", PLANNING)
def test_every_horizon_a_configuration_allows_can_be_flown(
    kind: Kind, discretisation: str, control: int, horizon: int, solver: str
) -> None:
    sizes = {"control_xy": control, "horizon_xy": horizon, "control_z": control, "horizon_z": horizon + 3}
    mpc = {**sizes, "discretisation": discretisation, "qp": {"solver": solver}}
    controller = make(kind, mpc=mpc)
    assert controller.steps == horizon
    assert controller.longest == (horizon if kind == "dmpc3" else horizon + 3)
    check(controller, controller.plan(hover(controller, (0.1, 0.0, -0.01))))


@pytest.mark.parametrize("kind", ["dmpc", "dmpc3"])
def test_without_slots_neighbours_are_still_certified(kind: Kind) -> None:
    controller = make(kind, max_keep_outs=0)
    plan = controller.plan(hover(controller, (0.5, 0.0, 0.0), near(controller, HERE + np.array([0.85, 0.0, 0.0]))))
    check(controller, plan)
    assert plan.status is PlanStatus.NOT_CERTIFIED


@pytest.mark.parametrize("guessed", [True, False])
def test_alone_keep_outs_change_nothing_at_all(guessed: bool) -> None:
    alone, free = make("mpc"), make("mpc")
    neighbour = near(alone, HERE + np.array([0.5, 0.0, 0.0]))
    guess = np.tile(HERE, (alone.steps + 1, 1)) if guessed else None
    asked = replace(hover(alone, (0.5, 0.0, 0.0), neighbour), guess_ned_m=guess)
    plan, same = alone.plan(asked), free.plan(replace(asked, keep_outs=()))
    assert plan.status is PlanStatus.OK
    np.testing.assert_array_equal(plan.virtual_control, same.virtual_control)
    np.testing.assert_array_equal(plan.pos_ned_m, same.pos_ned_m)
    for kind in ("dmpc", "dmpc3"):
        kept = make(kind)
        assert (
            kept.plan(asked).virtual_control[5, 0] > 0.02 > -0.02 > plan.virtual_control[5, 0]
        )  # away from it, not through it


@pytest.mark.parametrize("kind", KINDS)
def test_the_problem_is_not_modified(kind: Kind) -> None:
    controller = make(kind)
    asked = hover(controller, (0.5, 0.2, -0.3), near(controller, HERE + np.array([1.2, 0.0, 0.2])))
    asked = replace(asked, guess_ned_m=np.tile(HERE, (controller.steps + 1, 1)))
    arrays = [
        asked.start.pos_ned_m,
        asked.start.vel_ned_m_s,
        asked.start.virtual_control,
        asked.reference.pos_ned_m,
        asked.reference.vel_ned_m_s,
        asked.keep_outs[0].pos_ned_m,
        asked.guess_ned_m,
    ]
    for array in arrays:
        assert array is not None
        array.flags.writeable = False
    try:
        check(controller, controller.plan(asked))
    finally:
        HERE.flags.writeable = True


@pytest.mark.parametrize("kind", KINDS)
def test_two_of_a_kind_give_the_same_bits(kind: Kind) -> None:
    one, two = make(kind), make(kind)
    for offset in ((0.5, -0.2, -0.3), (3.0, 1.0, -8.0), (0.0, 0.0, 0.0)):
        plans = [c.plan(hover(c, offset, near(c, HERE + np.array([1.3, 0.0, 0.0])))) for c in (one, two)]
        np.testing.assert_array_equal(plans[0].virtual_control, plans[1].virtual_control)
        np.testing.assert_array_equal(plans[0].pos_ned_m, plans[1].pos_ned_m)


@pytest.mark.parametrize("kind", KINDS)
def test_after_a_reset_the_past_is_forgotten(kind: Kind) -> None:
    exact = {"qp": {"solver": "daqp"}}  # with which a warm start leaves no trace at all
    used, fresh = make(kind, mpc=exact), make(kind, mpc=exact)
    for offset in ((3.0, 1.0, -2.0), (5.0, -1.0, 2.0), (-4.0, 0.5, 0.0)):
        used.plan(hover(used, offset))
    used.reset()
    plans = [c.plan(hover(c, (0.2, 0.1, -0.1))) for c in (used, fresh)]
    np.testing.assert_allclose(plans[0].virtual_control, plans[1].virtual_control, atol=1e-6)
    np.testing.assert_allclose(plans[0].pos_ned_m, plans[1].pos_ned_m, atol=1e-6)


def test_a_pid_remembers_until_it_is_reset() -> None:
    pid = make("pid", pid={"x": (-0.25, -0.1, -0.3), "y": (0.05, 0.0, 0.45), "z": (-3.5, -0.1, -4.0)})
    first = pid.plan(hover(pid, (1.0, 0.0, -1.0))).virtual_control[0]
    kick = pid.plan(hover(pid, (2.0, 0.0, -1.0))).virtual_control[
        0
    ]  # the derivative of the error sees the reference jump
    assert kick[0] < first[0] - 0.1
    wound = pid.plan(hover(pid, (2.0, 0.0, -1.0))).virtual_control[0]
    pid.reset()
    again = pid.plan(hover(pid, (1.0, 0.0, -1.0))).virtual_control[0]
    np.testing.assert_array_equal(again, first)
    assert (wound != first).any()


@pytest.mark.parametrize(("axis", "entry"), [(0, 0), (1, 1), (2, 2)])
def test_pid_signs_and_feed_forward(axis: int, entry: int) -> None:
    offset = [0.0, 0.0, 0.0]
    offset[axis] = 0.1
    level = np.array([0.0, 0.0, G])
    pid = make("pid")
    towards = pid.plan(hover(pid, (offset[0], offset[1], offset[2]))).virtual_control[0] - level
    assert towards[entry] < 0.0  # north, east, down: x'' = -f u_x, y'' = -f u_y, z'' = g - f
    ahead = make("pid", pid=PidParams(accel_feed_forward=1.0))
    asked = hover(ahead)
    speed = asked.reference.vel_ned_m_s.copy()
    speed[1:, axis] = 0.5 * 0.02  # the reference accelerates by 0.5 m/s2
    asked = replace(asked, reference=replace(asked.reference, vel_ned_m_s=speed))
    lean = ahead.plan(asked).virtual_control[0] - level
    assert lean[entry] == pytest.approx(-0.5 / (1.0 if axis == 2 else G), rel=1e-3)
    np.testing.assert_allclose(
        make("pid").plan(asked).virtual_control[0], level, atol=1e-9
    )  # off by default, as in the thesis


def test_the_thesis_bounds_with_negative_thrust_are_allowed() -> None:
    mpc = MpcParams(thrust_min_m_s2=-20.0)
    for kind in PLANNING:
        controller = make(kind, mpc=mpc)
        plan = controller.plan(hover(controller, (0.0, 0.0, 50.0)))
        check(controller, plan)
        assert plan.virtual_control[:, 2].min() < -1.0
