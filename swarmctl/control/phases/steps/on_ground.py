"""STANDBY and ARM: a vehicle is armed once all agents stand by. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from swarmctl.control.phases import handover
from swarmctl.control.phases.departure import unmet_climb_condition, unmet_start_condition
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.mission_state import DISARMED, TAKEN_OVER, MissionState
from swarmctl.core.types import Command, FlightMode, Landed, Phase, VehicleState, Verb


def standby(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Wait until every start condition is met."""
    mission.keeps_up = not inputs.too_slow
    if not inputs.prepared:  # the autopilot has rebooted since CONNECT
        mission.waits_for = "the link to be set up again after a reboot of the autopilot"
        return []
    if inputs.refusal:
        return mission.refuse(inputs.refusal, inputs)
    if too_late := _too_late(peer.phase for peer in inputs.peers().values() if peer.alive):
        return mission.refuse(too_late, inputs)
    peers, top_ned_m = mission.peers - inputs.excused, mission.climb.rest_ned_m(state)
    mission.waits_for = unmet_start_condition(inputs, state, peers, top_ned_m)
    if not mission.waits_for:
        mission.climb.begin(state)
        mission.airborne = state.landed is Landed.IN_AIR
        if not mission.airborne and (too_low := mission.climb.too_low or mission.leads_below_ground):
            return mission.refuse(too_low, inputs)
        # however long others were waited for, the way to the start has its time:
        mission.patient_from_us = inputs.now_us
        mission.enter(Phase.ARM, inputs.now_us)
        return []
    stays = state.mode is FlightMode.EXTERNAL and inputs.arm_in is None and not inputs.armable
    if stays and not state.armed and mission.may_request(inputs):
        return [Command(verb=Verb.HOLD)]  # PX4 stays in OFFBOARD after a landing, where it can't be armed
    return []


def arm(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Request arming, in the flight mode that the autopilot requires for it."""
    if state.armed and mission.airborne and not mission.may_take_control and handover.is_under_other_control(state):
        mission.override(TAKEN_OVER, inputs.now_us)  # before the first setpoint, which would already take control
        return []
    if state.armed:
        mission.enter(Phase.GOTO_START if mission.airborne else Phase.TAKEOFF, inputs.now_us)
        return []
    if mission.arming.accepted:  # its motors turn, unless a pilot has stopped them since: it is not armed again
        if mission.arming.disarmed_for_us:
            mission.give_up(DISARMED, inputs, state)
        return []
    too_late = "" if mission.airborne else _too_late(peer.phase for peer in inputs.peers().values())
    if refusal := inputs.refusal or too_late:
        return mission.refuse(refusal, inputs)
    mission.waits_for = unmet_climb_condition(inputs, state, mission.climb.rest_ned_m(state))
    if mission.waits_for or not mission.may_request(inputs):
        return []
    if inputs.arm_in not in (None, state.mode):
        return [Command(verb=Verb.EXTERNAL)]
    mission.arming.request()
    return [Command(verb=Verb.ARM)]


def _too_late(peers: Iterable[Phase]) -> str:
    """Return why a vehicle stays on the ground, by the phases of its peers, or ""."""
    phases = set(peers)
    if Phase.TRACK in phases:  # peers may fly where this vehicle would climb, and its autopilot avoids nobody
        return "the mission has begun without it"
    return "a peer gave up before take-off" if phases and max(phases) > Phase.TRACK else ""
