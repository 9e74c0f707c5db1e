"""A climb that an autopilot flies, which avoids nobody, and an obstacle that comes into its way, or below it."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import FlightMode, Mode, Phase, Verb
from tests.benches.state_machine_flight import START, Flight, in_phase

NORTH, EAST, DOWN = START
BALL = Obstacle(center_ned_m=(NORTH + 0.5, EAST, DOWN), radius_m=1.0, keep_out_m=1.2)
BELOW = BALL.model_copy(update={"center_ned_m": (NORTH + 0.5, EAST, DOWN + 3.0)})
LONG_S = 60.0  # within `start_timeout_s`


def climbing(*obstacles: Obstacle) -> Flight:
    """Return a flight half way up, 1.5 m below its start."""
    flight = in_phase(Phase.TAKEOFF)
    flight.obstacles = obstacles
    return flight


def holds(flight: Flight) -> bool:
    """Return whether the autopilot is asked to hold, and nothing else once it does."""
    asked = flight.run(0.5)
    if asked != [Verb.HOLD]:
        return False
    flight.flight_mode = FlightMode.HOLD
    return flight.run(LONG_S) == [] and flight.at == "TAKEOFF" and not flight.mission.pilot_override


def test_it_is_stopped_for_as_long_as_an_obstacle_is_above() -> None:
    flight = climbing(BALL)
    assert holds(flight)
    assert flight.mission.waits_for == "an obstacle 0.50 m beside its climb to go (keep_out_m = 1.2)"
    flight.obstacles = ()
    flight.run(0.3)
    assert flight.at == "GOTO_START"
    assert flight.mission.climb.cut_short, "the agent flies the rest of it"


@pytest.mark.parametrize(
    ("center", "is_column", "stops"),
    [
        ((0.0, 0.0, 1.4), False, True),
        ((1.1, 0.0, 0.0), False, True),
        ((0.0, 0.0, -1.1), False, True),
        ((0.0, 0.0, 9.0), True, True),
        ((0.0, 0.0, 1.6), False, False),
        ((1.3, 0.0, 0.0), False, False),
        ((0.0, 0.0, -1.3), False, False),
    ],
    ids=["just above", "beside", "reaches down to its height", "column", "just below", "farther", "above its height"],
)
def test_only_what_is_between_it_and_its_height_stops_it(
    center: tuple[float, float, float], is_column: bool, stops: bool
) -> None:
    there = tuple((START + np.array(center)).tolist())
    flight = climbing(BALL.model_copy(update={"center_ned_m": there, "column": is_column}))
    assert holds(flight) is stops


def test_an_obstacle_that_goes_before_the_autopilot_holds_leaves_it_to_the_agent() -> None:
    flight = climbing(BALL)
    assert flight.run(0.1) == [Verb.HOLD]
    flight.obstacles = ()
    assert flight.run(0.3) == []
    flight.flight_mode = FlightMode.HOLD  # as asked before
    flight.run(0.3)
    assert flight.at == "GOTO_START"


PASSING = BALL.model_copy(update={"center_ned_m": (NORTH + 3.0, EAST, DOWN), "vel_ned_m_s": (-0.5, 0.0, 0.0)})


def test_of_one_that_moves_into_its_way_the_agent_takes_control_and_keeps_clear_itself() -> None:
    flight = climbing(PASSING)
    assert flight.run(0.1) == [Verb.HOLD]
    flight.flight_mode = FlightMode.HOLD
    flight.run(0.3)
    assert flight.at == "GOTO_START"
    assert flight.mission.climb.cut_short


@pytest.mark.parametrize(
    "passing",
    [
        PASSING.model_copy(update={"vel_ned_m_s": (0.5, 0.0, 0.0)}),
        PASSING.model_copy(update={"vel_ned_m_s": (-0.1, 0.0, 0.0)}),
        PASSING.model_copy(update={"center_ned_m": (NORTH + 3.0, EAST + 1.3, DOWN)}),
        PASSING.model_copy(update={"center_ned_m": (NORTH + 3.0, EAST, DOWN + 4.0)}),
    ],
    ids=["goes away", "comes too late", "passes beside it", "passes below it"],
)
def test_negative_control_what_does_not_come_into_its_way_leaves_it_to_its_autopilot(passing: Obstacle) -> None:
    flight = climbing(passing)
    assert flight.run(1.0) == []
    assert flight.at == "TAKEOFF"


def test_nothing_is_armed_while_one_is_about_to_cross_its_climb() -> None:
    flight = in_phase(Phase.STANDBY)
    flight.obstacles = (PASSING,)
    assert flight.run(5.0) == []
    assert flight.mission.waits_for == "an obstacle that moves to be past its climb (keep_out_m = 1.2)"
    flight.obstacles = (PASSING.model_copy(update={"center_ned_m": (NORTH - 1.3, EAST, DOWN)}),)
    assert Verb.ARM in flight.run(1.0)


def above_its_place(obstacle: Obstacle) -> Flight:
    """Return a flight that may be landed, 3 m high."""
    flight = in_phase(Phase.GOTO_LAND)
    flight.pos, flight.obstacles = START.copy(), (obstacle,)
    return flight


def test_the_autopilot_does_not_land_it_while_one_is_about_to_cross_its_way_down() -> None:
    flight = above_its_place(PASSING)
    assert Verb.LAND not in flight.run(5.0)
    flight.obstacles = (PASSING.model_copy(update={"vel_ned_m_s": (-0.1, 0.0, 0.0)}),)
    assert Verb.LAND in flight.run(1.0)


def test_who_lacks_a_way_down_for_too_long_is_landed() -> None:
    flight = above_its_place(PASSING)
    assert Verb.LAND in flight.run(LONG_S)


def test_an_operator_sends_it_on_by_hold_and_resume_under_the_agents_own_planner() -> None:
    flight = climbing(BALL)
    assert holds(flight)
    assert flight.ask("hold") == ""
    flight.run(1.0)
    assert flight.ask("resume") == ""
    flight.run(0.3)
    assert flight.at == "GOTO_START"


def test_who_waits_too_long_is_landed_and_says_why() -> None:
    flight = climbing(BALL)
    assert holds(flight)
    assert Verb.LAND in flight.run(40.0)
    assert flight.mission.outcome.startswith("not tracking after 90 s (TAKEOFF): an obstacle 0.50 m beside its climb")


@pytest.mark.parametrize("verb", ["land", "rtl"])
def test_who_is_landed_above_an_obstacle_holds_takes_control_and_lands_beside_it(verb: str) -> None:
    flight = climbing(BELOW)
    assert flight.ask(verb) == ""
    assert flight.run(0.5) == [Verb.HOLD]
    assert flight.at == "TAKEOFF"
    flight.flight_mode = FlightMode.HOLD
    assert flight.run(0.5) == [Verb.EXTERNAL]
    flight.flight_mode, flight.failsafe_mode = FlightMode.EXTERNAL, Mode.TRACKING
    assert Verb.LAND not in flight.run(6.0)
    assert flight.at == "GOTO_LAND"
    place = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))[0][0]
    assert np.linalg.norm((place - np.array(BELOW.center_ned_m))[:2]) == pytest.approx(BELOW.keep_out_m + 0.1)
    flight.pos = place
    assert Verb.LAND in flight.run(6.0)


@pytest.mark.parametrize("verb", ["land", "rtl"])
def test_negative_control_nothing_below_delays_a_landing(verb: str) -> None:
    flight = climbing(BALL)
    flight.ask(verb)
    assert flight.run(0.5) == [Verb.LAND]
    assert flight.at == "LAND"


def test_a_stop_above_an_obstacle_is_sticky() -> None:
    flight = climbing(BELOW)
    flight.ask("land")
    flight.flight_mode = FlightMode.HOLD
    flight.ask("hold")
    assert flight.run(1.0) == []
    assert flight.at == "TAKEOFF"
    flight.ask("resume")
    flight.run(0.3)
    assert flight.at == "GOTO_LAND"


def test_once_the_obstacle_has_gone_the_autopilot_lands_it() -> None:
    flight = climbing(BELOW)
    flight.ask("land")
    flight.run(0.2)
    flight.obstacles = ()
    assert flight.run(0.5) == [Verb.LAND]


def test_a_start_that_is_given_up_above_an_obstacle_is_no_reason_to_land_on_it() -> None:
    flight = climbing(BELOW)
    asked = flight.run(91.0)
    assert asked.count(Verb.LAND) == 0
    assert asked.count(Verb.HOLD) > 0
    assert flight.mission.outcome.startswith("not tracking after 90 s")


@pytest.mark.parametrize("mode", [FlightMode.TAKEOFF, FlightMode.HOLD], ids=["does not hold", "gives no control"])
def test_an_autopilot_that_does_not_obey_lands_it_all_the_same(mode: FlightMode) -> None:
    flight = climbing(BELOW)
    flight.ask("land")
    flight.flight_mode = mode
    assert Verb.LAND not in flight.run(19.0)
    assert Verb.LAND in flight.run(5.0)


def test_a_pilot_who_takes_it_meanwhile_has_it_and_gives_it_back_to_be_landed_beside() -> None:
    flight = climbing(BELOW)
    flight.ask("land")
    flight.run(0.2)
    flight.flight_mode = FlightMode.MANUAL
    assert flight.run(1.0) == []
    assert flight.mission.pilot_override
    assert flight.ask("resume") == ""
    assert flight.run(0.5) == [Verb.EXTERNAL]
    assert flight.at == "GOTO_LAND"


def test_who_has_climbed_and_has_no_control_yet_lands_beside_it_too() -> None:
    flight = Flight().until(Phase.GOTO_START)
    flight.obstacles = (BELOW,)
    flight.ask("land")
    assert set(flight.run(4.0)) == {Verb.EXTERNAL}
    flight.obstacles = ()
    assert Verb.LAND in flight.run(4.0)


@pytest.mark.parametrize(("comes_in_s", "is_armed"), [(5.0, False), (11.0, False), (14.0, True)])
def test_nobody_is_armed_while_an_obstacle_comes_within_the_time_to_spin_up_climb_and_take_control(
    comes_in_s: float, is_armed: bool
) -> None:
    """It takes 6 s to spin up, 3 s to climb 3 m, and 3 s until the agent has control."""
    flight = Flight()
    north = NORTH + BALL.keep_out_m + 0.5 * comes_in_s
    flight.obstacles = (PASSING.model_copy(update={"center_ned_m": (north, EAST, DOWN)}),)
    assert (Verb.ARM in flight.run(1.0)) is is_armed
