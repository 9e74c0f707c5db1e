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
from swarmctl.errors import ConfigError, MissionError, StartError
from swarmctl.ops import running_launches
from swarmctl.ops.orders import obstacle_list
from swarmctl.ops.orders.operator import list_keepers
from swarmctl.ops.running_launches import RunningLaunch
from swarmctl.ops.verbs.obstacles import obstacle_remove
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
        self.bus = self.hub.connect("launch", {OBSTACLES: ["verb"]})
        self.operator = self.hub.connect("verb", {OBSTACLES: [OPERATOR]})
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
            if message.replaces(self.known):
                self.known = msgspec.structs.replace(message, proposed=False)
        told = msgspec.structs.replace(self.known, utc_us=self.now_us)
        self.hub.carry(OPERATOR, OBSTACLES, encode_message(told))
        self.now_us += round(seconds * 5e5)


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch) -> Launch:
    return Launch(monkeypatch)


def test_a_number_stays_and_no_other_obstacle_gets_it(launch: Launch) -> None:
    change = obstacle_list.change_obstacles
    assert numbers(change(LAUNCH, lambda known: obstacle_list.added(known, [BALL])).listed) == [0, 1, 2]
    assert numbers(change(LAUNCH, lambda known: obstacle_list.removed(known, [0, 2])).listed) == [1]
    assert numbers(change(LAUNCH, lambda known: obstacle_list.added(known, [BALL, BALL])).listed) == [1, 3, 4]
    assert numbers(launch.known) == [1, 3, 4]


def test_a_change_is_made_again_where_another_operator_was_quicker(launch: Launch) -> None:
    theirs = obstacle_list.added(launch.known, [TRAIN])
    launch.rival = [msgspec.structs.replace(launch.known, version=2, next_number=3, obstacles=tuple(theirs))]
    kept = obstacle_list.change_obstacles(LAUNCH, lambda known: obstacle_list.added(known, [BALL]))
    assert numbers(kept.listed) == [0, 1, 2, 3]
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
    assert obstacle_list.lines_of(first_list((BALL,), UTC_US))[0].startswith("1 obstacle, where")
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


class Hosts:
    """Keepers of several computers, as an operator's verb at alpha hears them: what they repeat, and who is deaf."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, versions: dict[str, int], deaf: tuple[str, ...] = ()) -> None:
        self.now_us, self.deaf = UTC_US, deaf
        self.hub = LocalHub(lambda: self.now_us)
        identity = SwarmOfHosts.of(Path("nowhere")).identity("alpha")
        self.launch = RunningLaunch("hosts-1a", "unixsock-stream//x", 1, 0.0, 3, "runs/x", "", identity)
        self.known = {
            name: first_list((BALL,) * min(version, 3), UTC_US, version=version) for name, version in versions.items()
        }
        self.verb = self.hub.connect("verb", {OBSTACLES: list_keepers(identity)})
        self.ears = {name: self.hub.connect(f"at {name}", {OBSTACLES: ["verb"]}) for name in versions}
        monkeypatch.setattr(obstacle_list, "joined", self.joined)
        monkeypatch.setattr(time, "sleep", self.pass_time)
        monkeypatch.setattr(time, "monotonic", lambda: self.now_us * 1e-6)

    @contextlib.contextmanager
    def joined(self, launch: RunningLaunch) -> Iterator[object]:
        yield self.verb

    def pass_time(self, seconds: float) -> None:
        self.now_us += round(seconds * 5e5)
        for name, ear in self.ears.items():
            for _, payload in ear.receive(OBSTACLES):
                message = decode_obstacles(payload)
                assert message is not None
                assert message.utc_us == pytest.approx(self.now_us, abs=500_000), "stamped when it is sent"
                if message.replaces(self.known[name]) and name not in self.deaf:
                    self.known[name] = msgspec.structs.replace(message, proposed=False)
            told = msgspec.structs.replace(self.known[name], utc_us=self.now_us)
            self.hub.carry(name, OBSTACLES, encode_message(told))
        self.now_us += round(seconds * 5e5)

    def add(self) -> obstacle_list.KeptList:
        return obstacle_list.change_obstacles(self.launch, lambda known: obstacle_list.added(known, [TRAIN]))


def test_a_change_goes_on_from_the_newest_list_that_any_host_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Alpha was started again, and begins with the first version."""
    hosts = Hosts(monkeypatch, {"alpha": 1, "bravo": 3, "charlie": 3})
    kept = hosts.add()
    assert {message.version for message in hosts.known.values()} == {4}
    assert {tuple(numbers(message)) for message in hosts.known.values()} == {(0, 1, 2, 3)}
    assert (kept.others, kept.unheard) == ((), ())


def test_who_keeps_another_list_or_is_not_heard_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hosts = Hosts(monkeypatch, {"alpha": 1, "bravo": 1}, deaf=("bravo",))
    kept = hosts.add()
    assert (kept.others, kept.unheard) == (("bravo",), ("charlie",))
    monkeypatch.setattr(running_launches, "find_launch", lambda _: hosts.launch)
    with pytest.raises(MissionError, match="obstacle: not taken by bravo"):
        obstacle_remove([0])
    assert "nothing is heard from charlie, which may keep another" in capsys.readouterr().err


def test_what_the_own_launch_does_not_take_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    hosts = Hosts(monkeypatch, {"alpha": 1, "bravo": 1, "charlie": 1}, deaf=("alpha",))
    with pytest.raises(StartError, match="the launch did not take the list"):
        hosts.add()


def test_a_host_whose_version_nobody_can_have_come_to_stops_no_change(monkeypatch: pytest.MonkeyPatch) -> None:
    hosts = Hosts(monkeypatch, {"alpha": 1, "bravo": 2**62, "charlie": 1})
    kept = hosts.add()
    assert (kept.others, kept.listed.version) == (("bravo",), 2)
    assert hosts.known["charlie"].version == 2
