"""A climb that an autopilot flies, which avoids nobody, and an obstacle that comes into its way, or below it."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import FlightMode, Phase, Verb
from tests.benches.state_machine_flight import START, Flight, in_phase

NORTH, EAST, DOWN = START
BALL = Obstacle(center_ned_m=(NORTH + 0.5, EAST, DOWN), radius_m=1.0, keep_out_m=1.2)
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
    return flight.run(LONG_S) == [] and flight.phase is Phase.TAKEOFF and not flight.mission.pilot_override


def test_it_is_stopped_for_as_long_as_an_obstacle_is_above() -> None:
    flight = climbing(BALL)
    assert holds(flight)
    assert flight.mission.waits_for == "an obstacle 0.50 m beside its climb to go (keep_out_m = 1.2)"
    flight.obstacles = ()
    flight.run(0.3)
    assert flight.phase is Phase.GOTO_START
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
    assert flight.phase is Phase.GOTO_START


def test_an_operator_sends_it_on_by_hold_and_resume_under_the_agents_own_planner() -> None:
    flight = climbing(BALL)
    assert holds(flight)
    assert flight.ask("hold") == ""
    flight.run(1.0)
    assert flight.ask("resume") == ""
    flight.run(0.3)
    assert flight.phase is Phase.GOTO_START


def test_who_waits_too_long_is_landed_and_says_why() -> None:
    flight = climbing(BALL)
    assert holds(flight)
    assert Verb.LAND in flight.run(40.0)
    assert flight.mission.outcome.startswith("not tracking after 90 s (TAKEOFF): an obstacle 0.50 m beside its climb")
