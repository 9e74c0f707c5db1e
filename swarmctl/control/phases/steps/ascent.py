"""TAKEOFF and GOTO_START: the autopilot climbs, then the agent takes control and flies to the start. Pure."""

from __future__ import annotations

import math

from swarmctl.control.phases import handover
from swarmctl.control.phases.departure import SPIN_UP_US, obstacle_coming, unmet_climb_condition
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.mission_state import DISARMED, MissionState
from swarmctl.control.phases.trajectories import is_at
from swarmctl.core.types import Command, FlightMode, Landed, Mode, Phase, VehicleState, Verb


def takeoff(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Request the climb, and wait until the vehicle hovers; a hold interrupts it, and an obstacle in its way."""
    given_back = mission.may_take_control and mission.climb.cut_short  # in whatever mode it hovers
    climbed = mission.climb.update(inputs, state) or given_back
    if climbed and not mission.held:
        if mission.climb.abandoned:
            mission.stop_in_place(inputs.now_us, state)
        else:
            mission.enter(Phase.GOTO_START, inputs.now_us)
        return []
    if not state.armed:  # pilot or autopilot disarmed it: it is not armed again
        if mission.arming.is_disarmed(inputs, state):
            mission.give_up(DISARMED, inputs, state)
        return []
    others = handover.is_under_other_control(state)
    mission.climb.was_ours |= not others
    if others and mission.climb.was_ours and not mission.may_take_control:  # who was armed in another mode takes off
        handover.leave_control(mission, inputs)
        return []
    rest_ned_m = mission.climb.rest_ned_m(state)
    mission.waits_for = unmet_climb_condition(inputs, state, rest_ned_m)
    if mission.held:
        return [] if others else _hold(mission, inputs, state)
    if mission.climb.abandoned:
        return _stop_above(mission, inputs, state)
    if state.landed is not Landed.ON_GROUND:
        coming = obstacle_coming(inputs, state, rest_ned_m) is not None
        if mission.waits_for or coming or mission.climb.waits:
            return _wait_below(mission, inputs, state, coming)
    if mission.climb.is_stopped(inputs, state):
        if mission.climb.ends_near(state):
            mission.climb.cut()
        else:
            handover.leave_control(mission, inputs)
        return []
    stands = state.landed is Landed.ON_GROUND and state.mode is not FlightMode.TAKEOFF
    return _climb(mission, inputs, state) if stands and not mission.waits_for else []


def _climb(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    if not mission.may_request(inputs, SPIN_UP_US):
        return []
    if state.mode is FlightMode.HOLD and inputs.arm_in is not None:  # where a hold has left it
        mission.requested_us = inputs.now_us - SPIN_UP_US
        return [Command(verb=Verb.EXTERNAL)]
    return [Command(verb=Verb.TAKEOFF, value=mission.climb.height_m)]


def _hold(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    return [Command(verb=Verb.HOLD)] if state.mode is not FlightMode.HOLD and mission.may_request(inputs) else []


def _wait_below(mission: MissionState, inputs: PhaseInputs, state: VehicleState, coming: bool) -> list[Command]:
    """Have the autopilot hold below an obstacle; the agent flies the rest of the climb.

    It waits until one at rest has gone, but not for one that is `coming`, which the agent avoids by itself.
    """
    hovers = state.mode is FlightMode.HOLD
    if mission.waits_for or (coming and not hovers):
        mission.climb.waits = True
        return _hold(mission, inputs, state)
    if hovers:
        mission.climb.cut()
    return []


def _stop_above(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Have the autopilot hold above an obstacle, or land where it is once nothing is below it, or after too long."""
    if inputs.now_us > mission.land_by_us or not inputs.is_over_obstacle(state):
        mission.enter(Phase.LAND, inputs.now_us)
        return []
    return _hold(mission, inputs, state)


def goto_start(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Take control, and fly to the start."""
    if not mission.had_control:
        if mission.trajectories.current is None:
            mission.trajectories.stand(inputs.now_us, state)
        return [] if mission.held else handover.request_control(mission, inputs, state)
    if mission.interruptions.active:
        return []
    if mission.climb.cut_short:
        _finish_climb(mission, inputs.now_us, state)
    elif inputs.mode is not Mode.STATE_STALE and is_at(
        state, mission.start_ned_m, mission.params.arrive_m, mission.params.arrive_m_s
    ):
        mission.ready_utc_us = inputs.utc_us
        mission.enter(Phase.READY, inputs.now_us)
    return []


def _finish_climb(mission: MissionState, now_us: int, state: VehicleState) -> None:
    """Go to the start once the vehicle has climbed to its height."""
    rest = mission.trajectories.current
    if rest is not None and is_at(state, rest.trajectory.to_ned_m, mission.params.arrive_m, math.inf):
        mission.climb.finish()
        mission.trajectories.go_to(mission.start_ned_m, now_us, state)
