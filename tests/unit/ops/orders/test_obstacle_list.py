"""The obstacles of a running launch: numbers that stay, places of now, files, and changes by several operators."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import (
    MAX_OBSTACLES,
    ObstaclesMessage,
    decode_obstacles,
    encode_message,
    first_list,
)
from swarmctl.bus.topics import OBSTACLES, OPERATOR
from swarmctl.config import load
from swarmctl.core.obstacle import Obstacle
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.orders import obstacle_list
from swarmctl.ops.running_launches import RunningLaunch
from tests.benches.swarm_of_hosts import SwarmOfHosts

UTC_US = 1_700_000_000_000_000
LAUNCH = RunningLaunch("circle-1a", "unixsock-stream//x", 1, 0.0, 3, "runs/x")
BALL = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0)
TRAIN = Obstacle(center_ned_m=(0.0, 10.0, -2.0), vel_ned_m_s=(1.0, 0.0, 0.0), column=True)


def later(message: ObstaclesMessage, seconds: float) -> ObstaclesMessage:
    return msgspec.structs.replace(message, utc_us=message.utc_us + round(seconds * 1e6))


def numbers(message: ObstaclesMessage) -> list[int]:
    return [item.number for item in message.obstacles]


class Launch:
    """A launch that repeats the list as the supervisor does, on a bus in memory whose time passes by itself."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_us = UTC_US
        self.hub = LocalHub(lambda: self.now_us)
        self.known = first_list((BALL, TRAIN), UTC_US)
        self.rival: list[ObstaclesMessage] = []  # lists of another operator, each adopted before ours arrives
        self.bus = self.hub.connect("launch", {OBSTACLES: [OPERATOR]})
        self.operator = self.hub.connect(OPERATOR, {OBSTACLES: ["launch"]})
        monkeypatch.setattr(obstacle_list, "joined", self.joined)
        monkeypatch.setattr(time, "sleep", self.pass_time)
        monkeypatch.setattr(time, "monotonic", lambda: self.now_us * 1e-6)

    @contextlib.contextmanager
    def joined(self, launch: RunningLaunch) -> Iterator[object]:
        yield self.operator

    def pass_time(self, seconds: float) -> None:
        self.now_us += round(seconds * 5e5)
        for _, payload in self.bus.receive(OBSTACLES):
            message = decode_obstacles(payload)
            assert message is not None
            if self.rival:
                self.known = self.rival.pop(0)
            if message.replaces(self.known.version):
                self.known = message
        self.bus.publish(OBSTACLES, encode_message(msgspec.structs.replace(self.known, utc_us=self.now_us)))
        self.now_us += round(seconds * 5e5)


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Launch:
    return Launch(monkeypatch)


def test_a_number_stays_and_no_other_obstacle_gets_it(launch: Launch) -> None:
    change = obstacle_list.change_obstacles
    assert numbers(change(LAUNCH, lambda known: obstacle_list.added(known, [BALL]))) == [0, 1, 2]
    assert numbers(change(LAUNCH, lambda known: obstacle_list.removed(known, [0, 2]))) == [1]
    assert numbers(change(LAUNCH, lambda known: obstacle_list.added(known, [BALL, BALL]))) == [1, 3, 4]
    assert numbers(launch.known) == [1, 3, 4]


def test_a_change_is_made_again_where_another_operator_was_quicker(launch: Launch) -> None:
    theirs = obstacle_list.added(launch.known, [TRAIN])
    launch.rival = [msgspec.structs.replace(launch.known, version=2, next_number=3, obstacles=tuple(theirs))]
    message = obstacle_list.change_obstacles(LAUNCH, lambda known: obstacle_list.added(known, [BALL]))
    assert numbers(message) == [0, 1, 2, 3]
    assert [item.obstacle for item in launch.known.obstacles] == [BALL, TRAIN, TRAIN, BALL]


def test_where_others_change_the_list_all_the_time_it_is_said(launch: Launch) -> None:
    launch.rival = [msgspec.structs.replace(launch.known, version=version) for version in range(2, 40)]
    with pytest.raises(StartError, match="others change the list"):
        obstacle_list.change_obstacles(LAUNCH, lambda known: obstacle_list.added(known, [BALL]))


def test_too_many_are_refused_with_their_number(launch: Launch) -> None:
    with pytest.raises(ConfigError, match=f"there would be 66, now there are 2; agents keep {MAX_OBSTACLES} at most"):
        obstacle_list.change_obstacles(LAUNCH, lambda known: obstacle_list.added(known, [BALL] * 64))


