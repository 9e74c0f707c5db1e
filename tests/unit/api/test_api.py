"""The Python API without a flight: quick import, configurations, runs from folders, refusals."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest

import swarmctl
from swarmctl.api import flight
from swarmctl.api.flight import Swarm, _numbers
from swarmctl.api.flight_process import FlightProcess
from swarmctl.bus.messages.json_messages import CommandMessage, decode_command, encode_message
from swarmctl.config import Config, dump, load
from swarmctl.core.operator_verbs import Order
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError
from swarmctl.ops.orders import operator
from swarmctl.ops.orders.order_delivery import Reply
from swarmctl.ops.running_launches import LAUNCH_FILE, RunningLaunch
from tests import builders
from tests.unit.ops.test_cli import HEAVY
from tests.unit.telemetry.test_hostile_run_folder import REFUSED


@pytest.fixture
def folder(finished_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def test_importing_the_package_imports_nothing_heavy_and_has_every_name() -> None:
    code = f"import sys, swarmctl; print([m for m in {HEAVY!r} if m in sys.modules])\n"
    code += "assert [getattr(swarmctl, name) for name in dir(swarmctl)]"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"
    with pytest.raises(AttributeError, match="no attribute 'lanch'"):
        _ = swarmctl.lanch  # type: ignore[attr-defined]


def test_type_checkers_are_told_every_name() -> None:
    declared = (Path(swarmctl.__file__).with_suffix(".pyi")).read_text()
    assert all(f" import {name} as {name}\n" in declared for name in swarmctl._OWNERS)  # type: ignore[attr-defined]
    assert Path(swarmctl.__file__).with_name("py.typed").exists()


_READ = """
import os, sys
import pyarrow.parquet
import sitl.studies.campaign.store as store
import swarmctl
before = len(os.listdir("/proc/self/task"))
run = swarmctl.load_run(sys.argv[1])
assert len(run.ticks(0)) and len(run.true_states()) and run.plans(0) is not None
store._read(run.folder / "truth.parquet", run.true_states().column_names)
print(len(os.listdir("/proc/self/task")) - before)
"""


def test_reading_a_run_starts_no_threads(folder: Path) -> None:
    """With Arrow's, a script that ended soon after was aborted, exit code 134, one time in six."""
    done = subprocess.run([sys.executable, "-c", _READ, str(folder)], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.returncode) == ("0\n", 0), done.stderr


def load_again(config: Config) -> Config:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.toml"
        path.write_text(dump(config))
        return swarmctl.load(path)


def test_values_are_set_as_python_has_them() -> None:
    config = swarmctl.load(
        set={"swarm.agents": 2, "start.center_ned_m": np.array([0.0, 1.0, -2.0]), "mission.duration_s": np.float64(5.0)}
    )
    assert (config.swarm.agents, config.start.center_ned_m) == (2, (0.0, 1.0, -2.0))
    circle = {"center_ned_m": np.array([0.0, 1.0, -2.0]), "radius_m": np.float32(3.0)}
    config = swarmctl.load(set={"mission.circle": circle, "controller.own": {"gains": np.array([1.0, 2.0])}})
    assert config.controller.own == {"gains": [1.0, 2.0]} and load_again(config) == config
    with pytest.raises(swarmctl.ConfigError) as caught:
        swarmctl.load(set={"swarm.agents": 2.5, "swarm.agent": 1, "name": 3})
    assert len(caught.value.problems) == 3
    with pytest.raises(swarmctl.ConfigError, match="write it as key"):
        swarmctl.load(set={"swarm..agents": 1})
    with pytest.raises(swarmctl.ConfigError, match="no such file"):
        swarmctl.load("nowhere.toml")


@pytest.mark.parametrize("wrong", [["swarm.agents=5"], "swarm.agents=5"])
def test_values_that_have_no_keys_are_refused_in_words(wrong: Any) -> None:
    with pytest.raises(ConfigError, match=r"give values by dotted key, as \{'swarm\.agents': 5\}"):
        swarmctl.load(set=wrong)


