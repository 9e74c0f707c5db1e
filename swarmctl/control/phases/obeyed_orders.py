"""What an operator's orders change in a mission. Pure. Which are refused is said in `control.phases.refused_orders`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from swarmctl.control.phases.departure import SPIN_UP_US
from swarmctl.control.phases.interruptions import HoldPoint
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.core.operator_verbs import BEGIN, GOTO, MISSION, POINT, SPEED, YAW, Order
from swarmctl.core.text import point_text
from swarmctl.core.types import Array, Landed, Phase, VehicleState

_MINUTES = 3.0  # a longer flight is told in minutes
_WHOLE_M = 100.0  # a longer way is told in whole metres
OPERATOR_STOP = "stopped by the operator"


def apply_stop(mission: MissionState, now_us: int, state: VehicleState, is_over: Callable[[], bool]) -> None:
    """Begin the stop that has been commanded, unless it is under way.

    Args:
        mission: that is stopped.
        now_us: monotonic time.
        state: newest one.
        is_over: returns whether an obstacle at rest is on the way straight down.
    """
    verb, mission.stop_verb = mission.stop_verb, ""
    if not verb or mission.phase >= Phase.LAND:
        return
    mission.outcome, mission.must_land = mission.outcome or OPERATOR_STOP, True
    if mission.climbs(state) and not mission.pilot_override and is_over():
        mission.abandon_climb(now_us)
    elif mission.phase < Phase.GOTO_START or mission.pilot_override:
        mission.enter(Phase.LAND, now_us)  # ends at once if the vehicle is known to be disarmed
    elif verb == "rtl" and mission.may_fly_on:
        mission.go_home(now_us, state)
    elif verb == "land" and (mission.held or not mission.landing.in_place):
        mission.stop_in_place(now_us, state)


def _hold(mission: MissionState, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
    if not mission.held:
        mission.requested_us = now_us - SPIN_UP_US  # on the way up the autopilot is asked at once
    autopilot_hovers = mission.phase <= Phase.GOTO_START and not mission.had_control
    mission.interruptions.hold(now_us, state, brakes=not autopilot_hovers)


def _goto(mission: MissionState, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
    _hold(mission, order, now_us, utc_us, state)
    arguments = order.arguments
    point = HoldPoint(
        ned_m=np.array([arguments[name] for name in POINT]),
        speed_m_s=arguments.get(SPEED),
        yaw_rad=math.radians(arguments[YAW]) if YAW in arguments else None,
    )
    mission.interruptions.move_hold(point, now_us, state)


def outcome_of(order: Order, mission: MissionState) -> str:
    """Return what an order that was obeyed comes to, in words; "" where its name says it."""
    begun = mission.trajectories.current
    if order.verb != GOTO or begun is None:
        return ""
    way = begun.trajectory
    away_m, minutes = math.dist(way.from_ned_m, way.to_ned_m), way.travel_s / 60.0
    takes = f"{minutes:.0f} min" if minutes > _MINUTES else f"{way.travel_s:.0f} s"
    return f"flies to {point_text(way.to_ned_m)}: {away_m:.{0 if away_m > _WHOLE_M else 1}f} m, {takes}"


def way_into(mission: MissionState, order: Order, utc_us: int, state: VehicleState | None) -> Array | None:
    """Return points (K, 3) on the way into a mission that is ordered; None of an order that leads into none at once."""
    if order.verb != MISSION or mission.offered is None or state is None:
        return None
    if mission.phase is not Phase.TRACK or mission.interruptions.active:
        return None
    return mission.trajectories.way_into(mission.offered.reference, utc_us * 1e-6 - order.arguments[BEGIN], state)


def _change_mission(mission: MissionState, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
    """Fly the mission that is offered: from its begin on where one is flown already, else when all are ready."""
    offered = mission.offered
    assert offered is not None
    mission.mission_reference, mission.duration_us = offered.reference, round(offered.duration_s * 1e6)
    mission.trajectories.change_mission(offered.reference)
    mission.ordered_begin_utc_us = round(order.arguments[BEGIN] * 1e6)
    if mission.phase is Phase.READY and mission.begin_utc_us is not None:  # peers may have begun: they begin anew
        mission.begin_utc_us = max(mission.begin_utc_us, mission.ordered_begin_utc_us)
    if mission.phase is Phase.TRACK:
        mission.begin_utc_us = mission.ordered_begin_utc_us
        if not mission.interruptions.active:
            mission.rejoin_mission(now_us, utc_us, state)


def _resume(mission: MissionState, order: Order, now_us: int, utc_us: int, state: VehicleState) -> None:
    if mission.held:
        mission.resumed_us = now_us
        _release(mission, now_us, state)
        if not mission.interruptions.paused:
            mission.go_on(now_us, utc_us, state)
    elif mission.pilot_override:
        _excuse_waiting(mission, now_us, mission.overridden_us)
        mission.rejoin_mission(now_us, utc_us, state)
    if not mission.pilot_override:
        return
    mission.pilot_override, mission.outcome, mission.may_take_control = False, mission.outcome_before, True
    mission.resumed_us, mission.landing_seen = now_us, False
    if mission.phase is Phase.TAKEOFF and state.landed is not Landed.ON_GROUND:
        mission.climb.cut()
    if mission.phase is Phase.LAND and state.landed is not Landed.ON_GROUND:  # it may have been left among others
        mission.stop_in_place(now_us, state)


def _release(mission: MissionState, now_us: int, state: VehicleState) -> None:
    """End a hold."""
    mission.interruptions.end_hold()
    mission.requested_us = now_us - SPIN_UP_US
    if mission.phase is Phase.TAKEOFF and state.landed is not Landed.ON_GROUND:
        mission.climb.cut()
    _excuse_waiting(mission, now_us, mission.interruptions.held_since_us)


def _excuse_waiting(mission: MissionState, now_us: int, since_us: int) -> None:
    """Let timeouts go on as if the time since then had not passed."""
    if mission.patient_from_us is not None:
        mission.patient_from_us += now_us - since_us
    mission.land_by_us += now_us - since_us


# by verb; stops are in `apply_stop`
ORDERS: Mapping[str, Callable[[MissionState, Order, int, int, VehicleState], None]] = {
    "hold": _hold,
    "resume": _resume,
    GOTO: _goto,
    MISSION: _change_mission,
}