def test_the_list_shows_where_obstacles_are_now() -> None:
    known = later(first_list((BALL, TRAIN), UTC_US), 4.0)
    assert obstacle_list.lines_of(known) == [
        "2 obstacles, where they are now, shared NED [m]",
        "0: sphere at 5.00, 0.00, -2.00  radius 0.5  keep-out 1  seen from 3  at rest",
        "1: column at 4.00, 10.00, -2.00  radius 1  keep-out 1.75  seen from 3  velocity 1.00, 0.00, 0.00 m/s",
    ]
    shown = msgspec.json.decode(obstacle_list.as_json(known))
    assert [(item["number"], item["center_ned_m"]) for item in shown] == [(0, [5.0, 0.0, -2.0]), (1, [4.0, 10.0, -2.0])]


def test_an_obstacle_is_moved_from_where_it_is_and_keeps_its_number_and_sizes() -> None:
    known = later(first_list((BALL, TRAIN), UTC_US), 4.0)
    ball, train = obstacle_list.moved(known, 1, None, "0,-2,0")
    assert ball is known.obstacles[0]
    assert (train.number, train.since_utc_us) == (1, known.utc_us)
    assert train.obstacle == TRAIN.model_copy(
        update={"center_ned_m": (4.0, 10.0, -2.0), "vel_ned_m_s": (0.0, -2.0, 0.0)}
    )
    _, train = obstacle_list.moved(known, 1, "1,2,-3", None)
    assert train.obstacle == TRAIN.model_copy(update={"center_ned_m": (1.0, 2.0, -3.0)})


def test_all_that_is_wrong_with_a_change_is_said_at_once() -> None:
    known = first_list((BALL, TRAIN), UTC_US)
    with pytest.raises(ConfigError) as caught:
        obstacle_list.moved(known, 7, "1,2", "0,nan,0")
    assert [problem.split(";")[0].split(":")[0] for problem in caught.value.problems] == [
        "there is no obstacle 7",
        "--center '1,2'",
        "--velocity nan",
    ]
    with pytest.raises(ConfigError, match="give --center, --velocity or both"):
        obstacle_list.moved(known, 0, None, None)
    with pytest.raises(ConfigError) as caught:
        obstacle_list.removed(known, [5, 0, 6, 5])
    assert caught.value.problems == tuple(f"there is no obstacle {k}; those there are: 0, 1" for k in (5, 6))
    with pytest.raises(ConfigError, match="there is no obstacle 0; there are none"):
        obstacle_list.removed(first_list((), UTC_US), [0])


def test_obstacles_are_saved_as_they_are_now_and_loaded_by_configurations_too(tmp_path: Path) -> None:
    path = tmp_path / "obstacles.toml"
    obstacle_list.write_file(path, later(first_list((BALL, TRAIN), UTC_US), 4.0))
    saved = (BALL, TRAIN.model_copy(update={"center_ned_m": (4.0, 10.0, -2.0)}))
    assert obstacle_list.read_file(path) == saved
    config = tmp_path / "config.toml"
    config.write_text("[swarm]\nagents = 1\n" + path.read_text())
    assert load(config).obstacles == saved
    with pytest.raises(ConfigError, match="exists already"):
        obstacle_list.write_file(path, first_list((), UTC_US))


def test_all_that_is_wrong_with_a_file_is_said_at_once(tmp_path: Path) -> None:
    path = tmp_path / "obstacles.toml"
    path.write_text(
        "[swarm]\nagents = 3\n[[obstacles]]\nradius_m = -1.0\n[[obstacles]]\ncenter_ned_m = [0.0, nan, 0.0]\nsize = 2\n"
        "[[obstacles]]\ncenter_ned_m = [0.0, 0.0, 0.0]\nradius_m = 2\n"
    )
    with pytest.raises(ConfigError) as caught:
        obstacle_list.read_file(path)
    assert [problem.split(" ")[0] for problem in caught.value.problems] == [
        "obstacles.0.center_ned_m:",
        "obstacles.0.radius_m",
        "obstacles.1.center_ned_m.1",
        "obstacles.1.size",
        "obstacles.2.keep_out_m",
        "swarm",
    ]


def test_a_host_without_an_operators_identity_changes_no_list() -> None:
    identity = SwarmOfHosts.of(Path("nowhere")).identity("bravo")
    launch = RunningLaunch("hosts-1a", "unixsock-stream//x", 1, 0.0, 3, "runs/x", "", identity)
    with pytest.raises(ConfigError, match="bravo has no operator's identity"):
        obstacle_list.change_obstacles(launch, lambda known: known.obstacles)
