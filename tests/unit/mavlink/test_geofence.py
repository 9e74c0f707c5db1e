"""The geofence: what is a polygon, and how far outside of it a place is."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.core.params import Vec2
from swarmctl.mavlink.geofence import Geofence, GeofenceParams

SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
DENTED = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 1.0), (0.0, 4.0))


def problems(corners_ne_m: tuple[Vec2, ...]) -> list[str]:
    return list(GeofenceParams(corners_ne_m=corners_ne_m).problems([(0.5, 0.5, 0.0)]))


@pytest.mark.parametrize(
    "corners_ne_m",
    [SQUARE, SQUARE[::-1], DENTED, (*SQUARE, SQUARE[0]), (SQUARE[0], (2.0, 0.0), *SQUARE[1:]), SQUARE[:3][::-1]],
    ids=["square", "other way round", "dented", "closed", "straight on", "triangle"],
)
def test_a_polygon_is_taken_whatever_its_form(corners_ne_m: tuple[Vec2, ...]) -> None:
    assert list(GeofenceParams(corners_ne_m=corners_ne_m).problems([(2.5, 0.5, 0.0)])) == []


@pytest.mark.parametrize(
    ("corners_ne_m", "said"),
    [
        ((SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]), "from [0.0, 0.0] to [4.0, 4.0] crosses or touches that from"),
        ((*SQUARE, (2.0, 0.0)), "crosses or touches"),
        ((SQUARE[0], (6.0, 0.0), *SQUARE[1:]), "crosses or touches"),
        ((*SQUARE[:3], SQUARE[0], (-1.0, 4.0), (-4.0, -4.0)), "crosses or touches"),
        ((SQUARE[0], (1.0, 1.0), (4.0, 4.0)), "crosses or touches"),
        ((SQUARE[0], SQUARE[1], SQUARE[0], SQUARE[1]), "crosses or touches"),
        ((SQUARE[0], SQUARE[1], SQUARE[0]), "2 corners are no polygon"),
        ((SQUARE[0],) * 3, "0 corners are no polygon"),
    ],
    ids=["bow tie", "touching", "spike", "corner twice", "flat", "there and back", "line", "point"],
)
def test_what_encloses_no_single_area_is_refused(corners_ne_m: tuple[Vec2, ...], said: str) -> None:
    (problem,) = problems(corners_ne_m)
    assert problem.startswith("geofence.corners_ne_m: ")
    assert said in problem
    assert GeofenceParams(corners_ne_m=corners_ne_m).area() is None


def test_how_far_outside_a_place_is() -> None:
    at_ne_m = np.array([(2.0, 0.5), (2.0, 2.0), (5.0, 2.0), (7.0, -4.0), (4.0, 2.0), (0.0, 0.0)])
    expected_m = [0.0, 2.0 / np.sqrt(13.0), 1.0, 5.0, 0.0, 0.0]
    np.testing.assert_allclose(Geofence(DENTED).beyond_m(at_ne_m), expected_m, atol=1e-12)


@pytest.mark.parametrize("corners_ne_m", [DENTED, DENTED[::-1], (*DENTED, DENTED[0])])
def test_a_place_is_inside_where_the_dent_leaves_room(corners_ne_m: tuple[Vec2, ...]) -> None:
    at_ne_m = np.random.default_rng([1, 0, 0]).uniform(-1.0, 5.0, (2000, 2))
    north, east = at_ne_m.T
    inside = (north > 0.0) & (north < 4.0) & (east > 0.0) & (east < 1.0 + 1.5 * np.abs(north - 2.0))
    assert [Geofence(corners_ne_m).contains(at) for at in at_ne_m.tolist()] == inside.tolist()
    assert 0 < inside.sum() < len(inside)


def test_its_border_belongs_to_it() -> None:
    assert all(Geofence(DENTED).contains(at) for at in (*DENTED, (3.0, 2.5), (0.7, 0.0)))
    assert not Geofence(DENTED).contains((3.0, 2.50001))
