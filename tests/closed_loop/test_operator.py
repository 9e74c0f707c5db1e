"""An operator's verbs fly: a climb that is held stops within a second, whichever autopilot climbs, and goes on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent.mission.start_conditions import StartConditions
from swarmctl.config import load
from swarmctl.control.phases import departure
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import ControlMode, Phase
from tests.closed_loop.conftest import COARSE, ROOT

ON_GROUND_ALONE = (*COARSE, "swarm.agents=1", "mission.duration_s=1")


def fly_until(flight: Lockstep, reached: Callable[[], bool], seconds: float = 60.0) -> None:
    end_us = flight.clock.now_us() + round(seconds * 1e6)
    while not reached():
        assert flight.clock.now_us() < end_us, "not reached in time"
        flight.step()


def fly_for(flight: Lockstep, seconds: float) -> None:
    end_us = flight.clock.now_us() + round(seconds * 1e6)
    fly_until(flight, lambda: flight.clock.now_us() >= end_us, seconds + 1.0)


def phase(flight: Lockstep, agent: int = 0) -> Phase:
    rows = flight.logs[agent].rows
    return Phase(int(rows[-1]["phase"][0])) if rows else Phase.CONNECT


def vehicle(flight: Lockstep, agent: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the true position and velocity of a vehicle, (3,) each, NED."""
    row = flight.world.truth_rows()[agent]
    return row["pos_ned_m"].copy(), row["vel_ned_m_s"].copy()


def outcome(flight: Lockstep, agent: int = 0) -> str:
    flown = flight.agents[agent]
    assert flown is not None
    return flown.outcome


def alert(flight: Lockstep, agent: int = 0) -> str:
    """Return the alert that an agent shows its operators."""
    flown = flight.agents[agent]
    assert flown is not None
    raised = flown._publisher.active_alert
    return "" if raised is None else raised.text


@pytest.mark.parametrize("config", [None, "ardupilot_sitl.toml"], ids=["px4", "arducopter"])
def test_a_hold_on_the_way_up_stops_the_climb_within_a_second_and_resume_flies_the_mission(config: str | None) -> None:
    flight = Lockstep(load(None if config is None else ROOT / "configs" / config, ON_GROUND_ALONE))
    ground_z_m = vehicle(flight)[0][2]
    fly_until(flight, lambda: phase(flight) is Phase.TAKEOFF and vehicle(flight)[0][2] < ground_z_m - 1.0)
    flight.command("hold")
    climbing_m_s = -vehicle(flight)[1][2]
    assert climbing_m_s > 0.5
    fly_for(flight, 1.0)
    held_at, vel = vehicle(flight)
    assert np.linalg.norm(vel) < 0.3
    fly_for(flight, 4.0)
    pos, vel = vehicle(flight)
    assert np.linalg.norm(pos - held_at) < 0.3
    assert phase(flight) is Phase.TAKEOFF
    flight.command("resume")
    fly_until(flight, lambda: phase(flight) > Phase.TRACK)
    assert outcome(flight) == "completed"


def test_the_fence_of_the_configuration_is_that_of_goto() -> None:
    fence = "geofence.corners_ne_m=[[-20,-20],[20,-20],[20,20],[-20,20]]"
    for settings, inside in (((), True), ((fence,), False)):
        (agent,) = Lockstep(load(None, ("swarm.agents=1", *settings))).agents
        assert agent is not None
        assert agent._mission.contains((0.0, 19.0))
        assert agent._mission.contains((0.0, 21.0)) is inside


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_an_agent_goes_to_a_point_through_the_others_and_resume_continues_the_mission(mode: str) -> None:
    """Agent 0 crosses the place of agent 1, which hovers on the straight way between."""
    hover = (*COARSE, "mission.kind=hover", "mission.duration_s=7", "sitl.start=air", f"separation.mode={mode}")
    starts = "start.positions_ned_m=[[0,0,-5],[2,0,-5]]"
    flight = Lockstep(load(None, ("swarm.agents=2", starts, *hover)))
    target = np.array([4.0, 0.0, -5.0])
    fly_until(flight, lambda: phase(flight, 0) is phase(flight, 1) is Phase.TRACK)
    flight.command("goto", 0, north_m=4.0, east_m=0.0, down_m=-5.0, speed_m_s=1.5, yaw_deg=90.0)
    fly_until(flight, lambda: bool(np.linalg.norm(vehicle(flight)[0] - target) < 0.3))
    fly_for(flight, 2.0)
    assert np.linalg.norm(vehicle(flight)[0] - target) < 0.3, "it holds there"
    assert np.linalg.norm(vehicle(flight)[1]) < 0.3
    assert [ControlMode(int(log.rows[-1]["control"][0])).name for log in flight.logs] == ["GOTO", "TRACKING"]
    w, x, y, z = flight.world.truth_rows()[0]["q_nb"]
    assert abs(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) - np.pi / 2) < 0.1
    fly_until(flight, lambda: phase(flight, 1) is not Phase.TRACK)
    assert phase(flight) is Phase.TRACK, "what is held does not end with the mission"
    flight.command("resume", 0)
    fly_until(flight, lambda: phase(flight) > Phase.TRACK)
    assert outcome(flight) == "completed"
    pos = flight.truth.reshape(-1, 2)["pos_ned_m"]
    assert np.linalg.norm(pos[:, 0] - pos[:, 1], axis=1).min() >= 0.85


