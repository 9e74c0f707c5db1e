"""Tests of the flight volume: what is one, what is inside of it, and by how much."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from swarmctl.core.flight_volume import FlightVolume, VolumeParams
from swarmctl.core.types import Array

BOX = ((-5.0, -4.0), (5.0, -4.0), (5.0, 4.0), (-5.0, 4.0))
STAR = ((0.0, 5.0), (3.0, -4.0), (-5.0, 2.0), (5.0, 2.0), (-3.0, -4.0))


def params(**changed: Any) -> VolumeParams:
    values: dict[str, Any] = {
        "corners_ne_m": BOX,
        "floor_z_m": -0.5,
        "ceiling_z_m": -4.5,
        "margin_m": 0.3,
        "certify_slack_m": 0.1,
    }
    return VolumeParams(**(values | changed))


def volume(**changed: Any) -> FlightVolume:
    given = params(**changed)
    assert list(given.problems()) == []
    found = given.flight_volume()
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"corners_ne_m": BOX[:2]}, ("corners_ne_m", "2 corners are no polygon")),
        ({"corners_ne_m": (*BOX, (0.0, 1.0))}, ("corners_ne_m.4 = [0.0, 1.0]", "convex")),
        ({"corners_ne_m": STAR}, ("corners_ne_m.4", "crosses itself")),
        ({"corners_ne_m": (BOX[0], BOX[2], BOX[1], BOX[3])}, ("corners_ne_m.", "crosses itself")),
        ({"corners_ne_m": (*BOX, (-5.0, 0.0))}, ("corners_ne_m.4", "straight on")),
        ({"floor_z_m": None}, ("volume.floor_z_m: missing",)),
        ({"ceiling_z_m": None}, ("volume.ceiling_z_m: missing",)),
        ({"ceiling_z_m": 2.0}, ("ceiling_z_m = 2", "not above", "floor_z_m = -0.5")),
        ({"certify_slack_m": 0.4}, ("certify_slack_m = 0.4", "margin_m = 0.3")),
        ({"corners_ne_m": ()}, ("corners_ne_m: none",)),
    ],
)
def test_what_is_no_convex_volume_is_refused_with_the_reason(changed: dict[str, Any], words: tuple[str, ...]) -> None:
    (problem,) = params(**changed).problems()
    assert [word for word in words if word not in problem] == []


def test_without_corners_there_is_no_volume() -> None:
    assert list(VolumeParams().problems()) == []
    assert VolumeParams().flight_volume() is None


@pytest.mark.parametrize("corners", [BOX, BOX[::-1]], ids=["clockwise", "counter-clockwise"])
@pytest.mark.parametrize(
    ("pos", "beyond_m", "face"),
    [
        ((0.0, 0.0, -1.0), -0.5, "floor"),
        ((0.0, 0.0, -0.2), 0.3, "floor"),
        ((0.0, 0.0, -5.0), 0.5, "ceiling"),
        ((7.0, 0.0, -2.0), 2.0, "side"),
        ((4.9, 0.0, -2.0), -0.1, "side"),
        ((0.0, -5.5, -2.0), 1.5, "side"),
    ],
)
def test_how_far_outside_is_told_of_the_face_that_is_worst(
    corners: tuple[tuple[float, float], ...], pos: tuple[float, ...], beyond_m: float, face: str
) -> None:
    found = volume(corners_ne_m=corners)
    assert float(found.beyond_m(np.array(pos))) == pytest.approx(beyond_m)
    assert float(found.beyond_plans_m(np.array(pos))) == pytest.approx(beyond_m + 0.3)
    assert found.face(np.array(pos)).startswith(face)


def test_a_point_is_inside_of_any_convex_polygon_exactly_where_it_is_a_mean_of_corners() -> None:
    """Means of corners are inside; mirrored about each side they are outside by as much as they were inside of it."""
    rng = np.random.default_rng(4)
    for _ in range(50):
        bearing = np.sort(rng.uniform(0.0, 2.0 * np.pi, 6))
        corners = rng.uniform(2.0, 9.0) * np.column_stack([np.cos(bearing), np.sin(bearing)])
        given = params(corners_ne_m=tuple(map(tuple, corners.tolist())))
        if list(given.problems()):
            continue  # two corners at one bearing
        found = FlightVolume(given)
        inside = np.append(rng.dirichlet(np.ones(6)) @ corners, -2.0)
        assert float(found.beyond_m(inside)) < 0.0
        for side in range(found.sides):
            gap_m = float(found.normals_ned[side] @ inside - found.offsets_m[side])
            assert gap_m > 0.0
            assert float(found.beyond_m(inside - 2.0 * gap_m * found.normals_ned[side])) >= gap_m - 1e-9


@pytest.mark.parametrize("pos", [(9.0, 9.0, 3.0), (-9.0, 0.0, -2.0), (0.0, 0.0, -9.0)])
def test_a_point_outside_is_brought_to_where_plans_lead(pos: tuple[float, ...]) -> None:
    found = volume()
    brought: Array = found.brought_inside(np.array(pos))
    assert float(found.beyond_plans_m(brought)) == pytest.approx(0.0, abs=1e-9)
    inside = np.array([1.0, 1.0, -2.0])
    assert found.brought_inside(inside) is inside


def test_a_refusal_tells_the_place_the_amount_and_the_face() -> None:
    assert volume().refusal((0.0, 0.0, -2.0)) == ""
    words = ("7.00, 0.00, -2.00", "2.30 m outside of the flight volume", "margin_m = 0.3", "side")
    assert [word for word in words if word not in volume().refusal((7.0, 0.0, -2.0))] == []
