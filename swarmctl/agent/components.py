"""Factories for the components of an agent, each built from `AgentSetup`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from swarmctl.agent.flying.safety_filter import SafetyFilter
from swarmctl.agent.planning.coordination import Coordination
from swarmctl.agent.planning.reference_selector import ReferenceSelector
from swarmctl.agent.planning.rehearsal import Rehearsal
from swarmctl.agent.planning.separation_policy import BestEffort, Guaranteed, SeparationPolicy
from swarmctl.agent.ports import Ports
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.sharing.interest import Interest
from swarmctl.agent.sharing.telemetry_publisher import TelemetryPublisher
from swarmctl.control.commit.commit_params import CommitParams, following, interpolation_margin_m
from swarmctl.control.commit.reach import FarPeers
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.controllers.discovery import ControllerParams, make_controller
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.estimation.disturbance import DisturbanceObserver
from swarmctl.control.estimation.state_filter import StateFilter
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.phases.mission_state import MissionSetup, MissionState
from swarmctl.control.phases.state_machine import MissionStateMachine
from swarmctl.control.reference.mission import MissionReference
from swarmctl.core.trajectory import grid
from swarmctl.mavlink.vehicle_setup import VehicleSetup

Stopwatch = Callable[[], int]  # returns a running time [ns]


def _best_effort(setup: AgentSetup, ports: Ports, world_model: WorldModel) -> SeparationPolicy:
    return BestEffort(world_model)


def _guaranteed(setup: AgentSetup, ports: Ports, world_model: WorldModel) -> SeparationPolicy:
    commit = setup.params.commit.for_vehicle(setup.vehicle_model)
    coordination = Coordination(
        agent=setup.agent,
        boot_id=setup.boot_id,
        peers=setup.peers,
        params=commit,
        planner=_make_trajectory_planner(setup, ports.stopwatch_ns),
        separation=setup.separation,
        world_model=world_model,
        bus=ports.bus,
        utc_us=ports.clock.utc_us,
        note=ports.note,
        rate_hz=setup.params.rate_hz,
        far_peers=_make_far_peers(setup, commit, world_model),
        far_hz=setup.params.path_sharing.far_hz,
    )
    return Guaranteed(coordination, setup.mission.yaw_rad, ports.stopwatch_ns)


def _make_far_peers(setup: AgentSetup, commit: CommitParams, world_model: WorldModel) -> FarPeers:
    sharing, separation = setup.params.path_sharing, setup.separation
    speed_m_s = sharing.speed_m_s if sharing.far_hz else 0.0
    spare_m = interpolation_margin_m(setup.controller.mpc, commit, setup.vehicle_model)
    return FarPeers(
        setup.peers,
        speed_m_s=speed_m_s,
        stretch_m=commit.stretch_m(speed_m_s),
        apart_m=separation.downwash * (separation.budget.committed_m + spare_m),
        ahead_us=world_model.clocks.ahead_us,
    )


def _make_trajectory_planner(setup: AgentSetup, stopwatch_ns: Stopwatch) -> TrajectoryPlanner:
    return TrajectoryPlanner(
        setup.agent,
        setup.params.commit.for_vehicle(setup.vehicle_model),
        setup.controller.mpc,
        setup.vehicle_model,
        setup.separation,
        max_keep_outs=setup.max_keep_outs,
        stopwatch_ns=stopwatch_ns,
        volume=setup.volume,
    )


def _following(setup: AgentSetup) -> ControllerParams:
    return setup.controller.model_copy(update={"mpc": following(setup.controller.mpc, setup.params.commit)})


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationMode:
    """A row of the table of separation modes: the policy, and the controller that suits it."""

    policy: Callable[[AgentSetup, Ports, WorldModel], SeparationPolicy]
    controller: Callable[[AgentSetup], ControllerParams]
    trajectory_planner: Callable[[AgentSetup, Stopwatch], TrajectoryPlanner | None]  # None: it plans no trajectories


SEPARATION_MODES = {  # by `separation.mode`
    "best_effort": SeparationMode(
        policy=_best_effort, controller=lambda setup: setup.controller, trajectory_planner=lambda *_: None
    ),
    "guaranteed": SeparationMode(
        policy=_guaranteed, controller=_following, trajectory_planner=_make_trajectory_planner
    ),
}


def make_separation_policy(setup: AgentSetup, ports: Ports, world_model: WorldModel) -> SeparationPolicy:
    """Return the policy that keeps the agent apart from its peers."""
    return SEPARATION_MODES[setup.separation.mode].policy(setup, ports, world_model)


def make_world_model(setup: AgentSetup, ports: Ports) -> WorldModel:
    """Return what the agent knows of peers and obstacles: nothing yet."""
    return WorldModel(
        setup.agent,
        setup.peers,
        setup.separation,
        ports.bus,
        utc_us=ports.clock.utc_us,
        rate_hz=setup.params.rate_hz,
        path_s=setup.params.path_sharing.longest_s(setup.params.rate_hz),
        note=ports.note,
        vouchers=setup.vouchers,
        quorum=setup.quorum,
        model=setup.vehicle_model,
        loss_s=lambda: (ports.autopilot.setpoint_loss_s, ports.autopilot.landing_delay_s),
    )


def make_vehicle_setup(setup: AgentSetup, ports: Ports) -> VehicleSetup:
    """Return what sets up the vehicle's link and the parameters that the flight needs."""
    return VehicleSetup(
        ports.autopilot,
        ports.commands,
        setup.params.autopilot_params,
        setup.sysid,
        state_rate_hz=setup.params.state_machine.state_rate_hz,
        note=ports.note,
        originals=setup.originals,
    )