def in_the_air(height_m: float, config: str | None = None) -> Lockstep:
    """Return a flight of one agent that hovers in the air at its start and begins its mission."""
    hover = (*COARSE, "swarm.agents=1", "mission.kind=hover", "mission.duration_s=3", "sitl.start=air")
    path = None if config is None else ROOT / "configs" / config
    flight = Lockstep(load(path, (*hover, f"start.positions_ned_m=[[0,0,{-height_m}]]")))
    fly_until(flight, lambda: phase(flight) is Phase.TRACK)
    return flight


@pytest.mark.parametrize("config", [None, "ardupilot_sitl.toml"], ids=["px4", "arducopter"])
def test_a_long_goto_takes_its_length_at_its_speed_and_does_not_pass_its_goal(config: str | None) -> None:
    """60 m at 2 m/s take 32.4 s; a single quintic, which is as fast in its middle only, takes 56 s."""
    flight, goal = in_the_air(5.0, config), np.array([60.0, 0.0, -5.0])
    flight.command("goto", 0, north_m=60.0, east_m=0.0, down_m=-5.0, speed_m_s=2.0)
    fly_until(flight, lambda: bool(np.linalg.norm(vehicle(flight)[0] - goal) < 0.1), 33.0)
    fly_for(flight, 4.0)
    flown = flight.truth.reshape(-1, 1)[:, 0]
    assert flown["pos_ned_m"][:, 0].max() < 60.0 + 0.02
    assert np.abs(flown["pos_ned_m"][:, 1:] - goal[1:]).max() < 0.05
    assert np.linalg.norm(flown["vel_ned_m_s"], axis=1).max() < 2.0 + 0.05


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_two_whose_long_ways_cross_keep_apart_and_arrive(mode: str) -> None:
    """At 2 m/s both are cruising as they would meet."""
    starts = ("swarm.agents=2", "start.positions_ned_m=[[-12,0,-3],[0,-12,-3]]", f"separation.mode={mode}")
    flight = Lockstep(load(None, (*COARSE, *starts, "mission.kind=hover", "mission.duration_s=3", "sitl.start=air")))
    fly_until(flight, lambda: phase(flight) is Phase.TRACK and phase(flight, 1) is Phase.TRACK)
    for agent, (north_m, east_m) in enumerate(goals := ((12.0, 0.0), (0.0, 12.0))):
        flight.command("goto", agent, north_m=north_m, east_m=east_m, down_m=-3.0)
    ends = [np.array([*goal, -3.0]) for goal in goals]
    fly_until(flight, lambda: all(np.linalg.norm(vehicle(flight, i)[0] - ends[i]) < 0.15 for i in range(2)), 20.0)
    pos = flight.truth.reshape(-1, 2)["pos_ned_m"]
    apart_m = np.linalg.norm(pos[:, 0] - pos[:, 1], axis=1).min()
    assert 0.85 <= apart_m < 3.0, "they meet, and make way"


def test_rtl_on_the_way_out_turns_round_and_lands_at_home_however_far_that_is() -> None:
    """At 4.5 m/s a stop takes about 10 m with the acceleration of transits, 1.2 m/s^2; the way back takes a minute."""
    flight = in_the_air(5.0)
    flight.command("goto", 0, north_m=200.0, east_m=0.0, down_m=-5.0, speed_m_s=5.5)
    fly_until(flight, lambda: bool(vehicle(flight)[0][0] > 60.0))
    assert vehicle(flight)[1][0] > 4.5
    flight.command("rtl", 0)
    fly_until(flight, lambda: phase(flight) is Phase.GOTO_LAND)
    fly_until(flight, lambda: phase(flight) > Phase.GOTO_LAND, 120.0)
    assert np.linalg.norm(vehicle(flight)[0] - [0.0, 0.0, -5.0]) < 0.1, "handed back at home, not on the way"
    assert flight.truth.reshape(-1, 1)["pos_ned_m"][:, 0, 0].max() < 75.0


