"""Every verb of the operator has an effect in the state machine, and only in its phases."""

from __future__ import annotations

import pytest

from swarmctl.control.phases.state_machine import MissionStateMachine
from swarmctl.core.operator_verbs import EXCLUDE, OPERATOR_VERBS, order_problem
from swarmctl.core.types import Phase
from tests.benches.state_machine_flight import Flight

ABOUT_THE_VEHICLE = [name for name in OPERATOR_VERBS if name != EXCLUDE]


def test_every_verb_about_the_vehicle_is_a_stop_or_handled() -> None:
    machine: MissionStateMachine = Flight().state_machine
    assert {name for name in ABOUT_THE_VEHICLE if not OPERATOR_VERBS[name].is_stop} == machine._order_handlers.keys()


@pytest.mark.parametrize("verb", ABOUT_THE_VEHICLE)
def test_phases_of_a_verb_are_phases_and_nothing_interrupts_a_landing(verb: str) -> None:
    phases = OPERATOR_VERBS[verb].phases
    assert phases
    assert phases <= {phase.name for phase in Phase if phase < Phase.LAND}


def test_hold_is_obeyed_while_tracking_only() -> None:
    flight = Flight().until(Phase.READY)
    flight.ask("hold")
    assert not flight.state_machine.held
    flight.until(Phase.TRACK).ask("hold")
    assert flight.state_machine.held


def test_what_is_no_order_is_named() -> None:
    assert order_problem("hold", {}) == ""
    assert order_problem("fly", {}) == f"'fly' is no verb; known are {', '.join(OPERATOR_VERBS)}"
    assert order_problem("hold", {"height_m": 1.0}) == "hold takes no arguments"
