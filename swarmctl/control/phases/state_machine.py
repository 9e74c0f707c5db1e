"""State machine of one agent's mission: what happens when, and the requests to the autopilot in each phase.

Pure. Agents agree on the start of the mission without a leader: each publishes when it became ready, and all start one
second after the latest of these times. The operator's orders (`core.operator_verbs`) are applied here too.

What is known of the mission is in `MissionState`, which others read; what is done in a phase is a row of `STEPS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from swarmctl.control.failsafe.decision import Response
from swarmctl.control.failsafe.overload import Level
from swarmctl.control.phases import handover, obeyed_orders
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.mission_state import PLAN_MODES, MissionSetup, MissionState
from swarmctl.control.phases.refused_orders import OrderSituation, refusal_of
from swarmctl.control.phases.state_machine_params import StateMachineParams
from swarmctl.control.phases.steps import ascent, descent, on_ground, tracking
from swarmctl.control.phases.trajectories import TRANSIT_HEIGHT_M
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import OPERATOR_VERBS, Order
from swarmctl.core.types import Command, FlightMode, Mode, Phase, VehicleState

_LATE_US, _AWAY_M = 200_000, 0.5  # from its begin and from the start, from which on its reference is approached
_KEEPS_UP_01 = 0.15  # of deadlines missed
REBOOTED = "the autopilot rebooted"
OVERLOADED = "overload: deadlines were missed for too long"

STEPS: Mapping[Phase, Callable[[MissionState, PhaseInputs, VehicleState], list[Command]]] = {
    Phase.STANDBY: on_ground.standby,
    Phase.ARM: on_ground.arm,
    Phase.TAKEOFF: ascent.takeoff,
    Phase.GOTO_START: ascent.goto_start,
    Phase.READY: tracking.ready,
    Phase.TRACK: tracking.track,
    Phase.GOTO_LAND: descent.goto_land,
    Phase.LAND: descent.land,
}


class MissionStateMachine:
    """Moves one agent through the phases of its mission.

    Args:
        params: speeds, tolerances and timeouts.
        setup: place in the swarm, and the mission.

    Attributes:
        mission: where it stands.
    """

    def __init__(self, params: StateMachineParams, setup: MissionSetup) -> None:
        self.mission = MissionState(params, setup)

    def begin_if_due(self, now_us: int, utc_us: int, state: VehicleState | None) -> None:
        """Enter TRACK on time. Called before planning, so that the first plan of the mission follows its reference.

        An agent whose vehicle was away, in the hands of a pilot, goes to where the reference is by now.
        """
        mission, begins_us = self.mission, self.mission.begin_utc_us
        if mission.phase is not Phase.READY or begins_us is None or utc_us < begins_us:
            return
        mission.enter(Phase.TRACK, now_us)
        if state is None or mission.interruptions.active:
            return
        if utc_us - begins_us > _LATE_US or math.dist(state.pos_ned_m, mission.start_ned_m) > _AWAY_M:
            mission.rejoin_mission(now_us, utc_us, state)

    def step(self, inputs: PhaseInputs) -> list[Command]:
        """Advance by one tick; returns the requests to the autopilot."""
        mission, state = self.mission, inputs.state
        mission.patient_from_us = inputs.now_us if mission.patient_from_us is None else mission.patient_from_us
        mission.arming.update(inputs)
        if inputs.boots != mission.boots:
            mission.boots = inputs.boots
            if Phase.ARM <= mission.phase < Phase.DONE and not mission.pilot_override:
                mission.override(REBOOTED, inputs.now_us)
        if state is None:
            return []
        obeyed_orders.apply_stop(mission, inputs.now_us, state, lambda: inputs.is_over_obstacle(state))
        if mission.phase is Phase.CONNECT and inputs.prepared:  # peers arm as soon as all agents stand by
            mission.enter(Phase.STANDBY, inputs.now_us)
            return mission.refuse(inputs.refusal, inputs) if inputs.refusal else []
        if not mission.pilot_override and handover.is_taken_over(mission, inputs, state):
            handover.leave_control(mission, inputs)
        if mission.pilot_override:
            if mission.is_down(inputs, state):
                mission.enter(Phase.DONE, inputs.now_us)
            return []
        self._respond(inputs, state)
        if state.mode is FlightMode.EXTERNAL and Phase.GOTO_START <= mission.phase < Phase.LAND:
            handover.take_control(mission, inputs, state)
        self._lose_patience(inputs, state)
        step = STEPS.get(mission.phase)
        return step(mission, inputs, state) if step else []

    def operator(
        self, order: Order, now_us: int, utc_us: int, state: VehicleState | None, obstacles: Mapping[int, Obstacle]
    ) -> str:
        """Apply an operator's order; return why it is refused, or "".

        A stop (land, rtl) is kept until a vehicle state is known to begin it from, so it is lost in no phase.

        Args:
            order: of an operator.
            now_us, utc_us: monotonic time and UTC.
            state: newest one, if there is any.
            obstacles: those at rest, by number: nobody is sent into one.
        """
        if refusal := refusal_of(order, self._situation(order, utc_us, state, obstacles)):
            return refusal
        if OPERATOR_VERBS[order.verb].is_stop:
            self.mission.stop_verb = order.verb
        if state is None:
            return ""
        below = (obstacle for obstacle in obstacles.values() if obstacle.is_below(state.pos_ned_m))
        obeyed_orders.apply_stop(self.mission, now_us, state, lambda: any(below))
        if order.verb in obeyed_orders.ORDERS:
            obeyed_orders.ORDERS[order.verb](self.mission, order, now_us, utc_us, state)
        return ""

    def _situation(
        self, order: Order, utc_us: int, state: VehicleState | None, obstacles: Mapping[int, Obstacle]
    ) -> OrderSituation:
        mission = self.mission
        # the ground's height is known after a take-off
        lowest_m = float(mission.start_ned_m[2]) if mission.airborne else mission.climb.ground_z_m - TRANSIT_HEIGHT_M
        return OrderSituation(
            phase=mission.phase,
            state=state,
            pilot_override=mission.pilot_override,
            other_control=state is not None and handover.is_under_other_control(state),
            lands_in_place=mission.landing.in_place,
            controls=mission.had_control,
            paused=mission.interruptions.paused,
            lowest_m=lowest_m,
            ground_z_m=mission.ground_z_m,
            way_ned_m=obeyed_orders.way_into(mission, order, utc_us, state),
            contains=mission.contains,
            volume=mission.volume,
            obstacles=obstacles,
        )

    def _respond(self, inputs: PhaseInputs, state: VehicleState) -> None:
        """Give up, fly home or pause as the failsafe asks for.

        A vehicle that is being taken back is waited for: until the agent has it, its autopilot would land it where a
        pilot has left it, among others and above whatever is there.
        """
        mission = self.mission
        if mission.takes_back(inputs.now_us):
            return
        if inputs.mode is Mode.LAND and mission.phase < Phase.LAND:
            mission.give_up("no plan for too long", inputs, state)
        if inputs.overload is Level.LAND and mission.may_fly_on and mission.phase > Phase.STANDBY:
            mission.give_up(OVERLOADED, inputs, state)
        if inputs.cut_off and mission.may_fly_on:
            mission.give_up(inputs.cut_off, inputs, state)
        self._escalate(inputs, state)
        self._pause(inputs, state)

    def _escalate(self, inputs: PhaseInputs, state: VehicleState) -> None:
        """Fly home, or land, as battery and link ask for; a vehicle on its way home lands where it is, if it has to.

        Without a plan it waits for one: from there its autopilot, which knows no others, would land it at once.
        """
        mission, response, why = self.mission, inputs.escalation.response, inputs.escalation.reason
        flies_home = mission.phase is Phase.GOTO_LAND and not mission.landing.in_place
        if mission.had_control and inputs.mode not in PLAN_MODES:
            return
        if response is Response.RTL and mission.may_fly_on and mission.had_control:
            mission.fly_back(why, inputs.now_us, state)
        elif (response >= Response.RTL and mission.may_fly_on) or (response is Response.LAND and flies_home):
            mission.give_up(why, inputs, state)
            mission.land_by_us = min(mission.land_by_us, inputs.now_us + inputs.escalation.patience_us)

    def _pause(self, inputs: PhaseInputs, state: VehicleState) -> None:
        """Come to rest while the bus is lost, because peers then assume braking, and while deadlines are missed."""
        mission = self.mission
        flies = mission.had_control and Phase.GOTO_START <= mission.phase <= Phase.GOTO_LAND
        must_wait = inputs.unresponsive_peer or inputs.overload >= Level.HOLD
        waits = {"must_wait": must_wait, "flies": flies, "keeps_up": inputs.missed_01 < _KEEPS_UP_01}
        if mission.interruptions.update_pause(inputs.now_us, state, **waits):
            mission.go_on(inputs.now_us, inputs.utc_us, state)

    def _lose_patience(self, inputs: PhaseInputs, state: VehicleState) -> None:
        """Give up when the mission has not begun for too long."""
        mission, patience_s = self.mission, self.mission.params.start_timeout_s
        if mission.phase >= Phase.TRACK or mission.held or mission.patient_from_us is None:
            return
        if inputs.now_us - mission.patient_from_us > patience_s * 1e6:
            cause = f"not tracking after {patience_s:.0f} s ({mission.phase.name})"
            mission.give_up(f"{cause}: {mission.waits_for}" if mission.waits_for else cause, inputs, state)
