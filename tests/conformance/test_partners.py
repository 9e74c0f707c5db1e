"""The clock that a vehicle given by URL is judged by."""

from __future__ import annotations

import pytest

from tests.conformance.partners import VehicleClock


class Wall:
    """The wall's clock, set by the test."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def booted() -> tuple[VehicleClock, Wall]:
    """Return the clock of a vehicle that was first heard 1.3 s after it was started."""
    wall = Wall()
    clock = VehicleClock(wall)
    wall.now_s += 1.3
    clock.heard(1.2, 0.0)
    return clock, wall


def test_until_it_is_heard_time_passes_as_on_the_wall() -> None:
    assert booted()[0].now_s() == pytest.approx(101.3)


def test_a_slow_simulation_makes_time_slow() -> None:
    clock, wall = booted()
    for k in range(1, 101):
        wall.now_s += 0.02
        clock.heard(1.2 + 0.01 * k, 0.0)
    assert clock.now_s() == pytest.approx(102.3)


def test_the_age_of_a_message_is_no_time_of_the_vehicle() -> None:
    clock, wall = booted()
    wall.now_s += 0.1
    clock.heard(1.25, 0.05)
    assert clock.now_s() == pytest.approx(101.4)


def test_time_stands_still_with_the_simulation_for_a_second_and_never_runs_back() -> None:
    clock, wall = booted()
    wall.now_s += 0.01
    clock.heard(1.21, 0.0)
    passed_s = []
    for silent_s in (0.01, 0.5, 1.01, 2.0):
        wall.now_s = 101.31 + silent_s
        passed_s.append(clock.now_s() - 101.31)
    assert passed_s == pytest.approx([0.01, 0.02, 0.02, 1.0])
    clock.heard(1.3, 0.0)
    assert clock.now_s() == pytest.approx(102.31)


def test_a_vehicle_that_starts_again_begins_at_zero() -> None:
    clock, wall = booted()
    clock.started()
    wall.now_s += 1.3
    clock.heard(1.25, 0.0)
    assert clock.now_s() == pytest.approx(102.6)
    wall.now_s += 0.1
    clock.heard(1.35, 0.0)
    assert clock.now_s() == pytest.approx(102.7)
