"""Which operator's orders an agent refuses, and the reason it answers. Pure.

An order that is not refused has its effect: `control.phases.state_machine` applies it.
"""

from __future__ import annotations

from dataclasses import dataclass

from swarmctl.core.operator_verbs import OPERATOR_VERBS, Order
from swarmctl.core.types import Landed, Phase, VehicleState


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderSituation:
    """Everything that decides whether an agent obeys an order."""

    phase: Phase
    state: VehicleState | None
    pilot_override: bool  # pilot or autopilot took over
    other_control: bool  # its flight mode is none that the agent has asked for
    lands_in_place: bool  # it is landing where it came to rest


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
        return "a pilot or its autopilot has taken over; take it back with: resume"
    if verb.is_stop:
        lands = phase is Phase.GOTO_LAND and situation.lands_in_place
        return "it is landing where it is" if lands and order.verb == "rtl" else ""
    if situation.state is None:
        return "nothing is known of its vehicle now"
    if phase is Phase.TAKEOFF and order.verb == "hold" and situation.other_control:
        return f"its pilot or autopilot flies it in {situation.state.mode.name}"
    return ""
