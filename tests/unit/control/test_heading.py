"""The heading turns the shorter way round, at a bounded rate, and is exactly what is asked for."""

from __future__ import annotations

import itertools
import math

import pytest

from swarmctl.control.reference.heading import Heading

TICK_US = 20_000


def turn(heading: Heading, asked_rad: float | None, seconds: float, now_us: int = 0) -> list[float]:
    return [heading.at(now_us + TICK_US * k, asked_rad) for k in range(round(seconds * 1e6 / TICK_US))]


@pytest.mark.parametrize("asked_rad", [None, 0.1234567])
def test_where_it_does_not_turn_it_stays_bit_for_bit(asked_rad: float | None) -> None:
    assert set(turn(Heading(0.1234567), asked_rad, 1.0)) == {0.1234567}


@pytest.mark.parametrize(("mission_rad", "asked_rad"), [(0.0, math.pi / 2), (3.0, -3.0), (-3.0, 3.0), (0.0, -7.0)])
def test_it_turns_the_shorter_way_at_a_bounded_rate_and_back(mission_rad: float, asked_rad: float) -> None:
    heading = Heading(mission_rad)
    yaws = [mission_rad, *turn(heading, asked_rad, 5.0)]
    steps = [math.remainder(b - a, math.tau) for a, b in itertools.pairwise(yaws)]
    assert max(abs(step) for step in steps) <= 1.0 * TICK_US * 1e-6 + 1e-9
    assert sum(abs(step) for step in steps) == pytest.approx(abs(math.remainder(asked_rad - mission_rad, math.tau)))
    assert math.remainder(yaws[-1] - asked_rad, math.tau) == pytest.approx(0.0, abs=1e-12)
    assert turn(heading, mission_rad, 5.0, 10_000_000)[-1] == mission_rad


def test_after_a_gap_it_does_not_jump() -> None:
    heading = Heading(0.0)
    heading.at(0, None)
    assert abs(heading.at(60_000_000, 3.0)) <= 0.1


def test_a_vehicle_that_stands_at_another_heading_is_turned_from_there() -> None:
    heading = Heading(0.0)
    heading.begin(2.0)
    assert abs(heading.at(0, 0.0) - 2.0) < 0.03
    assert abs(turn(heading, 0.0, 1.0)[-1]) < 1.1, "a second later"


def test_what_estimates_are_off_by_turns_nothing() -> None:
    heading = Heading(0.5)
    heading.begin(0.58)
    assert heading.at(0, None) == 0.5


@pytest.mark.parametrize("asked_rad", [math.nan, math.inf, -math.inf])
def test_what_is_no_heading_is_not_turned_to(asked_rad: float) -> None:
    heading = Heading(0.5)
    assert turn(heading, asked_rad, 1.0) == [0.5] * len(turn(Heading(0.5), 0.5, 1.0))
