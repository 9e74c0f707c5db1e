"""Another mission for a swarm that flies: begun by all at one time, apart on the way, refused where it can't be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.bus import topics
from swarmctl.bus.messages.json_messages import StatusMessage, decode_status, encode_message
from swarmctl.config import Config, load, load_mission
from swarmctl.core.clock import ClockError
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import BEGIN, MISSION
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError
from swarmctl.ops.orders.mission_file import mission_message, mission_order
from tests.closed_loop.conftest import COARSE
from tests.closed_loop.test_operator import fly_for, fly_until, outcome, phase

HOVER = (
    *COARSE,
    "swarm.agents=2",
    "start.positions_ned_m=[[0,0,-3],[4,0,-3]]",
    "mission.kind=hover",
    "sitl.start=air",
)
SWAP = """
[mission]
kind = "waypoints"
duration_s = 9.0
waypoints.speed_m_s = 1.5
waypoints.lists = [
  { points_ned_m = [[0.0, 0.0, -3.0], [2.0, 0.2, -3.0], [4.0, 1.0, -3.0]] },
  { points_ned_m = [[4.0, 0.0, -3.0], [2.0, -0.2, -3.0], [0.0, -1.0, -3.0]] },
]
"""
ENDS = np.array([[4.0, 1.0, -3.0], [0.0, -1.0, -3.0]])


@pytest.fixture
def swap(tmp_path: Path) -> Path:
    path = tmp_path / "swap.toml"
    path.write_text(SWAP)
    return path


def order(
    flight: Lockstep,
    path: Path,
    agent: int = -1,
    *,
    sent: bool = True,
    config: Config | None = None,
    statuses: Mapping[int, StatusMessage] = MappingProxyType({}),
) -> None:
    """Do what `swarmctl mission set` does, by the flight's configuration or another one."""
    message = mission_message(load_mission(config or flight.config, path))
    if sent:
        flight._operator.publish(topics.MISSION, encode_message(message))
    ordered = mission_order(message, statuses, flight.clock.utc_us())
    flight.command(MISSION, agent, **ordered.arguments)


def events(flight: Lockstep, agent: int, name: str) -> list[dict[str, object]]:
    return [event for event in flight.logs[agent].events if event["event"] == name]


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_a_hovering_swarm_flies_the_mission_of_a_file_at_one_time_and_apart(mode: str, swap: Path) -> None:
    flight = Lockstep(load(None, (*HOVER, "mission.duration_s=60", f"separation.mode={mode}")))
    fly_until(flight, lambda: phase(flight, 0) is phase(flight, 1) is Phase.TRACK)
    fly_for(flight, 1.0)
    order(flight, swap)
    fly_for(flight, 3.0)
    times_s = [float(log.rows[-1]["mission_t_s"][0]) for log in flight.logs]
    assert times_s[0] == pytest.approx(1.5, abs=0.1)
    assert times_s[1] == pytest.approx(times_s[0], abs=1e-3)
    fly_until(flight, lambda: phase(flight, 0) > Phase.TRACK)
    places = flight.world.truth_rows()["pos_ned_m"]
    assert np.abs(places - ENDS).max() < 0.15, "where the file's lists end, when it does"
    fly_until(flight, lambda: flight.finished)
    assert [outcome(flight, agent) for agent in range(2)] == ["completed"] * 2
    pos = flight.truth.reshape(-1, 2)["pos_ned_m"]
    assert np.linalg.norm(pos[:, 0] - pos[:, 1], axis=1).min() >= 0.85


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_agents_whose_clocks_differ_begin_at_one_time(mode: str, swap: Path) -> None:
    sets = (*HOVER, "mission.duration_s=60", f"separation.mode={mode}")
    flight = Lockstep(load(None, sets), clocks={0: ClockError(offset_us=400_000), 1: ClockError(offset_us=-400_000)})
    operator = flight.hub.connect("verb", {topics.STATUS: None})
    fly_until(flight, lambda: phase(flight, 0) is phase(flight, 1) is Phase.TRACK)
    fly_for(flight, 1.0)
    said = [decode_status(payload) for _, payload in operator.receive(topics.STATUS)]
    order(flight, swap, statuses={status.agent: status for status in said if status is not None})
    fly_for(flight, 3.0)
    times_s = [float(log.rows[-1]["mission_t_s"][0]) for log in flight.logs]
    assert times_s[0] == pytest.approx(1.6, abs=0.15), "a status may be 0.2 s old"
    assert times_s[1] == pytest.approx(times_s[0], abs=0.05), "0.8 s apart where each begins by its own clock"


