"""Who has control of a vehicle, and how an agent asks for it. Pure."""

from __future__ import annotations

from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.mission_state import ASKS_US, TAKEN_OVER, MissionState
from swarmctl.core.types import Command, FlightMode, Mode, Phase, VehicleState, Verb

# How long a vehicle without positions is in another mode, or disarmed, before that counts as a takeover: it may be a
# reboot of its autopilot, which is told later than mode and arming.
_GONE_US = 3_000_000
OWN_MODES = (FlightMode.HOLD, FlightMode.TAKEOFF, FlightMode.EXTERNAL)  # modes that follow from our own requests

_NO_VERBS = frozenset[Verb]()
_CLIMB_VERBS = frozenset((Verb.TAKEOFF,))
_CONTROL_VERBS = frozenset((Verb.EXTERNAL,))
_DEPARTURE_VERBS = frozenset((Verb.ARM, Verb.TAKEOFF, Verb.EXTERNAL))
_FLIGHT_VERBS = _DEPARTURE_VERBS | {Verb.DISARM, Verb.HOLD, Verb.LAND}


def is_under_other_control(state: VehicleState) -> bool:
    """Return whether a pilot, a ground station or a failsafe controls the vehicle."""
    return state.mode not in OWN_MODES or state.failsafe


def is_taken_over(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> bool:
    """Return whether pilot or autopilot have taken over; where positions are stale, mode and arming may be new."""
    stale = inputs.mode is Mode.STATE_STALE and mission.had_control and mission.phase < Phase.LAND
    if not stale or (state.mode is FlightMode.EXTERNAL and state.armed):
        mission.gone_us = None
        return inputs.mode is Mode.PILOT_OVERRIDE
    mission.gone_us = inputs.now_us if mission.gone_us is None else mission.gone_us
    return inputs.now_us - mission.gone_us > _GONE_US


def withdrawn_verbs(mission: MissionState, state: VehicleState | None) -> frozenset[Verb]:
    """Return what is no longer asked of the autopilot, although it has not answered yet.

    A repetition would take the vehicle from a pilot whose agent flies it no more, or arm it after a stop.
    """
    if mission.pilot_override:
        return _FLIGHT_VERBS
    if mission.phase >= Phase.LAND:
        return _DEPARTURE_VERBS
    others = state is not None and state.armed and is_under_other_control(state)
    if others and not mission.may_take_control:
        return _CONTROL_VERBS
    return _CLIMB_VERBS if mission.climb.abandoned else _NO_VERBS


def request_control(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Request control from the autopilot's own hold; from any other mode only after an operator's `resume`.

    No setpoints may be sent meanwhile: PX4 returns to OFFBOARD by itself when they reappear after a failsafe.

    An autopilot that does not give it for too long keeps the vehicle until another `resume`.
    """
    if mission.asks_in_vain(inputs.now_us):
        mission.override(
            f"no control {ASKS_US // 1_000_000} s after resume: it stays in {state.mode.name}", inputs.now_us
        )
        return []
    if not mission.may_take_control and is_under_other_control(state):
        leave_control(mission, inputs)
        return []
    return [Command(verb=Verb.EXTERNAL)] if mission.may_request(inputs) else []


def take_control(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> None:
    """Note that the autopilot follows our setpoints, and go on from where the vehicle has been left."""
    if mission.had_control:
        return
    mission.had_control = True
    if mission.phase is Phase.GOTO_START:
        target_ned_m = mission.climb.rest_ned_m(state) if mission.climb.cut_short else mission.start_ned_m
        mission.trajectories.go_to(target_ned_m, inputs.now_us, state)
        mission.trajectories.keep_destination()
    elif not mission.interruptions.active:
        mission.go_on(inputs.now_us, inputs.utc_us, state)
    if mission.interruptions.active:
        mission.interruptions.stay(inputs.now_us, state)


def leave_control(mission: MissionState, inputs: PhaseInputs) -> None:
    """Leave the vehicle to who has taken it: its autopilot, if setpoints have stopped."""
    stopped = inputs.setpoints_stopped
    mission.override(f"{stopped}: the autopilot took over" if stopped else TAKEN_OVER, inputs.now_us)
    mission.setpoints_stopped = bool(stopped)