@pytest.mark.parametrize("fly", [swarmctl.simulate, swarmctl.launch])
def test_a_file_in_the_place_of_a_configuration_is_refused_in_words(fly: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"give what swarmctl\.load returns, as swarmctl\.load\('swarm\.toml'\)"):
        fly("swarm.toml", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_has_names_and_units(finished_run: Path) -> None:
    run = swarmctl.load_run(str(finished_run))
    assert (run.agents, run.outcome, run.violations) == ((0, 1, 2), "completed", [])
    assert run.summary == json.loads((finished_run / "summary.json").read_text())
    assert run.config == Config()
    ticks, rows = run.ticks(1), run.tick_rows(1)
    assert ticks["phase"].to_pylist() == [Phase(number).name for number in rows["phase"]]
    assert ticks.schema.field("vel_ned_m_s_x").metadata[b"unit"] == b"m/s"
    np.testing.assert_array_equal(ticks["pos_ned_m_z"].to_numpy(), rows["pos_ned_m"][:, 2])
    assert len(run.true_rows()) == 3 * len(run.true_rows(2)) == 3 * run.true_states(2).num_rows
    assert set(run.true_states()["landed"].to_pylist()) == {"UNKNOWN"}
    assert [event["source"] for event in run.events] == ["agent-0", "agent-1", "agent-2"]
    with pytest.raises(KeyError, match="agent 3 has recorded no ticks"):
        run.ticks(3)


def test_a_number_without_a_name_stays_a_number(folder: Path) -> None:
    run = swarmctl.load_run(folder)
    run.tick_rows(0)["mode"][5] = 77
    assert run.ticks(0)["mode"][5].as_py() == "77"


SPOILT = (  # one of each kind; tests/unit/telemetry/test_hostile_run_folder.py has all of them, with the same reader
    "summary torn",
    "agents = 1e9",
    "Parquet torn",
    "ticks of 10,000 years",
    "truth torn",
    "events.jsonl of 1 TB",
    "pipe as config.toml",
    "device as truth.parquet",
)


@pytest.mark.parametrize("spoil", [REFUSED[kind][0] for kind in SPOILT], ids=SPOILT)
@pytest.mark.timeout(60)
def test_a_spoilt_folder_is_refused_in_one_line(folder: Path, spoil: Callable[[Path], Any]) -> None:
    spoil(folder)
    with pytest.raises(swarmctl.ConfigError) as caught:
        swarmctl.load_run(folder)
    assert len(caught.value.problems) == 1
    assert str(folder) in str(caught.value)


def test_a_folder_that_is_not_finished_says_what_to_do(folder: Path, tmp_path: Path) -> None:
    (folder / "summary.json").unlink()
    with pytest.raises(swarmctl.ConfigError, match="swarmctl report"):
        swarmctl.load_run(folder)
    (folder / "config.toml").unlink()
    with pytest.raises(swarmctl.ConfigError, match="is no run folder"):
        swarmctl.load_run(folder)
    with pytest.raises(swarmctl.ConfigError, match="no such run folder"):
        swarmctl.load_run(tmp_path / "nowhere")


def test_what_was_not_flown_raises_the_words_of_the_command_line(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(swarmctl.ConfigError, match="holds a run already"):
        swarmctl.simulate(Config(), folder)
    real = swarmctl.load(
        set={"sitl.enabled": False, "swarm.agents": 1, "vehicles": [{"sysid": 1, "url": "serial:///dev/none:57600"}]}
    )
    with pytest.raises(swarmctl.StartError, match="/dev/none"):
        swarmctl.launch(real, tmp_path / "new")


def test_an_order_that_does_not_exist_or_comes_too_late_is_refused(tmp_path: Path) -> None:
    process = FlightProcess("launch", tmp_path, "swarmctl", "--version")
    process.wait(60)
    swarm = swarmctl.Swarm(Config(), tmp_path, process)
    with pytest.raises(swarmctl.ConfigError, match="known are hold"):
        swarm.order("jump")
    with pytest.raises(swarmctl.ConfigError, match="takes no arguments"):
        swarm.order("hold", height_m=1.0)
    with pytest.raises(swarmctl.StartError, match="has ended"):
        swarm.hold()


def test_waiting_has_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator, "_CONNECT_MS", 100)  # for a router that is not there
    process = FlightProcess("launch", tmp_path, "tests.benches.until_interrupted")
    until_s = time.monotonic() + 20.0
    while "running" not in (tmp_path / "launch.log").read_text():
        assert time.monotonic() < until_s
        time.sleep(0.02)
    with pytest.raises(TimeoutError, match="still flies after"):
        process.wait(0.2)
    swarm = swarmctl.Swarm(Config(), tmp_path, process)
    with pytest.raises(swarmctl.StartError, match="still flies"):
        _ = swarm.run
    ending = RunningLaunch("circle-1a", "unixsock-stream//x", 1, 0.0, 3, str(tmp_path), ending=True)
    (tmp_path / LAUNCH_FILE).write_bytes(msgspec.json.encode(ending))
    with pytest.raises(swarmctl.StartError, match="is ending"):
        swarm.status()
    with pytest.raises(swarmctl.StartError, match="is ending"):
        swarm.hold()
    with swarm:
        pass
    assert not swarm.is_flying, "the end of the block has asked it to land, and waited"


@pytest.mark.parametrize(
    ("agents", "numbers"),
    [(None, []), (1, [1]), ([2, 0], [2, 0]), (np.int64(0), [0]), (np.array([0, 2]), [0, 2]), (range(2), [0, 1])],
)
def test_agents_are_named_by_any_whole_numbers(agents: Any, numbers: list[int]) -> None:
    assert _numbers(agents) == numbers


@pytest.mark.parametrize("agents", [[], (), np.array([]), True, [True], 1.0, [1.5], "1", [[0]]])
def test_what_names_no_agent_is_refused_and_never_all(agents: Any) -> None:
    with pytest.raises(ConfigError, match="agents: "):
        _numbers(agents)


def test_phases_and_points_that_are_none_are_refused_in_words(tmp_path: Path) -> None:
    process: Any = None
    swarm = Swarm(Config(), tmp_path, process)
    with pytest.raises(ConfigError, match="'track' is no phase; those are CONNECT, STANDBY,"):
        swarm.wait_for("track")
    with pytest.raises(ConfigError, match=r"point_ned_m = \(1, 2\): expected three numbers: north_m, east_m, down_m"):
        swarm.goto(0, (1, 2))


@pytest.fixture
def orders(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """Have orders of a swarm end up here, as they would be on the bus."""
    sent: list[bytes] = []

    def take(note: None, order: Order, agents: Sequence[int]) -> list[Reply]:
        sent.append(encode_message(CommandMessage(order.verb, 0, 1, dict(order.arguments))))
        return []

    monkeypatch.setattr(Swarm, "_note", lambda _: None)
    monkeypatch.setattr(flight, "deliver", take)
    return sent


def flying(tmp_path: Path) -> Swarm:
    process: Any = SimpleNamespace(is_running=True)
    return Swarm(load(None, ["swarm.agents=2"]), tmp_path, process)


@pytest.mark.parametrize(
    "number", [1, 1.0, np.float64(1.0), np.float32(1.0), np.int64(1)], ids=lambda n: type(n).__name__
)
def test_orders_take_numbers_of_numpy(number: Any, orders: list[bytes], tmp_path: Path) -> None:
    swarm, point = flying(tmp_path), cast(Any, np.array([1.0, 2.0, -3.0]))
    swarm.goto(cast(Any, np.int64(1)), point, yaw_deg=number, speed_m_s=number)
    swarm.order("goto", 0, north_m=number, east_m=number, down_m=number)
    for message in orders:
        assert decode_command(message) is not None
    assert len(orders) == 2


@pytest.mark.parametrize("wrong", [True, np.bool_(True), "90", b"90", [90.0], np.array([90.0])], ids=repr)
def test_an_order_with_something_else_than_a_number_is_refused(wrong: Any, orders: list[bytes], tmp_path: Path) -> None:
    swarm = flying(tmp_path)
    with pytest.raises(ConfigError, match=r"yaw_deg = .*: expected a number"):
        swarm.goto(0, (1.0, 2.0, -3.0), yaw_deg=wrong)
    with pytest.raises(ConfigError, match=r"down_m = .*: expected a number"):
        swarm.goto(0, (1.0, 2.0, wrong))
    assert orders == []


@pytest.mark.parametrize("nobody", [None, [0, 1], [0], (), "0", 0.5, True], ids=repr)
def test_one_agent_alone_is_sent_to_a_point(nobody: Any, orders: list[bytes], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected"):
        flying(tmp_path).goto(nobody, (1.0, 2.0, -3.0))
    assert orders == []


def test_who_has_landed_and_ended_has_reached_every_phase(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    process: Any = SimpleNamespace(is_running=True)
    swarm = Swarm(load(None, ["swarm.agents=2"]), tmp_path, process)
    told = builders.status_message(agent=1, phase=int(Phase.LAND))
    monkeypatch.setattr(Swarm, "_note", lambda _: None)
    monkeypatch.setattr(flight, "read_agents", lambda _: ({1: told}, frozenset((0,))))
    swarm.wait_for("LAND", 0.0)
    with pytest.raises(TimeoutError, match="not all agents have reached DONE"):
        swarm.wait_for("DONE", 0.0)


def test_a_launch_that_is_interrupted_while_it_starts_is_landed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C reaches the script, and not the launch, which has a session of its own."""
    asked = list[str]()

    def interrupted(swarm: Swarm) -> None:
        raise KeyboardInterrupt

    process = SimpleNamespace(interrupt=lambda: asked.append("land"), wait=lambda: asked.append("wait"))
    monkeypatch.setattr(flight, "FlightProcess", lambda *_: process)
    monkeypatch.setattr(Swarm, "wait_for_start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        flight.launch(Config(), tmp_path / "run")
    assert asked == ["land", "wait"]
