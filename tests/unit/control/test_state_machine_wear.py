"""Tests of what wears out or lasts too long: battery, positions, deadlines, peers that do not answer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from swarmctl.control.failsafe.decision import Escalation, Response
from swarmctl.control.failsafe.overload import Level
from swarmctl.control.phases.mission_state import TAKEN_OVER
from swarmctl.control.phases.state_machine import OVERLOADED
from swarmctl.core.types import FlightMode, Landed, Mode, Phase, Verb
from tests.benches.state_machine_flight import CONTROLLED_PHASES, SECOND, START, Flight, controlled

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


def on_its_way_back() -> Flight:
    flight = controlled(Phase.TRACK)
    flight.pos, flight.failsafe_mode = START + np.array([3.0, 0.0, 0.0]), Mode.TRACKING
    flight.escalation = Escalation(Response.RTL, "battery at 15 %")
    flight.run(0.3)
    assert (flight.at, flight.mission.outcome) == ("GOTO_LAND", "battery at 15 %: flies back")
    return flight


def arrives(flight: Flight) -> None:
    flight.pos = START.copy()


def is_ordered_to_land(flight: Flight) -> None:
    assert flight.ask("land") == ""


def has_to_land(flight: Flight) -> None:
    flight.escalation = Escalation(Response.LAND, "battery at 8 %")


def loses_its_plans(flight: Flight) -> None:
    flight.failsafe_mode = Mode.LAND


def takes_too_long(flight: Flight) -> None:
    """It is blown to one place, where there is room."""


@pytest.mark.parametrize(
    ("happens", "said"),
    [
        (arrives, "flew back"),
        (is_ordered_to_land, "did not get back"),
        (has_to_land, "did not get back"),
        (loses_its_plans, "did not get back"),
        (takes_too_long, "did not get back"),
    ],
)
def test_who_had_to_fly_back_is_said_to_have_done_so_only_if_it_has(
    happens: Callable[[Flight], None], said: str
) -> None:
    """It was said when it set off, also of one that landed on the way."""
    flight = on_its_way_back()
    happens(flight)
    assert Verb.LAND in flight.run(90.0)
    assert flight.mission.outcome == f"battery at 15 %: {said}"


def test_who_is_taken_over_on_its_way_back_has_the_outcome_of_that() -> None:
    flight = on_its_way_back()
    flight.flight_mode, flight.failsafe_mode = FlightMode.MANUAL, Mode.PILOT_OVERRIDE
    flight.run(1.0)
    flight.armed, flight.landed = False, Landed.ON_GROUND
    flight.run(1.0)
    assert (flight.at, flight.mission.outcome) == ("DONE", TAKEN_OVER)
