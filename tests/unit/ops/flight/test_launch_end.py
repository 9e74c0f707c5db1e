"""What verbs say of a launch whose agents have ended, while it writes its report."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
from typer.testing import CliRunner

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import EndedMessage, encode_message
from swarmctl.bus.topics import ENDED, OPERATOR, STATUS
from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.config import Config, load
from swarmctl.core.operator_verbs import Order
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops import running_launches
from swarmctl.ops.cli import app
from swarmctl.ops.flight import launch as launching
from swarmctl.ops.flight.launch import Launcher, LaunchOptions, SwarmPart, judged
from swarmctl.ops.orders import obstacle_list, operator, order_delivery
from swarmctl.ops.orders.obstacle_list import read_obstacles
from swarmctl.ops.orders.operator import joined, read_statuses
from swarmctl.ops.orders.order_delivery import deliver
from swarmctl.ops.preflight import ReservedPorts
from swarmctl.ops.processes import ROUTER, Child, Command
from swarmctl.ops.running_launches import RunningLaunch, announce, find_launch
from swarmctl.ops.supervision.launch_result import LaunchResult
from swarmctl.wall_clock import WallClock
from tests import builders

ENDING = r"circle.* is ending: nobody answers any more, it writes its report to .*run"


@pytest.fixture
def launch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> RunningLaunch:
    """Return a launch of this process, which flies."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    started_s, pid = running_launches.process_start_s()
    (tmp_path / "run").mkdir()
    flies = RunningLaunch("circle-1a", f"{SCHEME}{tmp_path}/bus.sock", pid, started_s, 3, str(tmp_path / "run"))
    announce(flies)
    return flies


