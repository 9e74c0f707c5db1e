"""Stops, and ways that begin with a velocity, keep above the ground that is known from the take-off."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from swarmctl.control.phases.trajectories import Trajectories
from swarmctl.control.reference.mission import MissionParams, MissionReference
from swarmctl.core.types import Array, VehicleState
from tests import builders

HOME = np.array([0.0, 0.0, -12.0])
LEAST_M = 0.5
SPEED_M_S, ACCEL_M_S2, BRAKE_M_S2 = 4.5, 1.2, 3.0


def sinking(speed_m_s: float, accel_m_s2: float, ahead_m: float = 20.0) -> MissionReference:
    """Return a mission that sinks from 12 m to 1.5 m above the ground."""
    points = {"points_ned_m": [HOME.tolist(), [ahead_m, 0.0, -1.5]]}
    told = {"speed_m_s": speed_m_s, "accel_m_s2": accel_m_s2, "lists": [points]}
    return MissionReference(MissionParams.model_validate({"kind": "waypoints", "waypoints": told}), HOME[None, :], 0)


def trajectories(mission: MissionReference, ground_z_m: float | None = 0.0) -> Trajectories:
    limits = {"speed_m_s": SPEED_M_S, "accel_m_s2": ACCEL_M_S2, "brake_m_s2": BRAKE_M_S2}
    made = Trajectories(mission, HOME, **limits)
    made.ground_z_m = ground_z_m
    return made


def state_at(mission: MissionReference, mission_t_s: float) -> VehicleState:
    pos, vel = mission.sample(np.array([mission_t_s]))
    return builders.vehicle_state(pos_ned_m=pos[0], vel_ned_m_s=vel[0])


def lowest_m(flown: Trajectories) -> float:
    return float(flown.reference(0, np.linspace(0.0, 30.0, 1000))[0][:, 2].max())


@pytest.mark.parametrize("speed_m_s, accel_m_s2, ahead_m", [(3.0, 3.0, 0.0), (4.0, 3.0, 20.0)])
def test_a_stop_of_a_vehicle_that_sinks_ends_above_the_ground_whenever_it_begins(
    speed_m_s: float, accel_m_s2: float, ahead_m: float
) -> None:
    mission = sinking(speed_m_s, accel_m_s2, ahead_m)
    unknown_m = []
    for begins_s in np.arange(0.0, 15.0, 0.25):
        state = state_at(mission, begins_s)
        flown = trajectories(mission)
        flown.stop(0, state)
        assert flown.current is not None
        assert flown.current.trajectory.to_ned_m[2] <= -LEAST_M
        assert lowest_m(flown) <= -LEAST_M + 0.1
        elsewhere = trajectories(mission, ground_z_m=None)
        elsewhere.stop(0, state)
        unknown_m.append(lowest_m(elsewhere))
    assert max(unknown_m) > -LEAST_M, "where the ground is not known"


@pytest.mark.parametrize("sinks_m_s, at_m", [(2.0, -1.0), (5.0, -1.0), (1.0, -0.2)])
def test_a_stop_that_is_too_late_is_bounded(sinks_m_s: float, at_m: float) -> None:
    flown = trajectories(sinking(2.0, 2.0))
    flown.stop(
        0, builders.vehicle_state(pos_ned_m=np.array([0.0, 0.0, at_m]), vel_ned_m_s=np.array([1.0, 0.0, sinks_m_s]))
    )
    assert flown.current is not None
    trajectory = flown.current.trajectory
    assert trajectory.to_ned_m[2] <= max(-LEAST_M, at_m + 0.1)
    assert trajectory.travel_s == pytest.approx(max(0.5, np.hypot(1.0, sinks_m_s) / BRAKE_M_S2))


def test_who_flies_low_and_sways_stops_as_gently_as_any() -> None:
    flown = trajectories(sinking(2.0, 2.0))
    flown.stop(0, builders.vehicle_state(pos_ned_m=np.array([0.0, 0.0, -0.4]), vel_ned_m_s=np.array([2.0, 0.0, 0.03])))
    assert flown.current is not None
    assert flown.current.trajectory.travel_s == pytest.approx(2.0 * 2.0 / ACCEL_M_S2, rel=1e-3)


def test_a_stop_that_has_room_is_as_gentle_as_without_a_ground() -> None:
    state = builders.vehicle_state(pos_ned_m=HOME, vel_ned_m_s=np.array([1.0, 0.0, 1.0]))
    with_ground, without = trajectories(sinking(2.0, 2.0)), trajectories(sinking(2.0, 2.0), ground_z_m=None)
    for made in (with_ground, without):
        made.stop(0, state)
    assert with_ground.current is not None
    assert without.current is not None
    assert with_ground.current.trajectory.travel_s == without.current.trajectory.travel_s


def farthest_m(way: Callable[[Trajectories, VehicleState], object], speed_m_s: float) -> float:
    """Return how far from where it begins a way leads that begins so fast, to the east."""
    flown = trajectories(sinking(2.0, 2.0), ground_z_m=None)
    way(flown, builders.vehicle_state(pos_ned_m=HOME, vel_ned_m_s=np.array([0.0, speed_m_s, 0.0])))
    return float(flown.reference(0, np.linspace(0.0, 60.0, 2000))[0][:, 1].max())


@pytest.mark.parametrize(
    ("way", "transit_m", "fast_m"),
    [
        (lambda flown, state: flown.stop(0, state), 16.9, 41.0),
        (lambda flown, state: flown.go_to(HOME, 0, state), 10.0, 28.0),
    ],
    ids=["stop", "home"],
)
def test_a_velocity_beyond_that_of_transits_is_lost_as_fast_as_peers_expect(
    way: Callable[[Trajectories, VehicleState], object], transit_m: float, fast_m: float
) -> None:
    """By the acceleration of transits alone, a stop at 9 m/s took 68 m, and the way home led 40 m ahead."""
    assert farthest_m(way, SPEED_M_S) == pytest.approx(transit_m, rel=0.02)
    assert farthest_m(way, 2.0 * SPEED_M_S) < fast_m


def go_home(flown: Trajectories, state: VehicleState) -> Array:
    flown.go_to(HOME, 0, state)
    return flown.reference(0, np.linspace(0.0, 30.0, 1000))[0]


def join(flown: Trajectories, state: VehicleState) -> Array:
    flown.rejoin_mission(0.0, 0, state)
    t_s = np.linspace(0.0, 30.0, 1000)
    return flown.mission_reference(0.0, 0, t_s)[0]


@pytest.mark.parametrize("way", [go_home, join])
def test_the_way_home_and_that_into_a_mission_keep_above_the_ground(
    way: Callable[[Trajectories, VehicleState], Array],
) -> None:
    state = builders.vehicle_state(pos_ned_m=np.array([5.0, 0.0, -1.5]), vel_ned_m_s=np.array([1.0, 0.0, 1.6]))
    mission = sinking(2.0, 2.0)
    assert way(trajectories(mission), state)[:, 2].max() <= -LEAST_M + 1e-2
    assert way(trajectories(mission, ground_z_m=None), state)[:, 2].max() > -LEAST_M


@pytest.mark.parametrize("away_m", [20.0, 300.0, 900.0])
def test_a_way_keeps_above_the_ground_however_long_it_is(away_m: float) -> None:
    """Of 900 m, points that are spread over the whole way are 3 s apart, and the first velocity is shed in 5 s."""
    flown = trajectories(sinking(2.0, 2.0))
    sinks = builders.vehicle_state(pos_ned_m=np.array([0.0, 0.0, -2.0]), vel_ned_m_s=np.array([0.0, 0.0, 2.0]))
    flown.go_to(np.array([away_m, 0.0, -3.0]), 0, sinks)
    assert lowest_m(flown) <= -LEAST_M + 0.02
    unknown = trajectories(sinking(2.0, 2.0), ground_z_m=None)
    unknown.go_to(np.array([away_m, 0.0, -3.0]), 0, sinks)
    assert lowest_m(unknown) > -LEAST_M + 0.3, "where the ground is not known"
