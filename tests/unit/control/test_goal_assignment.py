"""Places around one goal are as near to it as possible, far enough apart, and the same for every agent."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sitl.studies.campaign.conditions.layouts import least_sum_m
from swarmctl.control.reference.goal_assignment import ROOM, arrangement, assigned_goals_ned_m
from swarmctl.control.reference.kind import MOVING_ROOM
from swarmctl.control.reference.kinds.goto import OUTER_DELAY_S_M, GotoParams
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.types import Array

APART_M = 0.9


def closest_m(points: Array) -> float:
    return min((math.dist(a, b) for a, b in itertools.combinations(points, 2)), default=math.inf)


@pytest.mark.parametrize("count", [1, 3, 6, 10])
def test_the_arrangement_is_the_least_that_a_search_over_all_finds(count: int) -> None:
    points = arrangement(count)
    assert closest_m(points) >= 1.0 - 1e-9
    assert np.linalg.norm(points, axis=1).sum() <= least_sum_m(count, 1.0) + 1e-3


def test_two_agents_keep_the_same_distance_to_their_goal() -> None:
    np.testing.assert_allclose(np.linalg.norm(arrangement(2), axis=1), 0.5)  # one on it would be as good a sum


def test_three_agents_around_one_point_form_a_triangle_at_its_height() -> None:
    starts = np.array([[4.0, 0.0, -1.0], [-2.0, 3.4, -1.0], [-2.0, -3.4, -2.0]])
    goals = np.tile([1.0, 1.0, -3.0], (3, 1))
    places, groups = assigned_goals_ned_m(starts, goals, APART_M)
    assert groups == [[0, 1, 2]]
    np.testing.assert_allclose(places[:, 2], -3.0)
    np.testing.assert_allclose(np.linalg.norm(places - goals, axis=1), ROOM * APART_M / math.sqrt(3.0), rtol=1e-6)
    assert closest_m(places) == pytest.approx(ROOM * APART_M)
    for start, place in zip(starts, places, strict=True):  # each on the side it comes from
        assert (place - goals[0])[:2] @ (start - goals[0])[:2] > 0.0


def test_goals_far_enough_apart_stay_as_they_are() -> None:
    goals = np.array([[0.0, 0.0, -1.0], [0.95, 0.0, -1.0], [0.0, 0.0, -2.0]])
    places, groups = assigned_goals_ned_m(np.zeros((3, 3)), goals, APART_M)
    np.testing.assert_array_equal(places, goals)
    assert groups == [[0], [1], [2]]


def test_an_agent_too_close_to_an_arrangement_joins_it() -> None:
    goals = np.array([[5.0, 0.0, 0.0], [5.0, 0.0, 0.0], [5.9, 0.0, 0.0], [9.0, 0.0, 0.0]])
    starts = np.arange(4)[:, None] * np.array([2.0, 0.0, 0.0])  # they come along the line of the goals
    places, groups = assigned_goals_ned_m(starts, goals, APART_M)
    assert groups == [[0, 1, 2], [3]]
    assert closest_m(places) >= APART_M
    np.testing.assert_array_equal(places[3], goals[3])


@pytest.mark.parametrize("count", [6, 10])
def test_simultaneous_flights_never_come_much_closer_than_their_ends(count: int) -> None:
    starts = np.random.default_rng(count).uniform(-6.0, 6.0, (200, 3)) * [1.0, 1.0, 0.0]
    chosen: list[Array] = []
    for start in starts:
        if all(math.dist(start, other) >= 1.5 for other in chosen):
            chosen.append(start)
    starts = np.array(chosen[:count])
    places, _ = assigned_goals_ned_m(starts, np.zeros((count, 3)), APART_M)
    least_m = min(closest_m(starts + s * (places - starts)) for s in np.linspace(0.0, 1.0, 101))
    assert least_m >= ROOM * APART_M / math.sqrt(2.0) - 1e-6  # where no two gain by exchanging their places


def test_no_rotation_and_permutation_has_a_smaller_sum_of_squares() -> None:
    """Where exchanges of two agents alone end 0.24 m2 above the least."""
    starts = np.array([[-4.0, -4.0], [-4.0, -2.5], [-4.0, -1.0], [-4.0, 0.5], [-2.5, -4.0], [-2.5, -2.5]])
    starts_ned_m = np.column_stack([starts, np.zeros(6)])
    places, _ = assigned_goals_ned_m(starts_ned_m, np.zeros((6, 3)), APART_M)
    orders = np.array(list(itertools.permutations(range(6))))  # (720, 6)
    turned = Rotation.from_euler("z", np.arange(0, 360, 5)[:, None], degrees=True).as_matrix()[:, :2, :2]  # (72, 2, 2)
    sums_m2 = [((places[orders, :2] @ turn - starts) ** 2).sum(axis=(1, 2)).min() for turn in turned]
    assert ((places - starts_ned_m) ** 2).sum() == pytest.approx(min(sums_m2), abs=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_rounding_decides_no_tie(seed: int) -> None:
    """Of agents that start above each other any permutation is as short."""
    starts = np.array([[3.0, 0.0, -1.0 - agent] for agent in range(6)])
    rounded = starts + np.random.default_rng(seed).uniform(-1e-12, 1e-12, starts.shape)
    places, _ = assigned_goals_ned_m(starts, np.zeros((6, 3)), APART_M)
    again, _ = assigned_goals_ned_m(rounded, np.zeros((6, 3)), APART_M)
    np.testing.assert_allclose(again, places, atol=1e-9)


def rest_s(references: list[MissionReference]) -> list[float]:
    """Return the time at which each agent comes to rest [s]."""
    times = np.arange(0.0, 20.0, 0.01)
    return [float(times[np.linalg.norm(r.sample(times)[1], axis=1).nonzero()[0][-1]]) for r in references]


def test_inner_places_are_reached_first() -> None:
    starts = 5.0 * np.stack([np.cos(np.arange(7.0)), np.sin(np.arange(7.0)), 0.0 * np.arange(7.0)], axis=1)
    mission = MissionParams.model_validate({"kind": "goto", "goto": {"goals_ned_m": [[0.0, 0.0, 0.0]]}})
    flown = [MissionReference(mission, starts, agent, APART_M) for agent in range(7)]
    ends_m = [float(np.linalg.norm(r.sample(np.array([60.0]))[0][0])) for r in flown]
    first, *others = [t_s for _, t_s in sorted(zip(ends_m, rest_s(flown), strict=True))]
    assert min(others) - first == pytest.approx(OUTER_DELAY_S_M * ROOM * APART_M, abs=0.05)
    assert max(others) - min(others) < 0.05


def test_all_agents_compute_the_same_places() -> None:
    starts = np.array([[4.0, 0.0, -1.0], [-1.0, 1.7, -1.0], [-2.0, -3.4, -2.0]])
    mission = MissionParams.model_validate({"kind": "goto", "goto": {"goals_ned_m": [[0.0, 0.0, -1.0]]}})
    flown = [MissionReference(mission, starts, agent, APART_M) for agent in range(3)]
    ends = np.array([reference.sample(np.array([60.0]))[0][0] for reference in flown])
    np.testing.assert_allclose(ends, assigned_goals_ned_m(starts, np.tile([0.0, 0.0, -1.0], (3, 1)), APART_M)[0])
    assert max(rest_s(flown)) - min(rest_s(flown)) < 0.05, "three places are equally far"
    alone = mission.model_copy(
        update={"goto": mission.section(GotoParams).model_copy(update={"goal_assignment": False})}
    )
    np.testing.assert_array_equal(
        MissionReference(alone, starts, 1, APART_M).sample(np.array([60.0]))[0][0], [0, 0, -1]
    )


@pytest.mark.parametrize("kind", ["circle", "line", "steps"])
def test_each_agent_has_a_place_around_a_reference_that_moves(kind: str) -> None:
    starts, times_s = np.array([[4.0, 0.0, -1.0], [-1.0, 1.7, -1.0], [-2.0, -3.4, -2.0]]), np.array([0.0, 3.0, 20.0])
    shared = MissionReference(MissionParams.model_validate({"kind": kind}), starts, 0, APART_M)
    np.testing.assert_array_equal(shared.offset_ned_m, np.zeros(3))
    mission = MissionParams.model_validate({"kind": kind, kind: {"goal_assignment": True}})
    own = [MissionReference(mission, starts, agent, APART_M) for agent in range(3)]
    offsets = np.array([reference.offset_ned_m for reference in own])
    assert closest_m(offsets) == pytest.approx(MOVING_ROOM * APART_M)
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), MOVING_ROOM * APART_M / math.sqrt(3.0), rtol=1e-6)
    assert np.all(offsets[:, 2] == 0.0)
    for reference in own:
        pos, vel = reference.sample(times_s)
        np.testing.assert_allclose(pos, shared.sample(times_s)[0] + reference.offset_ned_m)
        np.testing.assert_array_equal(vel, shared.sample(times_s)[1])
