"""One swarm frame over vehicles that count from places of their own, and move those in flight."""

from __future__ import annotations

import numpy as np
import pymap3d

from swarmctl.core.types import Array, GeoOrigin
from swarmctl.links.local_frame import LocalFrame

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
    assert vehicle.fly(0.2) == [None] * 10
    assert vehicle.frame.wants_origin
    assert vehicle.frame.invalid["position jumped"] == 10
    vehicle.say()
    placed = vehicle.fly(0.2)
    assert known(placed) == len(placed)
    assert vehicle.error_m(placed) < 0.02
    assert vehicle.frame.jumps == 0, "nothing has moved in the shared frame"


def test_an_origin_that_moves_first_in_words_is_used_from_the_first_position_that_fits_it() -> None:
    vehicle = flying()
    before = vehicle.origin
    vehicle.origin = before + np.array([0.4, 0.0, 0.0])  # less than any jump that would be noticed
    vehicle.say()
    vehicle.origin = before
    assert vehicle.error_m(vehicle.fly(0.2)) < 0.02
    vehicle.origin = before + np.array([0.4, 0.0, 0.0])
    assert vehicle.error_m(vehicle.fly(0.2)) < 0.02


def test_an_estimate_that_jumps_is_believed_when_the_origin_is_told_to_be_the_same() -> None:
    vehicle = flying()
    vehicle.true = vehicle.true + np.array([0.0, 0.0, 5.0])
    assert vehicle.fly(0.1) == [None] * 5
    vehicle.say()
    assert vehicle.error_m(vehicle.fly(0.1)) < 0.02
    assert vehicle.frame.jumps == 1


def test_without_any_word_it_is_believed_after_two_seconds() -> None:
    vehicle = flying()
    vehicle.true = vehicle.true + np.array([0.0, 0.0, 5.0])
    assert known(vehicle.fly(1.9)) == 0
    assert vehicle.error_m(vehicle.fly(0.2)) < 0.02
    assert vehicle.frame.jumps == 1


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
            vehicle.frame.seen(place, vehicle.t_us + 30_000, vehicle.t_us, vehicle.true - vehicle.origin, EAST)
    assert vehicle.error_m(vehicle.fly(0.1)) < 0.02
    stale = Vehicle()
    for _ in range(200):
        stale.fly(0.02)
        stale.frame.seen(at(0.0, 0.0, 0.0), stale.t_us + 200_000, stale.t_us, stale.true, EAST)
    assert stale.frame.offset_ned_m is None, "positions of two moments tell nothing"


def test_a_rebooted_vehicle_counts_from_somewhere_else() -> None:
    vehicle = flying()
    vehicle.frame.forget()
    assert vehicle.fly(0.1) == [None] * 5