def test_before_the_mission_it_is_what_all_begin_with(swap: Path) -> None:
    flight = Lockstep(load(None, (*HOVER, "mission.duration_s=60")))
    fly_until(flight, lambda: phase(flight, 0) is Phase.ARM)
    order(flight, swap)
    fly_until(flight, lambda: phase(flight, 0) > Phase.TRACK)
    assert np.abs(flight.world.truth_rows()["pos_ned_m"] - ENDS).max() < 0.15


def test_one_agent_flies_it_and_a_hold_stays_a_hold(swap: Path) -> None:
    flight = Lockstep(load(None, (*HOVER, "mission.duration_s=60")))
    fly_until(flight, lambda: phase(flight, 0) is phase(flight, 1) is Phase.TRACK)
    flight.command("hold", 0)
    fly_for(flight, 1.0)
    order(flight, swap, agent=0)
    fly_for(flight, 4.0)
    places = flight.world.truth_rows()["pos_ned_m"]
    assert np.abs(places - [[0.0, 0.0, -3.0], [4.0, 0.0, -3.0]]).max() < 0.2
    assert not events(flight, 1, "operator")
    flight.command("resume", 0)
    fly_until(flight, lambda: phase(flight, 0) > Phase.TRACK)
    moved = np.linalg.norm(flight.world.truth_rows()["pos_ned_m"] - places, axis=1)
    assert moved[0] > 2.0 > moved[1], "agent 1 still hovers"


def test_what_has_not_arrived_begins_another_day_or_can_not_be_flown_is_refused(tmp_path: Path, swap: Path) -> None:
    flight = Lockstep(load(None, (*HOVER, "mission.duration_s=60")))
    fly_until(flight, lambda: phase(flight, 0) is phase(flight, 1) is Phase.TRACK)
    order(flight, swap, sent=False)
    fly_for(flight, 0.1)
    message = mission_message(load_mission(flight.config, swap))
    flight._operator.publish(topics.MISSION, encode_message(message))
    flight.command(MISSION, agent=-1, **{MISSION: float(message.mission), BEGIN: flight.clock.utc_us() * 1e-6 + 60.0})
    fly_for(flight, 0.1)
    for number, text in enumerate(
        (
            '{"kind": "goto", "goto": {"goals_ned_m": [[1, 2]]}}',
            '{"kind": "os:PathLike"}',
            '{"kind": "circle", "circle": {"radius_m": 5.0, "omega_rad_s": 3.0}}',
        )
    ):
        flight._operator.publish(topics.MISSION, encode_message(type(message)(mission=number, text=text)))
        flight.command(MISSION, agent=-1, **{MISSION: float(number), BEGIN: flight.clock.utc_us() * 1e-6})
        fly_for(flight, 0.1)
    reasons = [str(event["reason"]) for event in events(flight, 1, "order_refused")]
    expected = ("has not arrived", "more than 10 s from now", "wrong value", "somebody else's code", "accelerates by")
    assert len(reasons) == len(expected)
    assert all(part in reason for part, reason in zip(expected, reasons, strict=True)), reasons
    assert phase(flight, 1) is Phase.TRACK


def test_a_mission_that_leaves_the_geofence_is_refused_by_the_operators_side_and_by_each_agent(swap: Path) -> None:
    fence = "geofence.corners_ne_m=[[-1, -0.5], [5, -0.5], [5, 0.5], [-1, 0.5]]"
    flight, free = (Lockstep(load(None, (*HOVER, "mission.duration_s=60", *fences))) for fences in ((fence,), ()))
    fly_until(flight, lambda: phase(flight, 0) is phase(flight, 1) is Phase.TRACK)
    with pytest.raises(ConfigError, match=r"m outside of geofence\.corners_ne_m"):
        order(flight, swap)
    message = mission_message(load_mission(free.config, swap))
    flight._operator.publish(topics.MISSION, encode_message(message))
    flight.command(MISSION, agent=-1, **{MISSION: float(message.mission), BEGIN: flight.clock.utc_us() * 1e-6})
    fly_for(flight, 0.1)
    for agent in (0, 1):
        (refused,) = events(flight, agent, "order_refused")
        assert "outside of geofence.corners_ne_m" in str(refused["reason"])


