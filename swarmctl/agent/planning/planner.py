"""Plans one tick: from where the next setpoint acts, along the reference, clear of what is known.

It does not decide whether the plan is flown: `agent.flying.mode_selector` does.
"""

from __future__ import annotations

import numpy as np

from swarmctl.agent.flying.mode_selector import ModeSelector
from swarmctl.agent.planning.reference_selector import ReferenceSelector
from swarmctl.agent.planning.rehearsal import Rehearsal
from swarmctl.agent.planning.separation_policy import SeparationDirective, SeparationInputs, SeparationPolicy
from swarmctl.agent.ports import Ports
from swarmctl.agent.sensing.own_state import OwnState
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.agent.setup import AgentSetup
from swarmctl.agent.tick_results import PlanningResult
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.agent.watches.volume_watch import VolumeWatch
from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.core.types import Mode, Phase, Plan, Reference, VehicleState

# modes in which the vehicle does not follow its committed trajectory
_DEVIATING_MODES = (Mode.BRAKE, Mode.HOLD, Mode.LAND, Mode.PILOT_OVERRIDE)


class Planner:
    """Asks the separation policy and the controller of one agent in every tick.

    Args:
        setup: parameters of the agent.
        ports: time; receives the events of the flight volume.
        world_model: what to keep clear of.
        own_state: where plans begin.
        mission: phase, and who has control.
        references: what plans follow.
        separation: keeps the agent apart from its peers.
        modes: mode of the newest tick, and the certified plan to linearise around.
        controller: for the mission.
        transit: controller for the ways to the start and to the landing place.
        rehearsal: plans before the vehicle is flown; None where no agent can be too slow.
        alerts: are told of deadlocks, of the flight volume and of peers that don't answer.

    Attributes:
        controller: for the mission; a bench may put another in its place.
        directive: the separation policy's of the newest tick.
    """

    def __init__(
        self,
        setup: AgentSetup,
        ports: Ports,
        world_model: WorldModel,
        own_state: OwnState,
        mission: MissionState,
        *,
        references: ReferenceSelector,
        separation: SeparationPolicy,
        modes: ModeSelector,
        controller: Controller,
        transit: Controller,
        rehearsal: Rehearsal | None,
        alerts: Alerts,
    ) -> None:
        self._utc_of_us, self._alerts = ports.utc_of_us, alerts
        self._world_model, self._own_state, self._mission = world_model, own_state, mission
        self._references, self._separation, self._modes = references, separation, modes
        self.controller, self._transit, self._rehearsal = controller, transit, rehearsal
        self.directive = SeparationDirective()
        self._volume_watch = VolumeWatch(setup.volume, ports.note)
        self._encounters = Encounters()
        ahead_us = np.arange(controller.longest + 1) * controller.dt_us  # (longest+1,)
        self._horizon_us = own_state.delay_us + ahead_us

    def plan(self, now_us: int, state: VehicleState | None) -> PlanningResult:
        """Return what is planned in this tick; nothing from a stale state, and no plan while the autopilot flies."""
        if state is None or not self._modes.is_fresh(now_us, state):
            # the autopilot flies the vehicle, on stale setpoints or by its failsafe
            self.directive = self._separation.wait(self._utc_of_us(now_us), state)
            return PlanningResult(start=None, plan=None, reference=None, keep_outs=[])
        mission = self._mission
        start = self._own_state.start(state, now_us + self._own_state.delay_us, controls=mission.had_control)
        keep_outs = self._keep_outs(state, start)
        flies = Phase.GOTO_START <= mission.phase <= Phase.GOTO_LAND
        controls = flies and mission.had_control
        if outside := self._volume_watch.update(now_us, state, controls):
            self._alerts.put("volume", outside, now_us)
        self._references.look_ahead(now_us, self._utc_of_us(now_us))
        self._detect_deadlock(now_us, state, keep_outs, controls)
        reference, now_ref = self._references.reference(state.pos_ned_m, state.vel_ned_m_s)
        self.directive = self._separate(now_us, state, keep_outs, controls)
        plan = self._solve(now_us, start, reference) if flies else None
        if self._rehearsal is not None and Phase.STANDBY <= mission.phase < Phase.GOTO_START:
            self._rehearsal.plan(self._utc_of_us(now_us), start, mission.climb.rest_ned_m(state), keep_outs)
        followed_z_m, known = self._references.followed_z_m, list(keep_outs)
        return PlanningResult(start=start, plan=plan, reference=now_ref, keep_outs=known, followed_z_m=followed_z_m)

    def reset(self) -> None:
        """Forget what the controllers remember: until now the vehicle was flown by its autopilot."""
        self.controller.reset()
        if self._transit is not self.controller:
            self._transit.reset()

    def _keep_outs(self, state: VehicleState, start: Start) -> KeepOuts:
        """Return what to keep clear of from the start of the plan on."""
        near = self._world_model.keep_outs(
            state.pos_ned_m,
            self._utc_of_us(start.t_us),
            self.controller.dt_us,
            self.controller.steps,
            phase=self._mission.phase,
        )
        return self._encounters.noted(near, start.pos_ned_m)

    def _detect_deadlock(self, now_us: int, state: VehicleState, keep_outs: KeepOuts, controls: bool) -> None:
        if not controls:
            self._references.reset(now_us)
            return
        known = (*keep_outs, *self.directive.lost_peer_keep_outs)
        landmarks = self._world_model.obstacles.landmarks
        deadlock = self._references.update(now_us, self._utc_of_us(now_us), state.pos_ned_m, known, landmarks=landmarks)
        if deadlock is not None:
            self._alerts.put("deadlock", f"deadlocked by {deadlock.names}", now_us)

    def _separate(self, now_us: int, state: VehicleState, keep_outs: KeepOuts, controls: bool) -> SeparationDirective:
        """Return this tick's directive; its reference begins where the setpoint acts."""
        utc_us = self._utc_of_us(now_us)
        if not controls or self._modes.mode in _DEVIATING_MODES:
            return self._separation.idle(utc_us, state, keep_outs)
        return self._separation.step(
            SeparationInputs(
                utc_us=utc_us,
                state=state,
                state_utc_us=self._utc_of_us(state.t_us),
                phase=self._mission.phase,
                desired=self._references.desired(now_us, utc_us),
                horizon_utc_us=utc_us + self._horizon_us,
                keep_outs=keep_outs,
                disturbance_ned_m_s2=self._own_state.estimate.disturbance_ned_m_s2,
            )
        )

    def _solve(self, now_us: int, start: Start, reference: Reference) -> Plan:
        """Return the controller's plan along the directive's reference, or else the one given."""
        directive = self.directive
        if directive.alert:
            self._alerts.put("separation", directive.alert, now_us)
        controller = self.controller if self._mission.phase is Phase.TRACK else self._transit
        return controller.plan(
            Problem(
                start=start,
                reference=reference if directive.reference is None else directive.reference,
                disturbance_ned_m_s2=self._own_state.estimate.disturbance_ned_m_s2,
                keep_outs=directive.keep_outs,
                guess_ned_m=self._modes.guess_ned_m(start.t_us),
                ground_z_m=self._mission.ground_z_m,
            )
        )
