"""The way into a mission whose reference moves: between where it begins and the places of the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from swarmctl.control.phases.way_back import WayBack, way_back
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.control.reference.quintic import shedding_s
from swarmctl.core.types import Array
from tests import builders

SPEED_M_S, ACCEL_M_S2 = 2.0, 1.2
START = np.array([3.0, 0.0, -2.0])
HELIX = {"kind": "helix", "helix": {"center_ned_m": [0.0, 0.0, -2.0], "height_m": 10.0}}
CIRCLE = {"kind": "circle", "circle": {"center_ned_m": [0.0, 0.0, -2.0]}}
PLACES = [(43.0, 0.0, -2.0), (0.0, 0.0, -2.0), (-5.0, 1.0, -15.0), (2.0, 90.0, -0.8)]


def reference_of(mission: dict[str, Any]) -> MissionReference:
    return MissionReference(MissionParams.model_validate(mission), START[None, :], 0)


def way_from(pos: tuple[float, ...], vel: tuple[float, ...], reference: MissionReference, begins_s: float) -> WayBack:
    state = builders.vehicle_state(pos_ned_m=np.array(pos), vel_ned_m_s=np.array(vel))
    limits = {"speed_m_s": SPEED_M_S, "accel_m_s2": ACCEL_M_S2, "shed_s": shedding_s(state.vel_ned_m_s, ACCEL_M_S2)}
    return way_back(reference, begins_s, 0, state, **limits)


def flown(way: WayBack, reference: MissionReference, begins_s: float) -> tuple[Array, Array, Array]:
    """Return times (K,), positions and velocities (K, 3) of a way and of 1 s after it."""
    t_s = np.linspace(0.0, way.travel_s + 1.0, 3000)
    return t_s, *way.sample(t_s, *reference.sample(begins_s + t_s))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("mission", [HELIX, CIRCLE], ids=["helix", "circle"])
def test_from_rest_a_way_leads_neither_below_both_nor_beyond_both(
    mission: dict[str, Any], place: tuple[float, ...]
) -> None:
    reference = reference_of(mission)
    for begins_s in np.linspace(0.0, 100.0, 26):
        way = way_from(place, (0.0, 0.0, 0.0), reference, begins_s)
        t_s, pos, _ = flown(way, reference, begins_s)
        followed = reference.sample(begins_s + t_s)[0]
        assert pos[:, 2].max() <= max(place[2], followed[:, 2].max()) + 1e-9
        from_axis_m = np.hypot(*np.vstack([followed, place])[:, :2].T).max()
        assert np.hypot(*pos[:, :2].T).max() <= from_axis_m + 1e-9


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("vel", [(0.0, 0.0, 0.0), (1.5, -1.0, 0.5)])
@pytest.mark.parametrize("mission", [HELIX, CIRCLE], ids=["helix", "circle"])
def test_a_way_begins_as_the_vehicle_flies_and_ends_in_the_reference_near_speed_and_acceleration_of_transits(
    mission: dict[str, Any], place: tuple[float, ...], vel: tuple[float, ...]
) -> None:
    reference = reference_of(mission)
    for begins_s in (0.0, 7.0, 33.0):
        way = way_from(place, vel, reference, begins_s)
        t_s, pos, said = flown(way, reference, begins_s)
        np.testing.assert_allclose(pos[0], place, atol=1e-12)
        np.testing.assert_allclose(said[0], vel, atol=1e-12)
        followed, following = reference.sample(begins_s + t_s)
        np.testing.assert_allclose(pos[-1], followed[-1], atol=1e-9)
        np.testing.assert_allclose(said[-1], following[-1], atol=1e-9)
        np.testing.assert_allclose(np.gradient(pos, t_s, axis=0)[5:-5], said[5:-5], atol=0.01)
        fastest_m_s = np.linalg.norm(following, axis=1).max()
        assert np.linalg.norm(said, axis=1).max() < 2.0 * max(SPEED_M_S, fastest_m_s) + 0.4
        accel, its_own = (np.gradient(values, t_s, axis=0) for values in (said, following))
        assert np.linalg.norm(accel, axis=1).max() < 2.0 * ACCEL_M_S2 + np.linalg.norm(its_own, axis=1).max()


def test_a_way_to_a_reference_that_flies_away_ends() -> None:
    line = {
        "kind": "waypoints",
        "waypoints": {"speed_m_s": 3.0, "lists": [{"points_ned_m": [START.tolist(), [900.0, 0.0, -2.0]]}]},
    }
    assert way_from((-40.0, 0.0, -2.0), (0.0, 0.0, 0.0), reference_of(line), 10.0).travel_s < 200.0


def test_a_way_to_a_place_far_away_takes_as_long_as_a_transit() -> None:
    hover = reference_of({"kind": "hover"})
    way = way_from((203.0, 0.0, -2.0), (0.0, 0.0, 0.0), hover, 10.0)
    assert way.travel_s == pytest.approx(100.0 + 2.4, abs=0.1)
    assert np.linalg.norm(flown(way, hover, 10.0)[2], axis=1).max() <= SPEED_M_S + 1e-6


@pytest.mark.parametrize("away_m", [4.0, 9.0, 30.0, 300.0])
def test_speed_and_acceleration_are_checked_where_a_way_speeds_up_and_brakes(away_m: float) -> None:
    way = way_from((3.0 + away_m, 0.0, -2.0), (0.0, 0.0, 0.0), reference_of({"kind": "hover"}), 0.0)
    t_s, speeds_up_s = way.checked_s(), 0.5 * (way.travel_s - way.cruise_s)
    assert t_s[0] == 0.0 and t_s[-1] == way.travel_s
    assert (np.diff(t_s) > 0.0).all()
    assert (np.diff(t_s)[(t_s[1:] <= speeds_up_s) | (t_s[:-1] >= way.travel_s - speeds_up_s)] < 0.25).all()
