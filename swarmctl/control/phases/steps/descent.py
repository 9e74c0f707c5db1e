"""GOTO_LAND and LAND: the agent flies to where it may land, then its autopilot lands it. Pure.

A vehicle found in the air at start-up is handed back in the air after a completed mission, in the autopilot's hold.
"""

from __future__ import annotations

from swarmctl.control.phases import handover
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.mission_state import PLAN_MODES, TAKEN_OVER, MissionState
from swarmctl.core.types import Command, FlightMode, Landed, Phase, VehicleState, Verb

_DESCENDS_M_S = 0.5  # of autopilots that land, at least
_TOUCHES_DOWN_S = 3.0  # from the ground on, until nothing turns any more
_STANDS_US = 5_000_000  # that an autopilot has to disarm by itself
_MOTIONLESS_US = 5_000_000  # disarmed for as long, a vehicle is landed by nobody, wherever its autopilot says it is


def goto_land(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Fly to the landing place; after too long, land where the vehicle is.

    A vehicle that its autopilot still flies, as it was stopped before the agent had control, is landed by it where it
    is, unless that would be on an obstacle. Until then an agent that has control waits for an obstacle that moves to be
    past the way down, on which the autopilot would not avoid it.
    """
    if mission.held:
        return []
    given_back = mission.may_take_control and not mission.had_control
    if given_back and (mission.takes_back(inputs.now_us) or not mission.landing.in_place):
        return handover.request_control(mission, inputs, state)
    landing, controls = mission.landing, mission.had_control
    if not (controls or given_back) and inputs.now_us <= mission.land_by_us and inputs.is_over_obstacle(state):
        return handover.request_control(mission, inputs, state)
    if landing.is_reached(inputs, state, controls=controls, paused=mission.interruptions.paused):
        if inputs.now_us > mission.land_by_us or not (controls and _is_crossed(mission, inputs, state)):
            if not landing.in_place:
                mission.end_way_back("flew back")
            mission.enter(Phase.LAND, inputs.now_us)
    elif inputs.now_us > mission.land_by_us:
        if landing.is_possible_here(inputs, state, controls=controls) or inputs.mode not in PLAN_MODES:
            mission.enter(Phase.LAND, inputs.now_us)
        else:
            mission.stop_in_place(inputs.now_us, state)
    return []


def _is_crossed(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> bool:
    """Return whether an obstacle moves onto the way straight down, before the vehicle would be on the ground."""
    if mission.ground_z_m is None:
        return False
    descends_s = max(0.0, mission.ground_z_m - float(state.pos_ned_m[2])) / _DESCENDS_M_S
    return inputs.crossing_obstacle(state.pos_ned_m, mission.ground_z_m, descends_s + _TOUCHES_DOWN_S) is not None


def land(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Have the autopilot land, and disarm, or give the vehicle back in the air."""
    mission.had_control = False
    if mission.handed_back:
        if state.mode is not FlightMode.EXTERNAL:
            mission.enter(Phase.DONE, inputs.now_us)
            return []
        return [Command(verb=Verb.HOLD)] if mission.may_request(inputs) else []
    if mission.is_down(inputs, state) or mission.arming.disarmed_for_us >= _MOTIONLESS_US:
        mission.enter(Phase.DONE, inputs.now_us)
        return []
    if state.mode is FlightMode.LAND:
        mission.landing_seen = True
        return _disarmed_late(mission, inputs, state)
    ours = state.mode in handover.OWN_MODES and not mission.landing_seen  # else a pilot flies, or aborted the landing
    if not ours and state.landed is not Landed.ON_GROUND:
        mission.override(TAKEN_OVER, inputs.now_us)
        return []
    if not mission.may_request(inputs):
        return []
    return [Command(verb=Verb.DISARM if state.landed is Landed.ON_GROUND else Verb.LAND)]


def _disarmed_late(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Disarm a vehicle that stands, where its autopilot does not: PX4 with COM_DISARM_LAND -1 never would."""
    if state.landed is not Landed.ON_GROUND:
        mission.requested_us = inputs.now_us
        return []
    return [Command(verb=Verb.DISARM)] if mission.may_request(inputs, _STANDS_US) else []
