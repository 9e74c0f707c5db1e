"""READY and TRACK: agents begin the mission together, without a leader, and follow its reference. Pure."""

from __future__ import annotations

from swarmctl.control.phases import handover
from swarmctl.control.phases.departure import names_of
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.control.phases.mission_state import COMPLETED, MissionState
from swarmctl.core.types import Command, Phase, VehicleState

BEGIN_DELAY_US = 1_000_000  # from the last agent's readiness to mission time 0; several statuses are sent meanwhile


def ready(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Wait until every agent is at its start, and agree on when the mission begins."""
    if any(not p.alive or p.phase >= Phase.GOTO_LAND for p in inputs.peers().values()) and not mission.held:
        mission.outcome = "a peer gave up or was lost before the mission began"
        mission.go_home(inputs.now_us, state)
        return []
    ready_us = {agent: peer.ready_utc_us for agent, peer in inputs.peers().items() if peer.ready_utc_us > 0}
    absent = mission.peers - inputs.excused - ready_us.keys()
    mission.waits_for = f"{names_of(absent)} to reach the start" if absent else ""
    if not absent:
        agreed_us = max([mission.ready_utc_us, *ready_us.values()]) + BEGIN_DELAY_US
        mission.begin_utc_us = max(agreed_us, mission.ordered_begin_utc_us)
    if mission.had_control or mission.held:
        return []
    return handover.request_control(mission, inputs, state)  # a pilot has given it back


def track(mission: MissionState, inputs: PhaseInputs, state: VehicleState) -> list[Command]:
    """Follow the mission to its end, unless the vehicle leaves what the mission allows."""
    assert mission.begin_utc_us is not None
    if not mission.had_control:
        return handover.request_control(mission, inputs, state)
    if excess := mission.mission_reference.excess(state.pos_ned_m, state.vel_ned_m_s):
        mission.give_up(excess, inputs, state)
        return []
    if inputs.utc_us - mission.begin_utc_us >= mission.duration_us and not mission.interruptions.active:
        mission.outcome = mission.outcome or COMPLETED
        if mission.airborne and not inputs.peers():
            mission.enter(Phase.LAND, inputs.now_us)
        elif mission.airborne:
            mission.stop_in_place(inputs.now_us, state)
        else:
            mission.go_home(inputs.now_us, state)
    return []
