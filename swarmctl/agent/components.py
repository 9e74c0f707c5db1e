"""Factories for the components of an agent, each built from `AgentSetup`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from swarmctl.agent.coordination import Coordination
from swarmctl.agent.safety_filter import SafetyFilter
from swarmctl.agent.separation_policy import BestEffort, Guaranteed, SeparationPolicy
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.world_model import WorldModel
from swarmctl.bus.peers import Bus
from swarmctl.control.commit.trajectory_planner import following
from swarmctl.control.controllers.discovery import ControllerParams, make_controller
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.estimation.disturbance import DisturbanceObserver
from swarmctl.control.estimation.state_filter import StateFilter
from swarmctl.control.phases.state_machine import MissionStateMachine
from swarmctl.control.reference.mission import MissionReference
from swarmctl.mavlink.geofence import is_inside

Note = Callable[..., None]
Stopwatch = Callable[[], int]  # returns a running time [ns]


def _best_effort(
    setup: AgentSetup, world_model: WorldModel, bus: Bus, note: Note, *, stopwatch_ns: Stopwatch
) -> SeparationPolicy:
    return BestEffort(world_model)


def _guaranteed(
    setup: AgentSetup, world_model: WorldModel, bus: Bus, note: Note, *, stopwatch_ns: Stopwatch
) -> SeparationPolicy:
    coordination = Coordination(
        agent=setup.agent,
        boot_id=setup.boot_id,
        peers=setup.peers,
        params=setup.params.commit,
        mpc=setup.controller.mpc,
        vehicle=setup.vehicle_model,
        separation=setup.separation,
        volume=setup.volume,
        max_keep_outs=setup.max_keep_outs,
        world_model=world_model,
        bus=bus,
        note=note,
        stopwatch_ns=stopwatch_ns,
        rate_hz=setup.params.rate_hz,
    )
    return Guaranteed(coordination, setup.mission.yaw_rad, stopwatch_ns)


def _following(setup: AgentSetup) -> ControllerParams:
    return setup.controller.model_copy(update={"mpc": following(setup.controller.mpc, setup.params.commit)})


class MakesPolicy(Protocol):
    """Makes the policy of a separation mode."""

    def __call__(
        self, setup: AgentSetup, world_model: WorldModel, bus: Bus, note: Note, *, stopwatch_ns: Stopwatch
    ) -> SeparationPolicy: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationMode:
    """A row of the table of separation modes: the policy, and the controller that suits it."""

    policy: MakesPolicy
    controller: Callable[[AgentSetup], ControllerParams]


SEPARATION_MODES = {  # by `separation.mode`
    "best_effort": SeparationMode(policy=_best_effort, controller=lambda setup: setup.controller),
    "guaranteed": SeparationMode(policy=_guaranteed, controller=_following),
}


def make_separation_policy(
    setup: AgentSetup, world_model: WorldModel, bus: Bus, note: Note, *, stopwatch_ns: Stopwatch
) -> SeparationPolicy:
    """Return the policy that keeps the agent apart from its peers."""
    return SEPARATION_MODES[setup.separation.mode].policy(setup, world_model, bus, note, stopwatch_ns=stopwatch_ns)


def make_controllers(setup: AgentSetup, stopwatch_ns: Stopwatch) -> tuple[Controller, Controller]:
    """Return the controller for the mission and the one for the transits to the start and to the landing place."""
    params = SEPARATION_MODES[setup.separation.mode].controller(setup)
    make = partial(
        make_controller,
        vehicle=setup.vehicle_model,
        separation=setup.separation,
        agent=setup.agent,
        max_keep_outs=setup.max_keep_outs,
        stopwatch_ns=stopwatch_ns,
        volume=setup.volume,
    )
    mission = make(params)
    if params.follows_reference:
        return mission, mission
    return mission, make(params.model_copy(update={"kind": "dmpc"}))


def make_estimator(setup: AgentSetup) -> DisturbanceObserver | StateFilter:
    """Return the estimator of state and disturbance that the configuration asks for."""
    params, model = setup.params, setup.vehicle_model
    if params.state_filter.enabled:
        return StateFilter(params.state_filter, params.disturbance, model)
    return DisturbanceObserver(params.disturbance, model.hover_thrust_01)


def make_safety_filter(setup: AgentSetup, world_model: WorldModel, note: Note, stopwatch_ns: Stopwatch) -> SafetyFilter:
    """Return the safety filter that keeps the vehicle clear of the bodies around it."""
    dt_s = 1.0 / setup.params.rate_hz
    downwash = setup.separation.downwash
    return SafetyFilter(
        setup.params.barrier,
        setup.vehicle_model,
        dt_s,
        world_model,
        downwash=downwash,
        note=note,
        stopwatch_ns=stopwatch_ns,
    )


def make_state_machine(setup: AgentSetup) -> MissionStateMachine:
    """Return the state machine of the agent's mission."""
    budget = setup.separation.budget
    reference = MissionReference(setup.mission, setup.starts_ned_m, setup.agent, budget.planned_m)
    return MissionStateMachine(
        setup.params.state_machine,
        setup.agent,
        len(setup.peers),
        budget.landing_m(setup.params.state_machine.apart_m),
        start_ned_m=setup.starts_ned_m[setup.agent],
        duration_s=setup.mission.duration_s,
        reference=reference,
        contains=lambda at_ne_m: not setup.fence_ne_m or is_inside(at_ne_m, setup.fence_ne_m),
        volume=setup.volume,
    )