def test_a_mission_that_ends_in_an_obstacle_of_now_is_refused_by_whose_goal_it_is(swap: Path) -> None:
    flight = Lockstep(load(None, (*HOVER, "mission.duration_s=60")))
    fly_until(flight, lambda: phase(flight, 0) is phase(flight, 1) is Phase.TRACK)
    beside = Obstacle(center_ned_m=(4.5, 1.0, -3.0), radius_m=0.3, keep_out_m=0.6, visibility_m=2.0)
    passing = Obstacle(center_ned_m=(0.0, -1.0, -3.0), radius_m=0.1, keep_out_m=0.2, vel_ned_m_s=(0.0, 0.0, 0.001))
    flight.set_obstacles([passing, beside])
    fly_for(flight, 0.1)
    order(flight, swap)
    fly_for(flight, 0.1)
    (refused,) = events(flight, 0, "order_refused")
    assert str(refused["reason"]).startswith("its goal is in the keep-out of obstacle 1, 0.50 m from its centre")
    assert not events(flight, 1, "order_refused"), "what moves is gone until then"


def test_a_file_that_this_swarm_can_not_fly_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    config = load(None, HOVER)
    for text, said in (
        ('name = "x"\n[mission]\nkind = "hover"', "is a file of \\[mission\\] alone"),
        ('[mission]\nkind = "own_spiral:Spiral"', "only by a launch that was started with it"),
        ('[mission]\nkind = "waypoints"\nwaypoints.lists = [{points_ned_m=[[0,0,-2]]}]', "a flight needs 2 or more"),
        ('[mission]\nkind = "circle"\ncircle.omega_rad_s = 3.0', "accelerates by"),
    ):
        path = tmp_path / "mission.toml"
        path.write_text(text)
        with pytest.raises(ConfigError, match=said):
            load_mission(config, path)


def test_a_mission_below_the_ground_is_refused_where_only_the_vehicle_knows_the_ground(tmp_path: Path) -> None:
    path = tmp_path / "below.toml"
    points = "[[0.0, 0.0, -3.0], [4.0, 0.0, 4.0], [8.0, 0.0, -3.0]]"
    path.write_text(
        f'[mission]\nkind = "waypoints"\nduration_s = 9.0\nwaypoints.speed_m_s = 1.5\n'
        f"waypoints.lists = [{{ points_ned_m = {points} }}]\n"
    )
    alone = (
        *COARSE,
        "swarm.agents=1",
        "start.positions_ned_m=[[0,0,-3]]",
        "mission.kind=hover",
        "mission.duration_s=60",
    )
    real = load(None, (*alone, "sitl.enabled=false", 'vehicles=[{sysid=1, url="udpin://0.0.0.0:14540"}]'))
    flight = Lockstep(load(None, alone))
    fly_until(flight, lambda: phase(flight, 0) is Phase.TRACK)
    order(flight, path, config=real)  # which does not know the ground
    fly_for(flight, 1.0)
    (refused,) = events(flight, 0, "order_refused")
    assert "above the ground at the place of the take-off = 2 (NED)" in str(refused["reason"])


def test_a_mission_on_whose_way_the_fence_is_left_is_refused(tmp_path: Path) -> None:
    """The fence has two arms; the mission is in the other one."""
    fence = "geofence.corners_ne_m=[[-3,-3],[20,-3],[20,3],[3,3],[3,20],[-3,20]]"
    place = (*COARSE, "swarm.agents=1", "start.positions_ned_m=[[12,0,-3]]", "mission.kind=hover", "sitl.start=air")
    flight = Lockstep(load(None, (*place, "mission.duration_s=60", fence)))
    fly_until(flight, lambda: phase(flight, 0) is Phase.TRACK)
    for goal, reasons in (("[12.0, 2.0, -3.0]", []), ("[0.0, 14.0, -3.0]", ["on the way is outside of the geofence"])):
        path = tmp_path / f"{len(reasons)}.toml"
        lists = f"[{{ points_ned_m = [{goal}, {goal.replace('-3.0', '-4.0')}] }}]"
        path.write_text(f'[mission]\nkind = "waypoints"\nduration_s = 20.0\nwaypoints.lists = {lists}\n')
        order(flight, path)
        fly_for(flight, 1.0)
        refused = [str(event["reason"]) for event in events(flight, 0, "order_refused")]
        assert [words in reason for words, reason in zip(reasons, refused, strict=True)] == [True] * len(reasons)
