"""What an agent knows of its own motion agrees with what its controller takes for granted: nothing counts twice."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from swarmctl.agent import assembly
from swarmctl.agent.components import make_estimator
from swarmctl.agent.sensing.own_state import OwnState
from swarmctl.config import load
from swarmctl.control.controllers.discovery import make_controller
from swarmctl.control.mpc.problem import Problem
from swarmctl.core.frames import GRAVITY_M_S2, quat_from_body_z
from swarmctl.core.types import Array, FlightMode, Plan, Reference
from tests import builders

STEP_S = 0.02
DRAG_1_S = 1.0
SPEED_M_S = 4.0
HOVER_01 = 0.5


def flown(*overrides: str, ticks: int) -> Iterator[tuple[Array, Plan, OwnState]]:
    """Fly a point mass with drag along a straight line; yield its exact position and the plan of every tick."""
    given = ("swarm.agents=1", "vehicle_model.delay_s=0", "controller.mpc.u_max=0.5", *overrides)
    setup = assembly._setup_of(load(None, given), 0, 1, {})
    model = setup.vehicle_model
    controller = make_controller(setup.controller, builders.controller_setup(vehicle=model))
    own = OwnState(model, make_estimator(setup))
    pos, vel, down = np.array([0.0, 0.0, -5.0]), np.zeros(3), np.array([0.0, 0.0, 1.0])
    ahead_s = STEP_S * np.arange(controller.longest + 1)
    for tick in range(ticks):
        t_us = round(tick * STEP_S * 1e6)
        state = builders.vehicle_state(t_us=t_us, pos_ned_m=pos, vel_ned_m_s=vel, q_nb=quat_from_body_z(down, 0.0))
        own.update(state, None, controls=True)
        at_m = np.zeros((len(ahead_s), 3))
        at_m[:, 0], at_m[:, 2] = SPEED_M_S * (tick * STEP_S + ahead_s), -5.0
        plan = controller.plan(
            Problem(
                start=own.start(state, t_us, controls=True),
                reference=Reference(at_m, np.tile([SPEED_M_S, 0.0, 0.0], (len(ahead_s), 1)), 0.0),
                disturbance_ned_m_s2=own.estimate.disturbance_ned_m_s2,
                keep_outs=(),
                guess_ned_m=None,
            )
        )
        yield pos, plan, own
        ux, uy, thrust_m_s2 = plan.virtual_control[0].tolist()
        own.sent(t_us, plan.virtual_control[0], own.estimate.hover_thrust_01 * thrust_m_s2 / GRAVITY_M_S2)
        down = np.array([ux, uy, math.sqrt(1.0 - ux * ux - uy * uy)])
        accel = np.array([0.0, 0.0, GRAVITY_M_S2]) - thrust_m_s2 * down
        kept = math.exp(-DRAG_1_S * STEP_S)
        gained_s = (1.0 - kept) / DRAG_1_S
        pos = pos + gained_s * vel + (STEP_S - gained_s) / DRAG_1_S * accel
        vel = kept * vel + gained_s * accel


@pytest.mark.parametrize("filtered", [False, True])
def test_a_vehicle_with_drag_flies_what_is_planned_along_its_reference(filtered: bool) -> None:
    overrides = (f"vehicle_model.drag_1_s={DRAG_1_S}", f"agent.state_filter.enabled={str(filtered).lower()}")
    ticks = list(flown(*overrides, ticks=400))
    pos, _, own = ticks[-1]
    np.testing.assert_allclose(own.estimate.disturbance_ned_m_s2, 0.0, atol=0.02)
    assert np.linalg.norm(pos - [399 * STEP_S * SPEED_M_S, 0.0, -5.0]) < 0.02
    planned = ticks[-41][1].pos_ned_m[40]
    np.testing.assert_allclose(pos, planned, atol=0.02)


@pytest.mark.parametrize(("thrust_01", "within_01"), [(0.49, 0.0), (0.65, 0.06), (0.35, 0.06)])
def test_the_end_of_a_climb_tells_a_hover_thrust_that_is_far_off(thrust_01: float, within_01: float) -> None:
    setup = assembly._setup_of(load(None, ["swarm.agents=1"]), 0, 1, {})
    own = OwnState(setup.vehicle_model, make_estimator(setup))
    for tick in range(50):
        own.update(builders.vehicle_state(t_us=20_000 * tick, mode=FlightMode.TAKEOFF), thrust_01, controls=False)
    learned = thrust_01 if within_01 else HOVER_01  # a vehicle that slows down takes a little less than to hover
    assert own.estimate.hover_thrust_01 == pytest.approx(learned, rel=within_01, abs=0.0)
