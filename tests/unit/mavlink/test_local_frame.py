"""One shared frame over vehicles with local origins of their own that move in flight."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pymap3d
import pytest

from swarmctl.core.types import MAX_MARGIN_M, Array, GeoOrigin
from swarmctl.mavlink.vehicle.local_frame import LocalFrame

SHARED = GeoOrigin(47.397742, 8.545594, 489.4)
STEP_US = 20_000
EAST = np.array([0.0, 2.0, 0.0])  # m/s


def at(north: float, east: float, down: float) -> GeoOrigin:
    return GeoOrigin(*pymap3d.ned2geodetic(north, east, down, SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m))


class Vehicle:
    """Flies east at 2 m/s; its local origin can be moved, with and without saying so."""

    def __init__(self, armed: bool = True) -> None:
        self.frame = LocalFrame(SHARED)
        self.armed = armed
        self.t_us = 1_000_000
        self.true = np.zeros(3)
        self.origin = np.array([10.0, -20.0, 1.0])

    def say(self) -> None:
        self.frame.told(at(*self.origin))

    def fly(self, seconds: float) -> list[Array | None]:
        found = []
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.t_us += STEP_US
            self.true = self.true + EAST * STEP_US * 1e-6
            found.append(self.frame.place(self.t_us, self.true - self.origin, EAST, self.armed))
        return found

    def error_m(self, placed: list[Array | None]) -> float:
        assert placed[-1] is not None
        return float(np.linalg.norm(placed[-1] - self.true))


def known(placed: list[Array | None]) -> int:
    return sum(place is not None for place in placed)


def flying() -> Vehicle:
    vehicle = Vehicle()
    vehicle.say()
    vehicle.fly(1.0)
    return vehicle


def test_no_position_without_an_origin() -> None:
    vehicle = Vehicle()
    assert vehicle.fly(0.1) == [None] * 5
    assert vehicle.frame.wants_origin
    assert vehicle.frame.invalid["no origin"] == 5
    vehicle.say()
    assert vehicle.error_m(vehicle.fly(0.1)) < 0.02
    assert not vehicle.frame.wants_origin


def test_an_origin_that_moves_first_in_positions_then_in_words_gives_no_wrong_position() -> None:
    vehicle = flying()
    vehicle.origin = vehicle.origin + np.array([30.0, 0.0, 0.0])
    placed = vehicle.fly(0.2)
    assert known(placed) == len(placed)
    assert vehicle.error_m(placed) < 0.02
    assert vehicle.frame.wants_origin
    vehicle.say()
    assert vehicle.error_m(vehicle.fly(0.2)) < 0.02
    assert not vehicle.frame.wants_origin
    assert (vehicle.frame.jumps, vehicle.frame.margin_m) == (0, 0.0), "nothing has moved in the shared frame"
    assert vehicle.error_m(vehicle.fly(20.0)) < 0.02


def test_an_origin_that_moves_first_in_words_is_used_from_the_first_position_that_fits_it() -> None:
    vehicle = flying()
    before = vehicle.origin
    vehicle.origin = before + np.array([0.4, 0.0, 0.0])  # less than any jump that would be noticed
    vehicle.say()
    vehicle.origin = before
    assert vehicle.error_m(vehicle.fly(0.2)) < 0.02
    vehicle.origin = before + np.array([0.4, 0.0, 0.0])
    assert vehicle.error_m(vehicle.fly(0.2)) < 0.02


UP = np.array([0.0, 0.0, -5.0])


def jumped(vehicle: Vehicle, by_ned_m: Array = UP) -> Vehicle:
    """The estimate alone: `true` becomes what the estimator takes for it."""
    vehicle.true = vehicle.true + by_ned_m
    return vehicle


def steps_m(placed: list[Array | None]) -> list[float]:
    """Sizes of the steps from position to position, beyond what the velocity makes."""
    found = [place for place in placed if place is not None]
    return [float(np.linalg.norm(b - a - EAST * STEP_US * 1e-6)) for a, b in pairwise(found)]


@pytest.mark.parametrize("answered", [True, False], ids=["origin told again", "origin never told again"])
def test_a_long_jump_of_the_estimate_moves_no_vehicle_and_becomes_a_margin(answered: bool) -> None:
    vehicle = flying()
    before = vehicle.fly(0.02)
    placed = before + jumped(vehicle).fly(0.02)
    if answered:
        vehicle.say()
    placed += vehicle.fly(2.0)
    assert vehicle.frame.margin_m == pytest.approx(2.0 * (2.0 if answered else 1.5), abs=0.1)
    placed += vehicle.fly(30.0)
    assert vehicle.error_m(placed) == pytest.approx(5.0, abs=0.02)
    assert max(steps_m(placed)) < 1e-6
    assert (vehicle.frame.jumps, vehicle.frame.margin_m) == (1, vehicle.frame.jump_m)
    assert vehicle.frame.jump_m == pytest.approx(5.0, abs=0.02)
    vehicle.armed = False
    assert vehicle.error_m(vehicle.fly(0.1)) < 0.02, "on the ground everything is believed"
    assert vehicle.frame.margin_m == 0.0


def test_a_short_jump_of_the_estimate_is_drawn_in_slowly_once_positions_are_steady() -> None:
    vehicle = flying()
    placed = vehicle.fly(0.02) + jumped(vehicle, 0.16 * UP).fly(2.9)
    assert vehicle.error_m(placed) == pytest.approx(0.8, abs=0.02)
    placed += vehicle.fly(2.0)
    assert vehicle.frame.margin_m == pytest.approx(0.8, abs=0.02), "as long as it may be at either place"
    placed += vehicle.fly(1.0)
    assert vehicle.error_m(placed) < 0.02
    assert max(steps_m(placed)) <= 0.3 * STEP_US * 1e-6 + 1e-6
    vehicle.fly(30.0)
    assert vehicle.frame.margin_m == pytest.approx(0.8, abs=0.02), "nobody has said which place was the right one"
    vehicle.armed = False
    vehicle.fly(0.1)
    assert vehicle.frame.margin_m == 0.0


def test_margins_of_jumps_that_were_drawn_in_add_up() -> None:
    vehicle = jumped(flying(), 0.1 * UP)
    vehicle.fly(8.0)
    jumped(vehicle, np.array([0.5, 0.0, 0.0])).fly(8.0)
    assert vehicle.frame.margin_m == pytest.approx(0.71, abs=0.02)
    jumped(vehicle, -0.1 * UP).fly(8.0)
    assert vehicle.frame.margin_m == pytest.approx(0.5, abs=0.02)


def test_the_margin_ends_where_the_estimator_tells_that_it_has_corrected_itself() -> None:
    vehicle = flying()
    vehicle.fly(0.02)
    jumped(vehicle, 0.1 * UP)
    vehicle.t_us += STEP_US
    vehicle.true = vehicle.true + EAST * STEP_US * 1e-6
    vehicle.frame.place(vehicle.t_us, vehicle.true - vehicle.origin, EAST, True, reset=True)
    vehicle.fly(2.0)
    assert vehicle.frame.margin_m == pytest.approx(0.5, abs=0.02)
    assert vehicle.error_m(vehicle.fly(8.0)) < 0.02
    assert vehicle.frame.margin_m == 0.0


def test_the_margin_grows_no_faster_than_others_can_make_room() -> None:
    vehicle = jumped(flying())
    vehicle.fly(0.02)
    vehicle.say()
    margins_m = []
    for _ in range(50):
        vehicle.fly(0.02)
        margins_m.append(vehicle.frame.margin_m)
    assert margins_m[0] < 0.1
    assert margins_m[-1] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("by_01", "after_s"), [(1.0, 8.0), (0.16, 4.0)], ids=["long", "short and being drawn in"])
def test_an_estimate_that_jumps_back_leaves_the_vehicle_where_it_is(by_01: float, after_s: float) -> None:
    vehicle = jumped(flying(), by_01 * UP)
    placed = vehicle.fly(after_s)
    placed += jumped(vehicle, -by_01 * UP).fly(20.0)
    assert max(steps_m(placed)) <= 0.3 * STEP_US * 1e-6 + 1e-6
    assert vehicle.error_m(placed) < 0.02
    assert vehicle.frame.margin_m == 0.0


@pytest.mark.parametrize("moved_m", [0.8, 5.0])
def test_an_origin_that_moves_with_a_reset_is_asked_for(moved_m: float) -> None:
    vehicle = flying()
    vehicle.origin = vehicle.origin + np.array([moved_m, 0.0, 0.0])  # its GPS_GLOBAL_ORIGIN is lost
    vehicle.t_us += STEP_US
    vehicle.true = vehicle.true + EAST * STEP_US * 1e-6
    vehicle.frame.place(vehicle.t_us, vehicle.true - vehicle.origin, EAST, True, reset=True)
    vehicle.fly(0.1)
    assert vehicle.frame.wants_origin
    vehicle.say()
    placed = vehicle.fly(20.0)
    assert vehicle.error_m(placed) < 0.02, "nothing is drawn in"
    assert not vehicle.frame.wants_origin
    assert vehicle.frame.margin_m == 0.0


def test_a_step_that_the_estimator_tells_of_is_bridged_however_small() -> None:
    for reset, jumps in ((False, 0), (True, 1)):
        vehicle = flying()
        before = vehicle.fly(0.02)[-1]
        jumped(vehicle, UP * 0.02)
        vehicle.t_us += STEP_US
        vehicle.true = vehicle.true + EAST * STEP_US * 1e-6
        after = vehicle.frame.place(vehicle.t_us, vehicle.true - vehicle.origin, EAST, True, reset=reset)
        assert before is not None
        assert after is not None
        assert vehicle.frame.jumps == jumps
        assert (abs(float(after[2] - before[2])) < 0.01) is reset


def test_a_margin_that_no_peer_would_accept_is_not_published() -> None:
    vehicle = jumped(flying(), UP * 100.0)
    vehicle.fly(20.0)
    assert vehicle.frame.margin_m == MAX_MARGIN_M


def test_on_the_ground_an_estimator_may_settle() -> None:
    vehicle = Vehicle(armed=False)
    vehicle.say()
    vehicle.fly(0.1)
    vehicle.true = vehicle.true + np.array([0.0, 0.0, 5.0])
    assert known(vehicle.fly(0.1)) == 5


def test_without_gps_global_origin_it_is_worked_out_from_positions() -> None:
    vehicle = Vehicle()
    for k in range(200):
        vehicle.fly(0.02)
        if k % 5 == 0:
            place = at(*(vehicle.true + EAST * 0.03))  # 30 ms newer than the local one
            vehicle.frame.seen(
                place, vehicle.t_us + 30_000, vehicle.t_us, vehicle.true - vehicle.origin, vel_ned_m_s=EAST
            )
    assert vehicle.error_m(vehicle.fly(0.1)) < 0.02
    stale = Vehicle()
    for _ in range(200):
        stale.fly(0.02)
        stale.frame.seen(at(0.0, 0.0, 0.0), stale.t_us + 200_000, stale.t_us, stale.true, vel_ned_m_s=EAST)
    assert stale.frame.offset_ned_m is None, "positions of two moments tell nothing"


def test_a_rebooted_vehicle_counts_from_somewhere_else() -> None:
    vehicle = flying()
    vehicle.frame.forget()
    assert vehicle.fly(0.1) == [None] * 5
