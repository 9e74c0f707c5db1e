"""Model-only flights, as the thesis flew them: no MAVLink, no agent process, one sample time for everything.

Every 0.02 s each controller gets the true state of its vehicle and the paths its peers shared one step ago, and its
attitude and thrust act at once. Controllers, half-spaces, certificate and plant are those of the full MAVLink loop. The
bridge is missing: no estimate of the hover thrust, no phases, no failsafe but the replay of the last certified plan.
"""

from __future__ import annotations

import time
from functools import partial

import numpy as np

from sitl.plant.airframes import PRESETS
from sitl.plant.attitude import THESIS_GAINS, THESIS_SAMPLE_S, ThesisAttitude
from sitl.plant.vehicle import Plant
from sitl.studies.thesis.trace import Trace
from swarmctl.config import Config
from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.collision.separation import keep_out_of_obstacle, keep_out_of_peer, visible
from swarmctl.control.controllers.discovery import make_controller
from swarmctl.control.estimation.disturbance import DisturbanceObserver
from swarmctl.control.fallback import brake_and_hold_plan
from swarmctl.control.model import Predictor
from swarmctl.control.mpc.controller_setup import ControllerSetup
from swarmctl.control.mpc.plan_buffer import PlanBuffer
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.reference.mission import MissionReference
from swarmctl.control.setpoint import setpoint_of
from swarmctl.core.frames import GRAVITY_M_S2, euler_from_quat
from swarmctl.core.types import (
    Array,
    AttitudeSetpoint,
    FlightMode,
    Landed,
    Plan,
    PlanStatus,
    PredictedPath,
    Reference,
    VehicleState,
)

STEP_US = round(THESIS_SAMPLE_S * 1e6)
_TERMINAL_MET_M = 0.01