def test_a_goto_on_the_way_down_does_not_sink_on() -> None:
    """At 2.2 m/s a stop takes 2 m with the acceleration of transits."""
    flight = in_the_air(3.0)
    flight.command("goto", 0, north_m=0.0, east_m=0.0, down_m=-20.0, speed_m_s=3.0)
    fly_until(flight, lambda: bool(vehicle(flight)[0][2] < -19.9))
    flight.command("goto", 0, north_m=0.0, east_m=0.0, down_m=-3.0, speed_m_s=3.0)
    fly_until(flight, lambda: bool(vehicle(flight)[1][2] > 2.2))
    begun_m, begun_us = float(vehicle(flight)[0][2]), flight.clock.now_us()
    flight.command("goto", 0, north_m=60.0, east_m=0.0, down_m=begun_m)
    target = np.array([60.0, 0.0, begun_m])
    fly_until(flight, lambda: bool(np.linalg.norm(vehicle(flight)[0] - target) < 0.3), 90.0)
    assert max(float(row["pos_ned_m"][2]) for row in flight.truth if row["t_us"] > begun_us) < begun_m + 3.0


def test_resume_from_a_low_place_does_not_sink_with_the_mission_into_the_ground() -> None:
    """A helix between 2 m and 12 m above the ground; a vehicle 2 m high is resumed as the reference sinks."""
    helix = ("mission.kind=helix", "mission.helix.center_ned_m=[0,0,-2]", "mission.helix.height_m=10")
    starts = ("swarm.agents=1", "start.positions_ned_m=[[3,0,-2]]", "sitl.ground_z_m=0", "mission.duration_s=60")
    flight = Lockstep(load(None, (*COARSE, *starts, *helix)))
    fly_until(flight, lambda: phase(flight) is Phase.TRACK)
    flight.command("goto", 0, north_m=43.0, east_m=0.0, down_m=-2.0, speed_m_s=8.0)
    fly_for(flight, 20.0)
    flight.command("resume", 0)
    fly_until(flight, lambda: phase(flight) > Phase.TRACK)
    assert outcome(flight) == "completed"
    assert max(float(row["pos_ned_m"][2]) for row in flight.truth if row["t_us"] > 2e7) < -1.5


def test_a_hold_on_the_way_down_stops_above_the_ground() -> None:
    """From 4 m/s the stop of transits, at 0.6 m/s^2 on average, leads from 4 m above the ground into it."""
    points = "mission.waypoints.lists=[{points_ned_m=[[0,0,-12],[20,0,-1.5]]}]"
    sinks = ("mission.kind=waypoints", points, "mission.waypoints.speed_m_s=4", "mission.waypoints.accel_m_s2=3")
    starts = ("swarm.agents=1", "start.positions_ned_m=[[0,0,-12]]", "sitl.ground_z_m=0", "mission.duration_s=20")
    flight = Lockstep(load(None, (*COARSE, *starts, *sinks, "agent.state_machine.speed_m_s=5")))
    fly_until(flight, lambda: phase(flight) is Phase.TRACK and vehicle(flight)[0][2] > -4.0)
    begun_us = flight.clock.now_us()
    flight.command("hold", 0)
    fly_for(flight, 8.0)
    assert np.linalg.norm(vehicle(flight)[1]) < 0.1
    assert max(float(row["pos_ned_m"][2]) for row in flight.truth if row["t_us"] > begun_us) < -0.3


def test_a_point_in_an_obstacle_is_refused_and_one_that_an_obstacle_takes_later_is_told() -> None:
    flight = in_the_air(5.0)
    log = flight.logs[0].events
    there = Obstacle(center_ned_m=(8.0, 0.0, -5.0), radius_m=1.0, keep_out_m=1.75, visibility_m=3.0)
    flight.set_obstacles([there])
    fly_for(flight, 0.2)
    flight.command("goto", 0, north_m=8.3, east_m=0.0, down_m=-5.0)
    fly_for(flight, 0.2)
    (refused,) = (event for event in log if event["event"] == "order_refused")
    assert "8.3, 0, -5 is in the keep-out of obstacle 0, 0.30 m from its centre" in refused["reason"]
    flight.command("goto", 0, north_m=5.0, east_m=0.0, down_m=-5.0)
    fly_for(flight, 1.0)
    assert not [event for event in log if event["event"] == "destination_taken"]
    came = there.model_copy(update={"center_ned_m": (5.5, 0.0, -5.0)})
    flight.set_obstacles([came])
    fly_for(flight, 0.2)
    assert "is to rest in the keep-out of obstacle 0, 0.50 m from its centre" in alert(flight)
    assert least_m(flight, 6.0, lambda: came.distance_m(vehicle(flight)[0])) > came.keep_out_m - 0.05
    flight.set_obstacles([])
    fly_until(flight, lambda: bool(np.linalg.norm(vehicle(flight)[0] - [5.0, 0.0, -5.0]) < 0.3))
    assert [event["begins"] for event in log if event["event"] == "destination_taken"] == [True, False]


