"""Tests of references through points and from tables: by hand-computed values, and by what makes them the least."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from swarmctl.control.reference.minimum_snap import fastest_minimum_snap, minimum_snap, stretch
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.control.reference.polynomial import PiecewisePolynomial, through
from swarmctl.core.types import Array

STARTS = np.array([[0.0, 0.0, -1.0], [4.0, 0.0, -2.0]])
TURN = np.array([[0.0, 0.0, -1.0], [4.0, 1.0, -2.0], [4.0, 5.0, -1.0], [0.0, 4.0, -1.5]])
TIMES_S = np.array([0.0, 2.0, 4.5, 7.0])


def derivative(flight: PiecewisePolynomial, order: int) -> PiecewisePolynomial:
    terms = flight.coefficients
    for _ in range(order):
        terms = terms[:, 1:] * np.arange(1, terms.shape[1])[None, :, None]
    return PiecewisePolynomial(knots_s=flight.knots_s, coefficients=terms)


def snap_cost(flight: PiecewisePolynomial) -> float:
    t_s = np.linspace(0.0, flight.end_s, 40_001)
    return float(np.sum(derivative(flight, 4).sample(t_s)[0] ** 2) * (t_s[1] - t_s[0]))


def mission(kind: str, **section: Any) -> MissionParams:
    return MissionParams.model_validate({"kind": kind, kind: section})


def sample(t_s: list[float], agent: int, params: MissionParams) -> tuple[Array, Array]:
    return MissionReference(params, STARTS, agent).sample(np.array(t_s))


# -- least snap --------------------------------------------------------------------------------------------------------


def test_least_snap_passes_the_points_in_time_and_rests_at_both_ends() -> None:
    flight = minimum_snap(TIMES_S, TURN)
    np.testing.assert_allclose(flight.sample(TIMES_S)[0], TURN, atol=1e-9)
    for order in (1, 2, 3):
        np.testing.assert_allclose(derivative(flight, order).sample(TIMES_S[[0, -1]])[0], 0.0, atol=1e-8)


def test_least_snap_is_smooth_where_segments_meet() -> None:
    flight = minimum_snap(TIMES_S, TURN)
    for order in range(1, 7):
        at = derivative(flight, order)
        before, after = at.sample(TIMES_S[1:-1] - 1e-9)[0], at.sample(TIMES_S[1:-1])[0]
        np.testing.assert_allclose(before, after, atol=1e-5)


def test_no_other_flight_through_the_points_has_less_snap() -> None:
    """What is added vanishes with its first three derivatives at every point, so all constraints still hold."""
    flight = minimum_snap(TIMES_S, TURN)
    padded = np.zeros((3, 9, 3))
    padded[:, :8] = flight.coefficients
    for amount in (0.02, -0.02):
        changed = padded.copy()
        bump = np.poly1d([1.0, 0.0]) ** 4 * np.poly1d([1.0, -2.5]) ** 4  # on the middle segment, of 2.5 s
        changed[1, :, 0] += amount * bump.coeffs[::-1]
        other = PiecewisePolynomial(knots_s=TIMES_S, coefficients=changed)
        np.testing.assert_allclose(other.sample(TIMES_S)[0], TURN, atol=1e-9)
        assert snap_cost(other) > snap_cost(flight)


@pytest.mark.parametrize(("speed_m_s", "accel_m_s2"), [(2.0, 100.0), (100.0, 1.5), (2.0, 1.5)])
def test_without_times_a_flight_is_as_fast_as_its_limits_allow(speed_m_s: float, accel_m_s2: float) -> None:
    flight = fastest_minimum_snap(TURN, speed_m_s, accel_m_s2)
    t_s = np.linspace(0.0, flight.end_s, 20_001)
    vel = flight.sample(t_s)[1]
    speed, accel = np.linalg.norm(vel, axis=1).max(), np.linalg.norm(derivative(flight, 2).sample(t_s)[0], axis=1).max()
    assert speed <= 1.001 * speed_m_s and accel <= 1.005 * accel_m_s2
    assert speed > 0.999 * speed_m_s or accel > 0.995 * accel_m_s2, "it does not dawdle"
    assert stretch(flight, speed_m_s, accel_m_s2) == pytest.approx(1.0)


def test_agents_have_lists_of_their_own_or_share_one() -> None:
    lists = [{"points_ned_m": TURN.tolist()}, {"points_ned_m": TURN[::-1].tolist(), "times_s": TIMES_S.tolist()}]
    own = mission("waypoints", lists=lists)
    np.testing.assert_allclose(sample([0.0, 60.0], 0, own)[0], TURN[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(sample([0.0, 2.0, 60.0], 1, own)[0], TURN[[3, 2, 0]], atol=1e-6)
    shared = mission("waypoints", lists=lists[:1])
    np.testing.assert_array_equal(sample([3.0], 0, shared)[0], sample([3.0], 1, shared)[0])


@pytest.mark.parametrize(
    ("lists", "words"),
    [
        ([], "0 lists"),
        ([{"points_ned_m": [[0, 0, -1]]}] * 2, "needs 2 or more"),
        ([{"points_ned_m": [[0, 0, -1], [0, 0, -1]]}] * 2, "are the same"),
        ([{"points_ned_m": [[0, 0, -1], [1, 0, -1]], "times_s": [0.0]}] * 2, "1 times for 2 points"),
        ([{"points_ned_m": [[0, 0, -1], [1, 0, -1]], "times_s": [0.0, 0.0]}] * 2, "increase"),
        ([{"points_ned_m": [[0, 0, -1], [1, 0, -1]], "times_s": [1.0, 2.0]}] * 2, "begin at 0"),
    ],
)
def test_lists_that_are_no_flight_are_refused(lists: list[dict[str, Any]], words: str) -> None:
    assert words in " ".join(mission("waypoints", lists=lists).problems(2))


def test_places_around_a_reference_are_for_shared_ones() -> None:
    lists = [{"points_ned_m": TURN.tolist()}] * 2
    assert "goal_assignment" in " ".join(mission("waypoints", lists=lists, goal_assignment=True).problems(2))


# -- tables ------------------------------------------------------------------------------------------------------------


def table(columns: str, *rows: list[float]) -> dict[str, Any]:
    return {"columns": columns.split(","), "rows": [list(row) for row in rows]}


def test_a_table_is_met_at_its_rows_and_stays_after_the_last() -> None:
    flown = mission("csv", tables=[table("t,x,y,z", [0, 1, 2, -3], [1, 2, 2, -3], [3, 4, 2, -3])])
    pos, vel = sample([0.0, 1.0, 3.0, 9.0], 0, flown)
    np.testing.assert_allclose(pos, [[1, 2, -3], [2, 2, -3], [4, 2, -3], [4, 2, -3]], atol=1e-12)
    np.testing.assert_allclose(vel[:3], [[1.0, 0.0, 0.0]] * 3, atol=1e-12)  # 1 m/s throughout
    assert not vel[3].any()


def test_given_velocities_and_accelerations_are_met_too() -> None:
    values, rates, accels = (np.array([[a], [b]]) for a, b in ((0.0, 1.0), (0.5, -0.5), (2.0, -1.0)))
    flight = through(np.array([0.0, 2.0]), values, rates, accels)
    for order, wanted in ((0, values), (1, rates), (2, accels)):
        np.testing.assert_allclose(derivative(flight, order).sample(np.array([0.0, 2.0]))[0], wanted, atol=1e-12)
    cubic = through(np.array([0.0, 2.0]), values, rates, None)
    np.testing.assert_allclose(cubic.sample(np.array([0.0, 2.0]))[1], rates, atol=1e-12)


def test_polynomials_of_crazyswarm2_are_flown() -> None:
    columns = ["duration", *(f"{axis}^{k}" for axis in ("x", "y", "z", "yaw") for k in range(8))]
    first, second = np.zeros(33), np.zeros(33)
    first[[0, 2, 17]] = 2.0, 0.5, 1.0  # 2 s: x = t / 2, z = 1
    second[[0, 1, 2, 11, 17]] = 1.0, 1.0, 0.5, 3.0, 1.0  # 1 s: x = 1 + t / 2, y = 3 t^2, z = 1
    rows = [first.tolist(), second.tolist()]
    flown = mission("csv", frame="nwu", from_start=True, tables=[{"columns": columns, "rows": rows}])
    pos, vel = sample([0.0, 1.0, 2.5], 1, flown)
    np.testing.assert_allclose(pos - STARTS[1], [[0.0, 0.0, -1.0], [0.5, 0.0, -1.0], [1.25, -0.75, -1.0]], atol=1e-12)
    np.testing.assert_allclose(vel[2], [0.5, -3.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("frame", "pos", "yaw_rad"),
    [("ned", [1, 2, 3], 0.25), ("enu", [2, 1, -3], np.pi / 2 - 0.25), ("nwu", [1, -2, -3], -0.25)],
)
def test_every_frame_becomes_north_east_down(frame: str, pos: list[float], yaw_rad: float) -> None:
    flown = mission("csv", frame=frame, tables=[table("t,x,y,z,yaw", [0, 1, 2, 3, 0.25], [1, 1, 2, 3, 0.25])])
    reference = MissionReference(flown, STARTS, 0)
    np.testing.assert_allclose(reference.sample(np.array([0.5]))[0], [pos], atol=1e-12)
    np.testing.assert_allclose(reference.yaw_rad(np.array([0.5])), yaw_rad, atol=1e-12)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (table("t,x,y", [0, 0, 0]), "allowed: t,x,y,z"),
        (table("t,x,y,z,colour", [0, 0, 0, 0, 0]), "allowed"),
        (table("t,x,y,z", [0, 0, 0, 0]), "1 rows"),
        (table("t,x,y,z", [0, 0, 0, 0], [1, 0, 0]), "needs 4 numbers"),
        (table("t,x,y,z", [0, 0, 0, 0], [2, 0, 0, 0], [2, 1, 1, 1]), "row 3: t = 2 after 2"),
        (table("t,x,y,z", [-1, 0, 0, 0], [2, 0, 0, 0]), "row 1"),
        (table("duration,x^0", [1, 0]), "allowed"),
    ],
)
def test_tables_that_are_no_flight_are_refused(given: dict[str, Any], words: str) -> None:
    assert words in " ".join(mission("csv", files=["a.csv"], tables=[given]).problems(2))


def test_acceleration_is_the_derivative_of_velocity() -> None:
    motion = MissionReference(mission("lemniscate"), STARTS, 0).motion(np.array([0.0, 1.0, 2.0]))
    w = 0.4
    np.testing.assert_allclose(motion.accel_ned_m_s2[1:, 0], -4.0 * w**2 * np.sin(w * np.array([1.0, 2.0])), atol=1e-5)
    assert motion.yaw_rad.tolist() == [0.0, 0.0, 0.0]


def test_a_helix_rises_to_its_height_and_comes_back() -> None:
    pos, vel = sample([0.0, 20.0, 40.0], 0, mission("helix", rise_s=40.0, height_m=2.0))
    np.testing.assert_allclose(pos[:, 2], [-1.0, -3.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(vel[:, 2], 0.0, atol=1e-12)