def test_a_launch_is_found_though_no_disk_takes_a_file(
    launch: RunningLaunch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The recording may have filled the only one, and the vehicles are to be landed."""

    def full() -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "gettempdir", full)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert find_launch(launch.run).run_dir == launch.run_dir
    announce(launch)


def test_a_folder_that_can_not_be_looked_into_is_none_of_a_launch(launch: RunningLaunch) -> None:
    with pytest.raises(StartError, match="no launch runs there or has that name"):
        find_launch("x" * 300)


def end(launch: RunningLaunch) -> None:
    announce(msgspec.structs.replace(launch, ending=True))


def no_router(*given: Any, **named: Any) -> Any:
    raise StartError("no router answers")


def nobody(*given: Any, **named: Any) -> Any:
    return LocalHub(lambda: 0).connect(OPERATOR)


def test_verbs_say_that_a_launch_is_ending(launch: RunningLaunch) -> None:
    end(launch)
    for name in (None, "circle", launch.run_dir):
        with pytest.raises(StartError, match=ENDING):
            find_launch(name)


def test_a_launch_that_is_ending_is_not_in_the_way_of_one_that_flies(
    launch: RunningLaunch, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = msgspec.structs.replace(launch, run="circle-2b", pid=os.getppid(), run_dir=f"{launch.run_dir}/other")
    monkeypatch.setattr(running_launches, "runs", lambda launch: True)
    announce(other)
    end(launch)
    assert find_launch(None) == other
    assert find_launch("circle") == other


def test_a_verb_that_finds_a_launch_in_its_last_moment_says_that_it_is_ending(
    launch: RunningLaunch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operator, "ANSWER_S", 0.0)
    monkeypatch.setattr(order_delivery, "ANSWER_S", 0.0)
    monkeypatch.setattr(obstacle_list, "ANSWER_S", 0.0)
    for bus in (nobody, no_router):
        monkeypatch.setattr(operator, "join_bus", bus)
        announce(launch)
        if bus is nobody:  # it is late, and still there
            assert read_statuses(launch) == {}
            assert {reply.answer for reply in deliver(launch, Order("hold"), [])} == {None}
        end(launch)
        with pytest.raises(StartError, match=ENDING):
            read_statuses(launch)
        with pytest.raises(StartError, match=ENDING):
            deliver(launch, Order("hold"), [])
        with pytest.raises(StartError, match=ENDING):
            read_obstacles(launch)


def test_a_launch_whose_bus_does_not_answer_is_said_to_run_and_how_it_is_landed(
    launch: RunningLaunch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of a router which is stopped, for instance; who orders a landing must not be told to start a router."""
    monkeypatch.setattr(operator, "join_bus", no_router)
    land = rf"{launch.run} runs, but .* nobody has been told.* lands all its agents: kill -INT {launch.pid}"
    with pytest.raises(StartError, match=land), joined(launch):
        pass
    monkeypatch.setattr(running_launches, "runs", lambda launch: False)
    monkeypatch.setattr(operator, "runs", lambda launch: False)
    with pytest.raises(StartError, match=f"{launch.run} has ended: its process {launch.pid} is gone"), joined(launch):
        pass


def test_who_has_ended_with_its_vehicle_down_is_told_apart_from_who_is_not_heard(
    launch: RunningLaunch, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = LocalHub(lambda: time.monotonic_ns() // 1000)
    names = [agent_name(agent) for agent in range(3)]
    bus = hub.connect(OPERATOR, {STATUS: names, ENDED: [OPERATOR]})
    hub.connect(names[0]).publish(STATUS, encode_message(builders.status_message(agent=0)))
    bus.publish(ENDED, encode_message(EndedMessage(agent=1, boot_id=5, is_down=True)))
    monkeypatch.setattr(operator, "ANSWER_S", 1.2)
    monkeypatch.setattr(operator, "join_bus", lambda *_, **__: bus)
    result = CliRunner().invoke(app, ["status"])
    assert result.exit_code == 0
    first, second, third = result.stdout.splitlines()[1:]
    assert "TRACK" in first
    assert second.split() == ["1", "has", "ended,", "its", "vehicle", "is", "on", "the", "ground"]
    assert third.split() == ["2", "not", "heard"]


def launcher(folder: Path, agents: tuple[int, ...] = ()) -> Launcher:
    ports = ReservedPorts(sockets=(), ports=(), view_port=0)
    return Launcher(Config(), LaunchOptions(), ports, folder, part=SwarmPart(run="circle-1a", agents=agents))


def test_a_vehicle_is_landed_though_the_run_folder_is_gone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What lands it has a configuration to read, and a folder to record into, as agents refuse to begin without."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    services = launcher(tmp_path / "removed", agents=(0, 1))
    services.children[ROUTER] = Child(Command(ROUTER, (sys.executable, "-Sc", "")), tmp_path)
    monkeypatch.setattr(launching, "Child", lambda command, folder: SimpleNamespace(folder=folder, **asdict(command)))
    found = cast(Any, services.recover(1))
    words = dict(zip(found.argv, found.argv[1:], strict=False))
    assert words["--id"] == "1"
    assert load(Path(words["--config"])) == Config()
    assert Path(words["--run-dir"]).is_dir()
    assert found.folder.is_dir()
    services.stop(0.0)
    assert not found.folder.exists()


def test_a_launch_is_ending_from_the_end_of_its_agents_until_its_report_is_written(
    launch: RunningLaunch, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    order: list[str] = []

    def ended(*given: object, **_: bool) -> bool:
        try:
            order.append(find_launch(launch.run_dir).run)
        except StartError as error:
            order.append("ending" if "is ending" in str(error) else str(error))
        return False

    monkeypatch.setattr(launching, "end_all", ended)
    monkeypatch.setattr(launching, "sum_up", ended)
    services = launcher(tmp_path / "run")
    services.announce("")
    services.stop(0.0)
    assert judged(Config(), services, LaunchResult()) == 0
    agents, shared, others, router, report = order
    assert agents == shared == "circle-1a"
    assert (others, router, report) == ("ending",) * 3
    with pytest.raises(StartError, match="no launch runs"):
        find_launch(None)


def test_agents_are_ended_first_whatever_their_processes_are_called(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ended: list[list[str]] = []
    monkeypatch.setattr(launching, "end_all", lambda children, grace_s: ended.append([one.name for one in children]))
    monkeypatch.setattr(launching, "Child", lambda command, folder: SimpleNamespace(poll=lambda: 0, **asdict(command)))
    services = launcher(tmp_path)
    for name, agents in ((ROUTER, ()), ("agent-view", ()), ("three", (3,)), ("agent-4", (4,))):
        services._spawn(Command(name, (), agents=agents))
    services.stop(0.0)
    assert ended == [["three", "agent-4"], [], ["agent-view"], [ROUTER]]


def test_an_end_that_can_not_be_announced_is_one_all_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def no_descriptor(note: RunningLaunch) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    ended: list[object] = []
    monkeypatch.setattr(launching, "end_all", lambda children, grace_s: ended.append(children))
    services = launcher(tmp_path)
    monkeypatch.setattr(launching, "announce", lambda note: None)
    services.announce("")
    monkeypatch.setattr(launching, "announce", no_descriptor)
    services.stop(0.0)
    assert len(ended) == 4, "agents, processes that they share, others, router"


@pytest.mark.parametrize(
    ("events", "arguments", "said"),
    [
        ('{"event":"parameters_changed","were":{"NAV_DLL_ACT":0}}\n', ("--originals", '{"NAV_DLL_ACT": 0}'), ""),
        (None, (), "the vehicle of agent-0 may keep the parameters of this flight: "),
        ('{"event":"parameters_changed","were":{"NAV_DLL_ACT":"x"}}\n', (), "the vehicle of agent-0 may keep"),
    ],
    ids=["told", "lost", "damaged"],
)
def test_who_lands_the_vehicle_of_another_agent_is_told_what_its_parameters_were(
    events: str | None,
    arguments: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    if events is not None:
        (tmp_path / "agent-0.events.jsonl").write_text(events)
    monkeypatch.setattr(launching, "Child", lambda command, directory: command)
    services = launcher(tmp_path, agents=(0,))
    services.children[ROUTER] = cast(Any, SimpleNamespace(poll=lambda: None))
    command = cast(Any, services.recover(0))
    assert command.argv[command.argv.index("--only-land") + 1 :] == arguments
    services.display.close()
    assert capsys.readouterr().out.startswith(said)
    services.children.clear()
    services.stop(0.0)


@pytest.mark.parametrize(
    ("result", "violated", "code"),
    [
        (LaunchResult(), False, 0),
        (LaunchResult(), True, 4),
        (LaunchResult(landed_by_operator=True), False, 130),
        (LaunchResult(landed_by_operator=True), True, 4),
        (LaunchResult(landed_by_operator=True, interrupted=True), True, 130),
        (LaunchResult(interrupted=True, left=("vehicle 1",)), False, 4),
        (LaunchResult(could_not_start=True), True, 3),
        (LaunchResult(could_not_start=True, has_armed=True, problems=["agent-1 could not start"]), False, 4),
        (LaunchResult(landed_by_operator=True, problems=["agent-1 died"]), False, 4),
        (LaunchResult(problems=["agent-1 died"]), False, 4),
    ],
)
def test_a_violation_is_told_by_the_exit_code_unless_ctrl_c_has_ended_the_flight(
    result: LaunchResult, violated: bool, code: int
) -> None:
    assert result.exit_code(violated) == code


@pytest.mark.parametrize(
    ("result", "outcome"),
    [
        (LaunchResult(), "completed"),
        (LaunchResult(problems=["agent-1 died"]), "failed"),
        (LaunchResult(problems=["agent-1 died"], landed_by_operator=True), "failed"),
        (LaunchResult(landed_by_operator=True), "interrupted"),
        (LaunchResult(problems=["not landed"], interrupted=True), "interrupted"),
    ],
)
def test_a_flight_has_failed_by_what_went_wrong_whoever_has_landed_the_rest(result: LaunchResult, outcome: str) -> None:
    assert result.outcome == outcome


def test_a_launch_tells_verbs_its_clock_again_where_it_was_corrected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    now_ns, stepped_ns = 0, 0
    part = SwarmPart(run="circle-1a", agents=(0,))
    launcher = Launcher(Config(), LaunchOptions(), cast(ReservedPorts, None), tmp_path, part=part)
    launcher.clock = WallClock(lambda: now_ns, lambda: now_ns + 10**15 + stepped_ns)
    launcher.announce("")
    told_us = []
    stepped_ns = 30 * 10**9
    for elapsed_s in (0, 5, 20):
        now_ns = elapsed_s * 10**9
        launcher.announce_clock()
        told_us.append(find_launch(str(tmp_path)).utc_ahead_us)
    launcher.display.close()
    assert told_us == [10**12, 10**12, 10**12 + 200_000], "1 % of the time that has passed, in steps of 0.1 s"


def test_a_launch_holds_its_folder_until_its_agents_have_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two that begin at once in one folder the second is refused, and leaves no port bound."""
    released = []
    reserved = ReservedPorts(sockets=(), ports=(), view_port=0)
    monkeypatch.setattr(launching, "inspect", lambda *_: reserved)
    monkeypatch.setattr(ReservedPorts, "release", lambda _: released.append(1))
    monkeypatch.setattr(Launcher, "start", lambda _: None)
    options, part = LaunchOptions(tmp_path / "run"), SwarmPart(run="x", agents=(0,))
    with launching.started(Config(), options, part):
        (tmp_path / "run" / "launch.events.jsonl").unlink(missing_ok=True)  # as before it is written
        with pytest.raises(ConfigError, match="another run has just begun"), launching.started(Config(), options, part):
            raise AssertionError("it flew")
        assert released, "the ports of the one that was refused"
