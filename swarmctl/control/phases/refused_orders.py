"""Which operator's orders an agent refuses, and the reason it answers. Pure.

An order that is not refused has its effect: `control.phases.obeyed_orders` applies it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from swarmctl.control.reference.feasibility import LEAST_HEIGHT_M
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.obstacle import Obstacle, taken_by
from swarmctl.core.operator_verbs import FAR, FAR_M, GOTO, OPERATOR_VERBS, POINT, Order
from swarmctl.core.text import point_text
from swarmctl.core.types import Array, Landed, Phase, VehicleState

Contains = Callable[[tuple[float, float]], bool]  # whether north and east [m] lie within the geofence
_WAY_STEP_M = 1.0  # between points of a straight way that are checked
_MOST_WAY_POINTS = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderSituation:
    """Everything that decides whether an agent obeys an order."""

    phase: Phase
    state: VehicleState | None
    pilot_override: bool  # pilot or autopilot took over
    other_control: bool  # its flight mode is none that the agent has asked for
    lands_in_place: bool  # it is landing where it came to rest
    controls: bool  # the autopilot follows the agent's setpoints
    paused: bool  # it rests because a peer is silent or deadlines are missed
    lowest_m: float  # down coordinate that no point to go to may be below
    ground_z_m: float | None  # down coordinate of the place of the take-off; None where it is not known
    way_ned_m: Array | None  # (K, 3) on which it would join a mission that is ordered; None where it does not at once
    contains: Contains
    volume: FlightVolume | None  # that plans keep to
    obstacles: Mapping[int, Obstacle]  # at rest, by number


def refusal_of(order: Order, situation: OrderSituation) -> str:
    """Return why an order is refused, or "" if it is obeyed.

    A stop is obeyed before anything is known of the vehicle: it begins with the first state.
    """
    verb, phase = OPERATOR_VERBS[order.verb], situation.phase
    if phase.name not in verb.phases:
        obeyed = ", ".join(possible.name for possible in Phase if possible.name in verb.phases)
        return f"it is in {phase.name}; {order.verb} is obeyed in {obeyed}"
    if phase is Phase.DONE:
        down = situation.state is not None and situation.state.landed is Landed.ON_GROUND
        return "" if down else "its mission has ended and it was handed back in the air"
    if situation.pilot_override and order.verb != "resume":
        flown = "" if situation.state is None else f" and flies it in {situation.state.mode.name}"
        return f"a pilot or its autopilot has taken over{flown}; take it back with: resume"
    if verb.is_stop:
        lands = phase is Phase.GOTO_LAND and situation.lands_in_place
        return "it is landing where it is" if lands and order.verb == "rtl" else ""
    if situation.state is None:
        return "nothing is known of its vehicle now"
    if phase is Phase.TAKEOFF and order.verb == "hold" and situation.other_control:
        return f"its pilot or autopilot flies it in {situation.state.mode.name}"
    if situation.way_ned_m is not None:
        return _low_way_refusal(situation.way_ned_m, situation) or _way_refusal(situation.way_ned_m, situation)
    return _goto_refusal(order, situation.state, situation) if order.verb == GOTO else ""


def _goto_refusal(order: Order, state: VehicleState, situation: OrderSituation) -> str:
    """Return why the agent does not fly to a point, or ""."""
    if not situation.controls:
        return "its autopilot still flies it"
    if situation.paused:
        return "it rests because a peer is silent or deadlines are missed"
    target = np.array([order.arguments[name] for name in POINT])
    if target[2] > situation.lowest_m:
        return f"down {target[2]:g} m is too low: {situation.lowest_m:.2f} at most"
    away_m = math.dist(state.pos_ned_m, target)
    if away_m > FAR_M and not order.arguments.get(FAR):
        return f"{point_text(target)} is {away_m:.0f} m away; beyond {FAR_M:g} m say --far"
    if situation.volume is not None and (refusal := situation.volume.refusal(target)):
        return refusal
    if taken := taken_by(target, situation.obstacles):
        return f"{point_text(target)} is in {taken}, where it would never arrive"
    points = min(_MOST_WAY_POINTS, 2 + int(math.dist(state.pos_ned_m[:2], target[:2]) / _WAY_STEP_M))
    return _way_refusal(np.linspace(target, state.pos_ned_m, points), situation)


def _low_way_refusal(way_ned_m: Array, situation: OrderSituation) -> str:
    """Return that a way (K, 3) leads too near to the ground, nearer than where it begins, or ""."""
    if situation.ground_z_m is None:
        return ""
    lowest_m, least_m = float(way_ned_m[:, 2].max()), situation.ground_z_m - LEAST_HEIGHT_M
    if lowest_m <= max(least_m, float(way_ned_m[0, 2])):
        return ""
    least = f"less than {LEAST_HEIGHT_M:g} m above the place of the take-off"
    return f"the way into the mission leads down to z = {lowest_m:.2f} m, {least}"


def _way_refusal(way_ned_m: Array, situation: OrderSituation) -> str:
    """Return where a way (K, 3) first leaves the geofence, or ""."""
    level = map(tuple, way_ned_m[:, :2].tolist())
    outside = next(((north, east) for north, east in level if not situation.contains((north, east))), None)
    return "" if outside is None else f"{outside[0]:.1f}, {outside[1]:.1f} on the way is outside of the geofence"