class Pilot:
    """The controller of one vehicle and its state between steps."""

    def __init__(self, config: Config, agent: int) -> None:
        self._config, self._agent = config, agent
        max_keep_outs = min(config.swarm.agents - 1, config.separation.max_neighbours) + len(config.obstacles)
        self._controller = make_controller(
            config.controller,
            ControllerSetup(
                vehicle=config.vehicle_model,
                separation=config.separation,
                agent=agent,
                max_keep_outs=max_keep_outs,
                stopwatch_ns=time.perf_counter_ns,
            ),
        )
        self._dt_us, self._steps = self._controller.dt_us, self._controller.steps
        self._predictor = Predictor(config.vehicle_model)
        hover_01 = PRESETS["thesis"].mass_kg * GRAVITY_M_S2 / PRESETS["thesis"].thrust_max_n
        self._observer = DisturbanceObserver(config.agent.disturbance, hover_01, config.vehicle_model.drag_1_s)
        starts = np.array(config.starts_ned_m())
        self._reference = MissionReference(config.mission, starts, agent, config.separation.budget.planned_m)
        self._virtual_control = np.array([0.0, 0.0, GRAVITY_M_S2])
        self._thrust_01 = hover_01
        brake_m_s2 = config.separation.brake_m_s2
        self._plan_buffer = PlanBuffer(agent, self._dt_us, self._steps, brake_m_s2)
        self._replay_us = min(round(config.agent.failsafe.replay_s * 1e6), self._steps * self._dt_us - 1)
        self._obstacles = config.obstacles
        self.path: PredictedPath | None = None
        self.failed = 0
        self.terminal_missed = 0

    def reference_ned_m(self, t_us: int) -> Array:
        """Return the reference position now, (3,)."""
        return np.asarray(self._reference.sample(np.array([t_us * 1e-6]))[0][0])

    def prime(self, state: VehicleState) -> None:
        """Plan to stay and share the plan, as an agent does before the mission, so that errors begin at zero."""
        act_us = state.t_us + self._predictor.delay_us
        start = Start(
            t_us=act_us - self._dt_us,
            pos_ned_m=state.pos_ned_m,
            vel_ned_m_s=state.vel_ned_m_s,
            cos_tilt=1.0,
            virtual_control=self._virtual_control,
        )
        points, yaw_rad = self._controller.longest + 1, self._config.mission.yaw_rad
        stay = Reference(np.tile(state.pos_ned_m, (points, 1)), np.zeros((points, 3)), yaw_rad)
        plan = self._controller.plan(
            Problem(start=start, reference=stay, disturbance_ned_m_s2=np.zeros(3), keep_outs=(), guess_ned_m=None)
        )
        self.path = self._path(self._flown(plan, start, ()))

    def step(self, state: VehicleState, peers: list[PredictedPath]) -> AttitudeSetpoint:
        """Return the setpoint of this step; `path` is what peers receive of it."""
        now_us, estimate = state.t_us, self._observer.estimate
        act_us = now_us + self._predictor.delay_us
        start = self._predictor.start(state, act_us, estimate.disturbance_ned_m_s2, self._virtual_control)
        keep_outs = self._keep_outs(state.pos_ned_m, act_us, peers)
        plan = self._controller.plan(
            Problem(
                start=start,
                reference=self._horizon(act_us),
                disturbance_ned_m_s2=estimate.disturbance_ned_m_s2,
                keep_outs=keep_outs,
                guess_ned_m=self._plan_buffer.guess_ned_m(act_us),
            )
        )
        self.terminal_missed += plan.terminal_gap_m > _TERMINAL_MET_M
        flown = self._flown(plan, start, keep_outs)
        self.path = self._path(flown)
        self._virtual_control = flown.virtual_control[
            min((act_us - flown.t0_us) // self._dt_us, len(flown.virtual_control) - 1)
        ]
        self._predictor.sent(now_us, self._virtual_control)
        setpoint = setpoint_of(
            self._virtual_control,
            self._config.mission.yaw_rad,
            estimate.hover_thrust_01,
            now_us,
            params=self._config.vehicle_model,
        )
        self._thrust_01 = setpoint.thrust_01
        return setpoint

    def observe(self, state: VehicleState) -> None:
        """Update the estimate from the effect of the last setpoint."""
        self._observer.update(state, self._thrust_01)

    def _horizon(self, act_us: int) -> Reference:
        t_s = np.asarray((act_us + np.arange(self._controller.longest + 1) * self._dt_us) * 1e-6, np.float64)
        return Reference(*self._reference.sample(t_s), self._config.mission.yaw_rad)

    def _keep_outs(self, pos_ned_m: Array, act_us: int, peers: list[PredictedPath]) -> tuple[KeepOut, ...]:
        params, dt_us, steps = self._config.separation, self._dt_us, self._steps
        found = [keep_out_of_peer(path, act_us, dt_us, steps, params=params) for path in peers]
        seen = visible(self._obstacles, pos_ned_m)
        return (*found, *(keep_out_of_obstacle(o, dt_us, steps, params) for o in seen))

    def _flown(self, plan: Plan, start: Start, keep_outs: tuple[KeepOut, ...]) -> Plan:
        disturbance = self._observer.estimate.disturbance_ned_m_s2
        drag_1_s = self._config.vehicle_model.drag_1_s
        stop = partial(
            brake_and_hold_plan,
            start,
            None,
            disturbance,
            None,
            drag_1_s=drag_1_s,
            dt_us=self._dt_us,
            steps=self._steps,
        )
        self._plan_buffer.take(plan, start, keep_outs, stop)
        if plan.status is PlanStatus.OK:
            return plan
        self.failed += 1
        good = self._plan_buffer.plan
        return stop() if good is None or start.t_us - good.t0_us > self._replay_us else good

    def _path(self, plan: Plan) -> PredictedPath:
        return PredictedPath(
            agent=self._agent,
            boot_id=1,
            seq=1,
            t0_utc_us=plan.t0_us,
            dt_us=plan.dt_us,
            margin_m=0.0,
            pos_ned_m=plan.pos_ned_m,
        )


def fly_on_plant(name: str, config: Config, *, matched_velocity: bool = False) -> Trace:
    """Fly a configuration's mission on the thesis plant and return its trace.

    Args:
        name: of the trace.
        config: mission, starts, controller, obstacles; the vehicle is the thesis' at 0.02 s.
        matched_velocity: begin with the reference's velocity instead of at rest.
    """
    agents, steps = config.swarm.agents, round(config.mission.duration_s / THESIS_SAMPLE_S)
    plant = Plant(PRESETS["thesis"], np.array(config.starts_ned_m()), THESIS_SAMPLE_S, ground=False)
    attitude = ThesisAttitude(agents, THESIS_SAMPLE_S, THESIS_GAINS[config.sitl.attitude_gains])
    pilots = [Pilot(config, i) for i in range(agents)]
    if matched_velocity:
        first = MissionReference(config.mission, np.array(config.starts_ned_m()), 0).sample(np.zeros(1))[1]
        plant.state[7:10] = first.T  # level and nose north: body axes are NED's
        plant.refresh()
    log = {key: np.zeros((steps, agents, 3)) for key in ("pos", "vel", "euler", "ref", "euler_ref", "torque")}
    thrust_n = np.zeros((steps, agents))
    wrench = np.zeros((4, agents))
    for i, pilot in enumerate(pilots):
        pilot.prime(_state(plant, i, 0))
    for k in range(steps):
        states = [_state(plant, i, k * STEP_US) for i in range(agents)]
        if k:
            for pilot, state in zip(pilots, states, strict=True):
                pilot.observe(state)
        shared = [pilot.path for pilot in pilots]  # of the step before
        for i, pilot in enumerate(pilots):
            peers = [path for j, path in enumerate(shared) if j != i and path is not None]
            setpoint = pilot.step(states[i], peers)
            attitude.set_reference(i, setpoint.q_nb)
            wrench[0, i] = setpoint.thrust_01 * plant.preset.thrust_max_n
            log["euler_ref"][k, i] = euler_from_quat(setpoint.q_nb)
            log["ref"][k, i] = pilot.reference_ned_m(k * STEP_US)
        log["pos"][k], log["vel"][k], log["euler"][k] = plant.pos_ned_m.T, plant.vel_ned_m_s.T, plant.euler_rad.T
        attitude.torque(plant, np.ones(agents), wrench[1:])
        thrust_n[k], log["torque"][k] = wrench[0], wrench[1:].T
        plant.step(plant.mixer.allocate(wrench))
    return Trace(
        name=name,
        path="plant",
        t_s=np.asarray(np.arange(steps) * THESIS_SAMPLE_S, np.float64),
        pos_ned_m=log["pos"],
        vel_ned_m_s=log["vel"],
        euler_rad=log["euler"],
        ref_pos_ned_m=log["ref"],
        euler_ref_rad=log["euler_ref"],
        thrust_n=thrust_n,
        torque_n_m=log["torque"],
        failed=sum(pilot.failed for pilot in pilots),
        terminal_missed=sum(pilot.terminal_missed for pilot in pilots),
        obstacles=config.obstacles,
    )


def _state(plant: Plant, i: int, t_us: int) -> VehicleState:
    return VehicleState(
        t_us=t_us,
        pos_ned_m=plant.pos_ned_m[:, i].copy(),
        vel_ned_m_s=plant.vel_ned_m_s[:, i].copy(),
        q_nb=plant.q_nb[:, i].copy(),
        rate_frd_rad_s=plant.rate_frd_rad_s[:, i].copy(),
        armed=True,
        mode=FlightMode.EXTERNAL,
        landed=Landed.IN_AIR,
        failsafe=False,
    )