def least_m(flight: Lockstep, seconds: float, distance_m: Callable[[], float]) -> float:
    """Fly for a while, and return the least distance of all steps."""
    end_us, found_m = flight.clock.now_us() + round(seconds * 1e6), [distance_m()]
    while flight.clock.now_us() < end_us:
        flight.step()
        found_m.append(distance_m())
    return min(found_m)


BALL = Obstacle(center_ned_m=(0.3, 0.0, -3.0), radius_m=1.0, keep_out_m=1.75, visibility_m=3.0)


@pytest.mark.parametrize("waits", [True, False], ids=["waits", "negative control"])
def test_a_climb_that_was_held_on_the_ground_waits_for_an_obstacle_that_has_come(
    waits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its autopilot, which climbs, avoids nothing."""
    if not waits:
        monkeypatch.setattr(departure, "_to_go", lambda *_: "")
    flight = Lockstep(load(None, (*ON_GROUND_ALONE, "start.positions_ned_m=[[0,0,-5]]", "mission.kind=hover")))
    fly_until(flight, lambda: phase(flight) is Phase.TAKEOFF)
    flight.command("hold")
    fly_for(flight, 1.0)
    flight.set_obstacles([BALL])
    fly_for(flight, 1.0)
    flight.command("resume")
    nearest_m = least_m(flight, 8.0, lambda: BALL.distance_m(vehicle(flight)[0]))
    assert (nearest_m > BALL.keep_out_m) is waits
    assert waits or nearest_m < BALL.radius_m


@pytest.mark.parametrize("waits", [True, False], ids=["waits", "negative control"])
def test_a_climb_that_was_held_on_the_ground_waits_for_a_vehicle_that_has_come(
    waits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An operator has sent the other one to a point 1 m above it."""
    if not waits:
        monkeypatch.setattr(StartConditions, "_who_is_beside", lambda *_, **__: "")
    starts = "start.positions_ned_m=[[0,0,0.8],[1.2,0,-4]]"
    flight = Lockstep(load(None, (*COARSE, "swarm.agents=2", starts, "mission.kind=hover", "mission.duration_s=3")))
    fly_until(flight, lambda: phase(flight, 1) is Phase.TAKEOFF)
    flight.command("hold", 1)
    fly_until(flight, lambda: phase(flight, 0) is Phase.READY)
    flight.command("goto", 0, north_m=1.2, east_m=0.0, down_m=0.95)
    fly_for(flight, 3.5)
    flight.command("resume", 1)
    apart_m = least_m(flight, 5.0, lambda: float(np.linalg.norm(vehicle(flight, 0)[0] - vehicle(flight, 1)[0])))
    assert (apart_m >= 0.85) is waits


@pytest.mark.parametrize("stops", [True, False], ids=["stops", "negative control"])
@pytest.mark.parametrize("config", [None, "ardupilot_sitl.toml"], ids=["px4", "arducopter"])
def test_a_climb_stops_below_an_obstacle_that_comes_and_goes_on_when_it_has_gone(
    config: str | None, stops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its autopilot alone climbs through the middle of it."""
    if not stops:
        monkeypatch.setattr(departure, "_to_go", lambda *_: "")
    high = (*ON_GROUND_ALONE, "start.positions_ned_m=[[0,0,-8]]", "mission.kind=hover")
    flight = Lockstep(load(None if config is None else ROOT / "configs" / config, high))
    ground_z_m = float(vehicle(flight)[0][2])
    fly_until(flight, lambda: phase(flight) is Phase.TAKEOFF and vehicle(flight)[0][2] < ground_z_m - 1.5)
    came = BALL.model_copy(update={"center_ned_m": (0.3, 0.0, ground_z_m - 6.0)})
    flight.set_obstacles([came])
    nearest_m = least_m(flight, 10.0, lambda: came.distance_m(vehicle(flight)[0]))
    assert (nearest_m > came.keep_out_m) is stops
    if not stops:
        assert nearest_m < came.radius_m
        return
    assert alert(flight) == "waits for an obstacle 0.30 m beside its climb to go (keep_out_m = 1.75)"
    assert phase(flight) is Phase.TAKEOFF
    flight.set_obstacles([])
    fly_until(flight, lambda: phase(flight) > Phase.TRACK)
    assert outcome(flight) == "completed"