def make_controllers(setup: AgentSetup, stopwatch_ns: Stopwatch) -> tuple[Controller, Controller]:
    """Return the controller for the mission and the one for the transits to the start and to the landing place."""
    params = SEPARATION_MODES[setup.separation.mode].controller(setup)
    told = _controller_setup(setup, stopwatch_ns)
    mission = make_controller(params, told)
    if params.follows_reference:
        return mission, mission
    return mission, make_controller(params.model_copy(update={"kind": "dmpc"}), told)


def make_rehearsal(setup: AgentSetup, ports: Ports, world_model: WorldModel) -> Rehearsal:
    """Return what plans before the vehicle flies; an own controller is called in flight only."""
    mode = SEPARATION_MODES[setup.separation.mode]
    params = mode.controller(setup)
    if params.is_own:
        params = params.model_copy(update={"kind": "dmpc"})
    return Rehearsal(
        make_controller(params, _controller_setup(setup, ports.stopwatch_ns)),
        mode.trajectory_planner(setup, ports.stopwatch_ns),
        round(1e6 * setup.params.commit.period_s),
        world_model,
    )


def _controller_setup(setup: AgentSetup, stopwatch_ns: Stopwatch) -> ControllerSetup:
    return ControllerSetup(
        vehicle=setup.vehicle_model,
        separation=setup.separation,
        agent=setup.agent,
        max_keep_outs=setup.max_keep_outs,
        stopwatch_ns=stopwatch_ns,
        volume=setup.volume,
    )


def make_estimator(setup: AgentSetup) -> DisturbanceObserver | StateFilter:
    """Return the estimator of state and disturbance that the configuration asks for."""
    params, model = setup.params, setup.vehicle_model
    if params.state_filter.enabled:
        return StateFilter(params.state_filter, params.disturbance, model)
    return DisturbanceObserver(params.disturbance, model.hover_thrust_01, model.drag_1_s)


def make_safety_filter(setup: AgentSetup, ports: Ports, world_model: WorldModel) -> SafetyFilter:
    """Return the safety filter that keeps the vehicle clear of the bodies around it."""
    return SafetyFilter(
        setup.params.barrier,
        setup.vehicle_model,
        1.0 / setup.params.rate_hz,
        world_model,
        downwash=setup.separation.downwash,
        note=ports.note,
        stopwatch_ns=ports.stopwatch_ns,
    )


def make_interest(setup: AgentSetup, ports: Ports, world_model: WorldModel, controller: Controller) -> Interest:
    """Return what chooses the peers whose every path is heard."""
    return Interest(
        setup.params.path_sharing,
        setup.separation,
        ports.bus,
        world_model.paths,
        setup.peers,
        horizon_s=controller.steps * controller.dt_us * 1e-6,
    )


def make_reference_selector(
    setup: AgentSetup, ports: Ports, mission: MissionState, controller: Controller, delay_us: int
) -> ReferenceSelector:
    """Return what selects the reference of plans, which begin `delay_us` from now, where a setpoint acts."""
    ahead_s = delay_us * 1e-6 + controller.dt_us * 1e-6 * grid(controller.longest)  # (longest+1,)
    return ReferenceSelector(setup, mission, ahead_s, ports.note)


def make_telemetry_publisher(
    setup: AgentSetup, ports: Ports, world_model: WorldModel, separation: SeparationPolicy
) -> TelemetryPublisher:
    """Return what records and publishes the agent's ticks."""
    return TelemetryPublisher(
        setup.agent,
        setup.boot_id,
        setup.sysid,
        separation.uses_commitments,
        code=setup.code,
        autopilot=ports.autopilot,
        paths=world_model.paths,
        lags_us=world_model.statuses.next_lags_us,
        bus=ports.bus,
        clock=ports.clock,
        sink=ports.sink,
    )


def make_state_machine(setup: AgentSetup) -> MissionStateMachine:
    """Return the state machine of the agent's mission."""
    budget = setup.separation.budget
    reference = MissionReference(setup.mission, setup.starts_ned_m, setup.agent, budget.planned_m)
    mission = MissionSetup(
        agent=setup.agent,
        peers=len(setup.peers),
        landing_m=budget.landing_m(setup.params.state_machine.apart_m),
        home_m=budget.home_m,
        start_ned_m=setup.starts_ned_m[setup.agent],
        brake_m_s2=min(setup.separation.brake_m_s2, setup.controller.mpc.accel_max_m_s2(setup.vehicle_model)),
        duration_s=setup.mission.duration_s,
        reference=reference,
        contains=lambda at_ne_m: setup.fence is None or setup.fence.contains(at_ne_m),
        volume=setup.volume,
        has_ground=setup.has_ground,
    )
    return MissionStateMachine(setup.params.state_machine, mission)
