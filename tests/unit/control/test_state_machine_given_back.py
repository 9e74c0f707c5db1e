"""Tests of what follows when a pilot brings a vehicle down or gives it back, and of orders that come in between."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.failsafe.decision import Escalation, Response
from swarmctl.control.phases.mission_state import TAKEN_OVER
from swarmctl.control.phases.trajectories import OfferedMission
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.types import FlightMode, Landed, Mode, Phase, Verb
from tests.benches.state_machine_flight import SECOND, START, UTC0_US, Flight, ready


@pytest.mark.parametrize("mode", [FlightMode.LAND, FlightMode.RTL, FlightMode.MANUAL])
def test_a_vehicle_that_a_pilot_brings_down_while_it_takes_off_stays_down(mode: FlightMode) -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.flight_mode = FlightMode.TAKEOFF
    flight.step()
    flight.flight_mode = mode
    assert flight.run(20.0) == [], "it would take off at who walks up to it"
    assert flight.mission.outcome == TAKEN_OVER
    flight.armed = False
    flight.run(1.0)
    assert flight.phase is Phase.DONE


def test_a_vehicle_that_was_armed_in_another_mode_takes_off() -> None:
    flight = Flight().until(Phase.ARM)
    flight.flight_mode, flight.armed = FlightMode.MANUAL, True
    flight.step()
    assert Verb.TAKEOFF in flight.run(1.0)


def away(phase: Phase, seconds: float) -> Flight:
    """Return a flight whose pilot took the vehicle 20 m away in a phase, and gives it back after some time."""
    flight = Flight().until(phase)
    flight.flight_mode = FlightMode.MANUAL
    flight.failsafe_mode = Mode.PILOT_OVERRIDE
    flight.run(seconds)
    flight.pos = flight.pos + np.array([20.0, 0.0, 0.0])
    flight.flight_mode, flight.failsafe_mode = FlightMode.HOLD, Mode.PRIMING
    assert flight.ask("resume") == ""
    return flight


def held_on_its_way_down() -> Flight:
    """Return a flight whose vehicle a pilot holds while its autopilot lands it."""
    flight = Flight().until(Phase.LAND)
    flight.flight_mode = FlightMode.LAND
    flight.step()
    flight.flight_mode = FlightMode.HOLD
    flight.run(1.0)
    return flight


@pytest.mark.parametrize("phase", [Phase.READY, Phase.GOTO_LAND])
def test_a_vehicle_given_back_outside_of_the_mission_is_asked_for_and_goes_on(phase: Phase) -> None:
    flight = away(phase, 5.0)
    flight.peer(Phase.GOTO_START if phase is Phase.READY else Phase.GOTO_LAND)
    assert flight.run(0.5) == [Verb.EXTERNAL], "setpoints must not be sent at an autopilot that does not follow them"
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    flight.step()
    reference, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.zeros(1))
    assert np.linalg.norm(reference[0] - flight.pos) < 0.5, "it begins where the vehicle is"
    assert flight.phase is phase


def test_a_vehicle_that_was_had_back_lands_at_its_start() -> None:
    flight = away(Phase.GOTO_LAND, 5.0)
    flight.run(0.5)
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    flight.run(0.5)
    flight.pos = START.copy()
    assert flight.run(5.0)[:1] == [Verb.LAND]


@pytest.mark.parametrize("begun", [False, True], ids=["begins_later", "has_begun"])
def test_the_mission_is_approached_by_who_was_away_when_it_began(begun: bool) -> None:
    flight = away(Phase.READY, 5.0)
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    flight.step()
    ready_us = flight.utc_us - (3_000_000 if begun else 0)
    flight.peer(Phase.TRACK if begun else Phase.READY, ready_us)
    for _ in range(15):
        flight.step()
    assert flight.at == "TRACK"
    reference, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.zeros(1))
    assert np.linalg.norm(reference[0] - flight.pos) < 2.5


@pytest.mark.parametrize(("late_s", "away_m"), [(3.0, 0.0), (0.0, 1.0)], ids=["late", "away"])
def test_a_mission_that_begins_without_or_beside_its_vehicle_is_approached_from_where_that_is(
    late_s: float, away_m: float
) -> None:
    flight = ready()
    flight.run(5.0)
    flight.pos = flight.pos + np.array([0.0, away_m, 0.0])
    flight.peer(Phase.TRACK, flight.utc_us - SECOND - round(late_s * 1e6))
    while flight.phase is not Phase.TRACK:
        flight.step()
    reference, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.zeros(1))
    assert np.linalg.norm(reference[0] - flight.pos) < 0.3


def test_the_time_with_a_pilot_does_not_count_as_waiting() -> None:
    flight = away(Phase.READY, 200.0)
    flight.peer(Phase.GOTO_START)
    assert Verb.LAND not in flight.run(5.0)
    assert flight.phase is Phase.READY


@pytest.mark.parametrize("response", [Response.RTL, Response.LAND])
def test_a_worn_battery_waits_for_a_plan(response: Response) -> None:
    flight = Flight().until(Phase.TRACK)
    flight.pos = flight.pos + np.array([5.0, 0.0, 0.0])
    flight.failsafe_mode, flight.escalation = Mode.BRAKE, Escalation(response, "battery at 15 %")
    assert flight.run(1.0) == []
    assert flight.at == "TRACK"
    flight.failsafe_mode = Mode.TRACKING
    flight.step()
    assert flight.at == "GOTO_LAND"
    assert flight.mission.landing.in_place == (response is Response.LAND)


def test_a_mission_ordered_while_some_wait_begins_for_all_at_the_time_of_the_order() -> None:
    offered = OfferedMission(
        reference=MissionReference(MissionParams(kind="hover"), START[None, :], 0), duration_s=9.0, text="{}"
    )
    begins = {}
    for phase in (Phase.READY, Phase.TRACK):
        flight = Flight().until(Phase.READY)
        while flight.mission.begin_utc_us is None:
            flight._obey(flight.step())
        while flight.phase < phase:
            flight.step()
        flight.mission.offered = offered
        begin_s = UTC0_US * 1e-6 + 60.0
        if phase is Phase.READY:
            flight.now_us = flight.mission.begin_utc_us - UTC0_US
        assert flight.ask("mission", begin_utc_s=begin_s, mission=1.0) == ""
        flight.step()
        assert flight.phase is phase, "also where the mission before was about to begin"
        begins[phase] = flight.mission.begin_utc_us
    assert begins[Phase.READY] == begins[Phase.TRACK]


# -- what a resume is not taken for ------------------------------------------------------------------------------------


def test_a_worn_battery_waits_for_who_takes_its_vehicle_back() -> None:
    """Its autopilot would land it where the pilot has left it, on whatever is there."""
    flight = away(Phase.TRACK, 5.0)
    flight.escalation = Escalation(Response.RTL, "battery at 15 %")
    assert set(flight.run(1.0)) == {Verb.EXTERNAL}
    assert flight.at == "TRACK"
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    flight.step()
    flight.step()
    assert (flight.at, flight.mission.landing.in_place) == ("GOTO_LAND", False)


def test_a_worn_battery_waits_no_longer_than_a_vehicle_may_take_to_be_had_back() -> None:
    flight = away(Phase.TRACK, 5.0)
    flight.escalation = Escalation(Response.LAND, "battery at 8 %")
    flight.run(6.0)
    assert flight.at == "LAND"


def test_who_rests_for_a_silent_peer_rests_where_its_pilot_has_left_it() -> None:
    flight = Flight().until(Phase.TRACK)
    flight.unresponsive_peer = True
    flight.run(1.0)
    assert flight.mission.interruptions.paused
    flight.flight_mode = FlightMode.MANUAL
    flight.failsafe_mode = Mode.PILOT_OVERRIDE
    flight.run(5.0)
    flight.pos = flight.pos + np.array([20.0, 0.0, 0.0])
    flight.flight_mode, flight.failsafe_mode = FlightMode.HOLD, Mode.PRIMING
    assert flight.ask("resume") == ""
    flight.step()
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    flight.step()
    assert flight.mission.interruptions.paused
    reference, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([0.0, 5.0]))
    assert np.abs(reference - flight.pos).max() < 0.5


def test_a_landing_that_a_pilot_interrupts_is_taken_back_and_flown_to_where_there_is_room() -> None:
    flight = Flight().until(Phase.LAND)
    flight.flight_mode = FlightMode.LAND
    flight.step()
    assert flight.ask("resume") == ""
    assert flight.run(1.0) == [], "it has landed without"
    flight.flight_mode = FlightMode.HOLD
    flight.run(1.0)
    assert flight.mission.pilot_override
    assert "take it back with: resume" in flight.ask("land")
    assert flight.ask("resume") == ""
    assert flight.run(1.0) == [Verb.EXTERNAL]
    assert flight.at == "GOTO_LAND"
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    assert Verb.LAND in flight.run(10.0)


def test_a_vehicle_that_its_pilot_has_put_down_is_disarmed_after_a_resume_and_not_flown() -> None:
    flight = held_on_its_way_down()
    flight.landed = Landed.ON_GROUND
    assert flight.ask("resume") == ""
    assert flight.run(0.5) == [Verb.DISARM]


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.MANUAL])
def test_a_climb_that_somebody_stops_is_noted_and_flown_to_its_end_after_a_resume(mode: FlightMode) -> None:
    flight = Flight().until(Phase.TAKEOFF)
    flight.flight_mode, flight.landed = FlightMode.TAKEOFF, Landed.IN_AIR
    flight.pos = START + np.array([0.0, 0.0, 1.0])
    flight.step()
    flight.flight_mode = mode
    flight.run(2.0 if mode is FlightMode.HOLD else 0.0)
    assert not flight.mission.pilot_override or mode is FlightMode.MANUAL
    flight.run(2.0)
    assert flight.mission.outcome == TAKEN_OVER
    assert flight.ask("resume") == ""
    assert flight.run(1.0) == [Verb.EXTERNAL]
    assert flight.at == "GOTO_START"


def test_a_climb_that_its_autopilot_ends_near_its_height_goes_on() -> None:
    """Nobody has stopped it: estimates of heights drift."""
    flight = Flight().until(Phase.TAKEOFF)
    flight.flight_mode, flight.landed = FlightMode.TAKEOFF, Landed.IN_AIR
    flight.pos = START + np.array([0.0, 0.0, 0.6])
    flight.step()
    flight.flight_mode = FlightMode.HOLD
    flight.run(4.0)
    assert (flight.at, flight.mission.pilot_override) == ("GOTO_START", False)


def test_a_landing_that_can_not_be_had_back_is_landed_all_the_same() -> None:
    flight = held_on_its_way_down()
    assert flight.ask("resume") == ""
    assert set(flight.run(4.5)) == {Verb.EXTERNAL}
    assert Verb.LAND in flight.run(10.0)


@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.MANUAL, FlightMode.RTL])
@pytest.mark.parametrize(("phase", "order"), [(Phase.TRACK, "rtl"), (Phase.TRACK, ""), (Phase.GOTO_LAND, "")])
def test_an_autopilot_that_gives_no_control_is_asked_for_half_a_minute_and_keeps_the_vehicle(
    phase: Phase, order: str, mode: FlightMode
) -> None:
    """It was asked for ever: long after, when nobody expects it any more, it might have set off."""
    flight = away(phase, 5.0)
    flight.flight_mode = mode
    if order:
        assert flight.ask(order) == ""
    asked = flight.run(300.0)
    assert asked == [Verb.EXTERNAL] * 30
    assert flight.mission.pilot_override
    assert flight.mission.outcome == f"no control 30 s after resume: it stays in {mode.name}"
    assert "take it back with: resume" in flight.ask("rtl")
    assert flight.ask("resume") == ""
    assert flight.run(2.0) == [Verb.EXTERNAL] * 2, "another resume asks again"
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    flight.run(0.5)
    assert flight.mission.had_control
    if order:
        flight.pos = START.copy()
        assert flight.run(5.0)[:1] == [Verb.LAND], "it goes on with the order"


def test_a_hold_that_ends_begins_to_ask_anew() -> None:
    flight = away(Phase.GOTO_LAND, 5.0)
    assert flight.ask("hold") == ""
    assert flight.run(60.0) == []
    assert flight.ask("resume") == ""
    assert flight.run(2.0) == [Verb.EXTERNAL] * 2
    assert not flight.mission.pilot_override


def test_who_has_control_keeps_it_however_long_ago_it_was_given_back() -> None:
    flight = away(Phase.GOTO_LAND, 5.0)
    flight.run(29.0)
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    flight.run(10.0)
    assert flight.mission.had_control
    assert not flight.mission.pilot_override
