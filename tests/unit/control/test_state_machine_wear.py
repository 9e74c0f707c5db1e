"""Tests of what wears out or lasts too long: battery, positions, deadlines, peers that do not answer."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.failsafe.decision import Escalation, Response
from swarmctl.control.failsafe.overload import Level
from swarmctl.control.phases.state_machine import OVERLOADED
from swarmctl.core.types import Mode, Phase, Verb
from tests.benches.state_machine_flight import CONTROLLED_PHASES, SECOND, START, controlled

CLOSE = START + np.array([0.6, 0.0, 0.0])


@pytest.mark.parametrize(("level", "rests"), [(Level.WIDEN, False), (Level.HOLD, True)])
def test_missed_deadlines_bring_it_to_rest_until_they_are_met_again(level: Level, rests: bool) -> None:
    flight = controlled(Phase.TRACK)
    flight.vel, flight.overload = np.array([1.2, 0.0, 0.0]), level
    flight.run(0.1)
    _, vel = flight.mission.reference(flight.utc_us, flight.now_us, np.array([5.0]))
    assert vel.any() != rests
    flight.overload = Level.NONE
    flight.run(0.1)
    _, vel = flight.mission.reference(flight.utc_us, flight.now_us, np.array([5.0]))
    assert vel.any()


@pytest.mark.parametrize("cause", ["deadlines", "cut off", "battery"])
@pytest.mark.parametrize("phase", CONTROLLED_PHASES)
def test_what_lasts_and_ends_a_mission_brings_the_vehicle_down_once_where_it_is(phase: Phase, cause: str) -> None:
    """On its way home only a battery lands it where it is; nothing begins its stop anew in every tick."""
    flight = controlled(phase)
    before, home = flight.mission.outcome, phase is Phase.GOTO_LAND
    flight.failsafe_mode = Mode.TRACKING
    if cause == "deadlines":
        flight.overload = Level.LAND
    elif cause == "cut off":
        flight.cut_off = "cut off from agent-1"
    else:
        flight.escalation = Escalation(Response.LAND, "battery at 8 %")
    flight.run(0.3)
    assert flight.at == "GOTO_LAND"
    assert flight.mission.landing.in_place is (not home or cause == "battery")
    told = {"deadlines": OVERLOADED, "cut off": "cut off from agent-1", "battery": "battery at 8 %"}
    assert flight.mission.outcome == (before if home else told[cause])
    if not flight.mission.landing.in_place:
        flight.pos = START.copy()
    assert Verb.LAND in flight.run(30.0)


@pytest.mark.parametrize(
    ("worn", "least_s", "most_s"),
    [
        (Escalation(Response.LAND, "battery at 8 %"), 15.0, 25.0),
        (Escalation(Response.LAND, "no GPS for 2.0 s", patience_us=2 * SECOND), 1.5, 3.0),
    ],
    ids=["battery", "positions"],
)
def test_a_landing_by_positions_that_get_worse_waits_for_room_no_longer_than_it_may(
    worn: Escalation, least_s: float, most_s: float
) -> None:
    flight = controlled(Phase.TRACK)
    flight.pos, flight.others = START.copy(), (CLOSE,)
    flight.failsafe_mode, flight.escalation = Mode.TRACKING, worn
    assert Verb.LAND not in flight.run(least_s)
    assert Verb.LAND in flight.run(most_s - least_s)
