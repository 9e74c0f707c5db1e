"""Shortest paths around discs are clear of them, nearly as short as possible, and always found."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmctl.control.reference.shortest_path import Polyline, clear, shortest_path
from swarmctl.core.types import Array

START, GOAL = np.array([-2.0, 0.0]), np.array([2.0, 0.0])


def wall(low_m: float, high_m: float, radius_m: float = 0.4) -> Array:
    """Discs on the line x = 0."""
    y = np.arange(low_m, high_m + 1e-9, 0.3)
    return np.stack([np.zeros(len(y)), y, np.full(len(y), radius_m)], axis=1)


def test_without_discs_in_between_the_path_is_straight() -> None:
    aside = np.array([[0.0, 1.0, 0.9]])
    np.testing.assert_array_equal(shortest_path(START, GOAL, aside, 0.1).corners, [START, GOAL])
    assert shortest_path(START, GOAL, np.zeros((0, 3)), 0.1).length_m == 4.0


def test_the_path_leads_around_the_nearer_end_of_a_wall() -> None:
    discs = wall(-1.2, 2.4)
    path = shortest_path(START, GOAL, discs, 0.1)
    assert path.is_clear(discs)
    assert path.corners[:, 1].min() <= -1.6
    assert path.corners[:, 1].max() <= 0.1
    least_m = 2.0 * math.hypot(2.0, 1.6)  # round a point at the far edge of the last disc
    assert path.length_m < 1.1 * least_m


def test_the_path_leads_out_of_a_trap_and_around_it() -> None:
    back = np.array([[x, y, 0.4] for x in (-1.2, -0.9, -0.6, -0.3) for y in (-1.2, 1.2)])
    discs = np.vstack([wall(-1.2, 1.2), back])
    path = shortest_path(np.array([-0.6, 0.0]), GOAL, discs, 0.1)
    assert path.is_clear(discs)
    assert path.corners[:, 0].min() < -1.4  # back first


def test_the_path_leads_through_a_gap_in_a_wall() -> None:
    discs = np.vstack([wall(-3.0, -0.75), wall(0.75, 3.0)])
    assert (
        np.abs(
            shortest_path(START + np.array([0.0, 1.0]), GOAL + np.array([0.0, 1.0]), discs, 0.1).corners[1:-1, 1]
        ).max()
        < 0.4
    )


def test_who_stands_in_a_gap_that_is_closed_is_led_back_and_around() -> None:
    """It is as far through as back, and round the wall in any case farther."""
    discs = np.vstack([wall(-2.4, -0.3), wall(0.3, 2.4)])
    for north_m in (-0.15, -0.05):
        path = shortest_path(np.array([north_m, 0.0]), GOAL, discs, 0.1, squeeze=3.0**9)
        assert path.corners[1, 0] < north_m
        assert np.abs(path.corners[:, 1]).max() > 2.4


def test_a_doubtful_gap_is_avoided_at_a_higher_price() -> None:
    """The grid has no point in the middle of this one, which is 2 cm wide."""
    discs, aside = np.vstack([wall(-2.51, -0.41), wall(0.41, 2.4)]), np.array([0.0, 0.3])
    through, round_it = (
        shortest_path(START + aside, GOAL + aside, discs, 0.1, squeeze=squeeze) for squeeze in (3.0, 81.0)
    )
    assert np.abs(through.corners[:, 1]).max() < 0.4
    assert np.abs(round_it.corners[:, 1]).max() > 2.4


def test_a_path_is_found_even_through_a_closed_ring_or_from_inside_a_disc() -> None:
    ring = 1.0 * np.stack([np.cos(a := np.arange(0.0, 6.2, 0.2)), np.sin(a), np.full(len(a), 0.3)], axis=1)
    assert shortest_path(np.zeros(2), GOAL, ring, 0.1).length_m < 4.0
    inside = shortest_path(np.array([-0.2, 0.0]), GOAL, np.array([[0.0, 0.0, 0.4]]), 0.1)
    assert inside.length_m < 2.8


def test_a_disc_that_contains_the_start_may_be_left_but_not_crossed() -> None:
    disc = np.array([[0.0, 0.0, 1.0]])
    assert clear(np.array([0.5, 0.0]), np.array([3.0, 0.0]), disc)
    assert not clear(np.array([0.5, 0.0]), np.array([-3.0, 0.0]), disc)


def test_a_polyline_is_measured_by_arc_length() -> None:
    path = Polyline(np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]))
    assert path.length_m == 7.0
    assert path.arc_length_m(np.array([3.5, 1.0])) == pytest.approx(4.0)
    points, directions = path.sample(np.array([1.0, 5.0, 9.0]))
    np.testing.assert_allclose(points, [[1.0, 0.0], [3.0, 2.0], [3.0, 4.0]])
    np.testing.assert_allclose(directions, [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(path.remainder(np.array([2.8, 1.0])).corners, [[2.8, 1.0], [3.0, 4.0]])


def test_the_search_is_fast_enough_for_a_tick() -> None:
    discs = np.random.default_rng(1).uniform([-6.0, -6.0, 0.3], [6.0, 6.0, 0.4], (80, 3))
    assert (
        shortest_path(np.array([-7.0, 0.0]), np.array([7.0, 0.0]), discs, 0.01).length_m > 14.0
    )  # 60 x 60 cells at most
