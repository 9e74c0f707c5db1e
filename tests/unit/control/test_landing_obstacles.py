"""Where agents land that would come down on an obstacle, and that none of them waits for ever because of it."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.reference.landing_places import Taken, landing_place_ned_m
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, Mode, Phase, Verb
from tests.benches.state_machine_flight import START, Flight, controlled

NORTH, EAST, DOWN = START
BALL = Obstacle(center_ned_m=(NORTH + 0.5, EAST, DOWN + 5.0), radius_m=1.0, keep_out_m=1.75)
ROOM_M = BALL.keep_out_m + 0.1


def destination(flight: Flight) -> Array:
    """Return where the reference ends (3,)."""
    pos, _ = flight.mission.reference(flight.utc_us, flight.now_us, np.array([60.0]))
    end: Array = pos[0]
    return end


def apart_m(place: Array, obstacle: Obstacle = BALL) -> float:
    return float(np.linalg.norm((place - np.array(obstacle.center_ned_m))[:2]))


def returning(*obstacles: Obstacle) -> Flight:
    """Return a flight on its way to the start position."""
    flight = controlled(Phase.GOTO_LAND)
    flight.failsafe_mode, flight.obstacles = Mode.TRACKING, obstacles
    return flight


def landing(*obstacles: Obstacle) -> Flight:
    """Return a flight that an operator lands at the start position."""
    flight = controlled(Phase.TRACK)
    flight.failsafe_mode, flight.obstacles, flight.pos = Mode.TRACKING, obstacles, START.copy()
    flight.ask("land")
    return flight


def test_who_returns_to_above_an_obstacle_lands_beside_it() -> None:
    flight = returning(BALL)
    flight.run(0.2)
    place = destination(flight)
    assert apart_m(place) == pytest.approx(ROOM_M)
    assert place[2] == DOWN
    flight.pos = START.copy()
    assert Verb.LAND not in flight.run(1.0)
    flight.pos = place
    assert Verb.LAND in flight.run(1.0)


def test_who_is_landed_above_an_obstacle_moves_to_beside_it_first() -> None:
    flight = landing(BALL)
    assert Verb.LAND not in flight.run(6.0)
    place = destination(flight)
    assert apart_m(place) == pytest.approx(ROOM_M)
    flight.pos = place
    assert Verb.LAND in flight.run(6.0)


@pytest.mark.parametrize(
    "obstacle",
    [
        BALL.model_copy(update={"center_ned_m": (NORTH + 0.5, EAST, DOWN - 2.0)}),
        BALL.model_copy(update={"center_ned_m": (NORTH + 1.8, EAST, DOWN + 5.0)}),
    ],
    ids=["above", "beside"],
)
def test_negative_control_an_obstacle_that_is_not_on_the_way_down_moves_nobody(obstacle: Obstacle) -> None:
    flight = returning(obstacle)
    flight.pos = START.copy()
    assert Verb.LAND in flight.run(0.3)
    assert Verb.LAND in landing(obstacle).run(6.0)


def test_a_column_counts_at_every_height() -> None:
    flight = returning(BALL.model_copy(update={"column": True, "center_ned_m": (NORTH + 0.5, EAST, DOWN - 50.0)}))
    flight.run(0.2)
    assert apart_m(destination(flight)) == pytest.approx(ROOM_M)


def test_the_place_beside_an_obstacle_is_apart_from_peers_too() -> None:
    beside = START - np.array([1.35, 0.0, 0.0])
    flight = returning(BALL)
    flight.others = (beside,)
    flight.run(0.2)
    place = destination(flight)
    assert apart_m(place) >= ROOM_M - 0.01
    assert np.linalg.norm((place - beside)[:2]) >= 0.9 + 0.2 + 0.1 - 0.01
    flight.pos, flight.others = place, (place + np.array([0.5, 0.0, 0.0]),)
    assert Verb.LAND not in flight.run(1.0), "a peer has come there meanwhile"


def test_a_pause_on_the_way_beside_an_obstacle_ends_with_the_same_way() -> None:
    flight = returning(BALL)
    flight.run(0.2)
    place = destination(flight)
    flight.unresponsive_peer = True
    flight.run(1.0)
    assert np.linalg.norm(destination(flight) - flight.pos) < 0.5
    flight.unresponsive_peer = False
    flight.run(0.2)
    np.testing.assert_allclose(destination(flight), place)


def test_where_no_place_is_free_the_way_to_the_one_with_most_room_is_flown() -> None:
    """A way that began anew in every tick would always be one of full length."""
    grid_m = 2.4 * np.arange(-12, 13)  # discs of 1.75 m leave no gap
    flight = returning(*(BALL.model_copy(update={"center_ned_m": (n, e, DOWN)}) for n in grid_m for e in grid_m))
    flight.run(0.2)
    begun = flight.mission.landing._trajectories.current
    flight.run(1.0)
    assert flight.mission.landing._trajectories.current is begun


def test_after_the_timeout_it_lands_even_above_an_obstacle() -> None:
    flight = landing(BALL)
    assert Verb.LAND not in flight.run(19.0)
    assert Verb.LAND in flight.run(3.0)


def test_a_place_that_is_not_reached_is_given_up() -> None:
    flight = returning(BALL)
    assert Verb.LAND not in flight.run(19.0)
    flight.pos = START.copy()  # above the obstacle
    assert Verb.LAND not in flight.run(19.0)
    assert Verb.LAND in flight.run(24.0)


def test_without_a_plan_it_is_landed_at_once_even_above_an_obstacle() -> None:
    flight = controlled(Phase.TRACK)
    flight.obstacles, flight.failsafe_mode, flight.pos = (BALL,), Mode.LAND, START.copy()
    assert Verb.LAND in flight.run(0.3)


def test_a_place_between_overlapping_discs_is_left_though_each_pushes_it_into_the_other() -> None:
    centers = [np.array([-0.8, 0.0, 0.0]), np.array([0.8, 0.0, 0.0])]
    taken = [Taken(center_ned_m=center, apart_m=1.85) for center in centers]
    place = landing_place_ned_m(np.array([0.1, 0.0, -4.0]), taken, 0)
    assert min(np.linalg.norm((place - center)[:2]) for center in centers) >= 1.85
    assert np.linalg.norm(place[:2]) < 3.0, "and not far away"
