"""Tests of runs exported as MCAP, read back by libraries that have not written them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from swarmctl.api.run import load_run
from swarmctl.bus.messages.json_messages import first_list
from swarmctl.config import Config, dump
from swarmctl.configuration.sections import SwarmParams
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import PLAN_COLUMNS, PLAN_DTYPE, TICK_DTYPE
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.bundle import BundleOptions, bundle
from swarmctl.ops.export import export_mcap
from swarmctl.ops.flight.summary import unwritten_line
from swarmctl.telemetry.recording.obstacle_lists import recorded_list
from swarmctl.telemetry.recording.run_files import read_parquet, write_parquet
from swarmctl.telemetry.recording.run_folder import Outcome, compare_runs, finish_run
from swarmctl.telemetry.view.recordings import viewer_binary
from tests.benches.recorded_runs import UTC_US, write_run

MOVING = Obstacle(center_ned_m=(1.0, 2.0, -3.0), vel_ned_m_s=(0.5, 0.0, 0.0))
COLUMN = Obstacle(center_ned_m=(4.0, 0.0, 0.0), column=True)
NED = np.array([1.0, 2.0, -3.0])  # 1 m north, 2 m east, 3 m up


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "flown"
    directory.mkdir()
    write_run(directory, 3, 3.0)
    config = Config(obstacles=(MOVING, COLUMN))
    (directory / "config.toml").write_text(dump(config))
    finish_run(directory, config.rules(), Outcome(outcome="completed"))
    return directory


@pytest.fixture(scope="module")
def path(folder: Path) -> Path:
    return export_mcap(folder, None)


def test_a_file_of_the_run_is_not_written_over(folder: Path) -> None:
    before = (folder / "config.toml").read_bytes()
    with pytest.raises(ConfigError, match="is a file of the run"):
        export_mcap(folder, folder / "config.toml")
    with pytest.raises(ConfigError, match="is a file of the run"):
        bundle(BundleOptions(folder=folder, output=folder / "config.toml"))
    with pytest.raises(ConfigError, match="is a file of the run"):
        compare_runs(folder / "config.toml", [(folder, Config().rules())] * 2)
    assert (folder / "config.toml").read_bytes() == before


def test_a_file_dated_before_1980_is_bundled(folder: Path, tmp_path: Path) -> None:
    """A computer without a battery for its clock begins in 1970."""
    os.utime(folder / "events.jsonl", (0, 0))
    written = bundle(BundleOptions(folder=folder, output=tmp_path / "run.zip")).path
    assert f"{folder.name}/events.jsonl" in zipfile.ZipFile(written).namelist()


def test_what_can_not_be_bundled_is_refused_in_words(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(StartError, match=r"run\.zip: its folder does not exist\. Choose another with --output"):
        bundle(BundleOptions(folder=folder, output=tmp_path / "none" / "run.zip"))
    odd = Path(os.fsdecode(os.fsencode(shutil.copytree(folder, tmp_path / "odd")) + b"/\xff.txt"))
    odd.write_text("")
    with pytest.raises(StartError, match="is not UTF-8, and can't be in an archive"):
        bundle(BundleOptions(folder=tmp_path / "odd", output=tmp_path / "run.zip"))


def test_a_file_that_vanishes_while_it_is_bundled_is_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A launch that ends packs and removes what agents have written."""
    ticks = folder / "agent-0.ticks"
    ticks.write_bytes(b"")

    def versions() -> dict[str, str]:
        ticks.unlink()
        return {}

    monkeypatch.setattr("swarmctl.ops.bundle._versions", versions)
    with pytest.raises(StartError, match=r"agent-0\.ticks: has vanished"):
        bundle(BundleOptions(folder=folder, output=tmp_path / "run.zip"))
    assert list(tmp_path.iterdir()) == []


def test_an_export_that_is_terminated_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(folder, tmp_path / "flown")
    code = "import os, signal, sys, time\nfrom pathlib import Path\nimport swarmctl.ops.export as export\n"
    code += "from swarmctl.files import replaced\ndef write(path, recorded):\n    with replaced(path) as file:\n"
    code += "        os.kill(os.getpid(), signal.SIGTERM)\n        time.sleep(5)\n"
    code += "export.write_mcap = write\nexport.export_mcap(Path(sys.argv[1]), None)"
    done = subprocess.run([sys.executable, "-c", code, str(copy)], capture_output=True, timeout=60, check=False)
    assert done.returncode != 0
    assert [path.name for path in tmp_path.iterdir()] == ["flown"]


def test_advice_can_be_pasted_into_a_shell_whatever_the_folder_is_called(tmp_path: Path) -> None:
    spaced = tmp_path / "kl e x"
    spaced.mkdir()
    (spaced / "config.toml").write_text(dump(Config()))
    with pytest.raises(ConfigError, match="kl e x'"):
        export_mcap(spaced, None)
    with pytest.raises(ConfigError, match="kl e x'"):
        load_run(spaced)
    assert unwritten_line(spaced, ["report.html: No space"]).endswith(f"swarmctl report '{spaced}'")


def test_events_of_a_station_are_exported_by_its_clock(folder: Path, tmp_path: Path) -> None:
    directory, hour_us = shutil.copytree(folder, tmp_path / "station"), 3_600_000_000
    rows = read_parquet(directory / "agent-1.parquet")
    t_us, utc_us = int(rows["t_us"][0]), int(rows["utc_us"][0])
    rows["utc_us"] += hour_us
    write_parquet(directory / "agent-1.parquet", rows)
    events = [{"utc_us": utc_us, "t_us": t_us, "source": "launch", "event": "started", "agents": []}]
    events += [
        {"utc_us": utc_us, "source": "launch", "event": "sender_clock", "agent": k, "behind_us": 0} for k in range(3)
    ]
    events.append(
        {"utc_us": utc_us + hour_us + 5, "t_us": t_us, "source": "agent-1", "event": "operator", "verb": "hold"}
    )
    (directory / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    (time_ns,) = [at_ns for at_ns, log in messages(export_mcap(directory, None), "/events") if log.name == "agent-1"]
    assert time_ns == (utc_us + 5) * 1000


def test_true_states_and_predicted_paths_follow_a_clock_that_was_set_in_flight(folder: Path, tmp_path: Path) -> None:
    """As on a computer that has begun in 1970: its UTC gains 1 % on the true states, 6 s in ten minutes."""
    directory = shutil.copytree(folder, tmp_path / "set")
    rows = read_parquet(directory / "agent-0.parquet")
    rows["utc_us"] += (rows["t_us"] - rows["t_us"][0]) // 100
    write_parquet(directory / "agent-0.parquet", rows)
    plans = np.zeros(2 * len(rows), PLAN_DTYPE)
    plans["t_us"] = np.repeat(rows["t_us"], 2)
    write_parquet(directory / "agent-0.plans.parquet", plans, PLAN_COLUMNS)
    path = export_mcap(directory, None)
    at_ns = {topic: [time_ns for time_ns, _ in messages(path, topic)] for topic in ("/agent/0/tick", "/truth/0")}
    assert at_ns["/truth/0"] == at_ns["/agent/0/tick"]
    drawn_ns = [at_ns for at_ns, scene in messages(path, "/scene") if [e.id for e in scene.entities] == ["plan-0"]]
    assert len(drawn_ns) > 20
    assert set(drawn_ns) <= set(at_ns["/agent/0/tick"])


def test_the_summary_is_attached_as_it_is(folder: Path, path: Path) -> None:
    with path.open("rb") as file:
        attached = {attachment.name: attachment.data for attachment in make_reader(file).iter_attachments()}
    assert attached["summary.json"] == (folder / "summary.json").read_bytes()
    assert "commitments" in json.loads(attached["summary.json"])


def messages(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Return the messages of a topic with their times [ns], decoded by the schemas that are in the file."""
    found = []
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(topics=[topic]):
            assert schema is not None
            if channel.message_encoding == "json":
                found.append((message.log_time, json.loads(message.data)))
            else:
                pool = descriptor_pool.DescriptorPool()
                for described in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(described)
                kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                found.append((message.log_time, kind.FromString(message.data)))
    return found


def test_it_is_written_beside_the_run_and_holds_its_configuration_and_judgement(folder: Path, path: Path) -> None:
    assert path == folder.parent / "flown.mcap"
    with path.open("rb") as file:
        attached = {attachment.name: attachment.data for attachment in make_reader(file).iter_attachments()}
    assert attached["config.toml"].decode() == dump(load_run(folder).config)
    assert json.loads(attached["summary.json"])["outcome"] == load_run(folder).outcome


def test_every_recorded_value_is_there_with_unit_and_words(folder: Path, path: Path) -> None:
    rows = load_run(folder).tick_rows(1)
    ticks = messages(path, "/agent/1/tick")
    assert [time_ns for time_ns, _ in ticks] == (rows["utc_us"] * 1000).tolist()
    names = {column.name for column in COLUMNS}
    assert set().union(*(tick for _, tick in ticks)) <= names
    k = len(rows) // 2
    assert ticks[k][1]["pos_ned_m"] == dict(zip("xyz", rows["pos_ned_m"][k].tolist(), strict=True))
    assert ticks[k][1]["phase"] == Phase(int(rows["phase"][k])).name
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schema = next(s for s in summary.schemas.values() if s.name == "swarmctl.agent.1.tick")
    described = json.loads(schema.data)["properties"]
    assert described.keys() == names
    assert described["solve_ms"]["description"].endswith("[ms]")
    assert described["phase"]["type"] == "string"


def test_ticks_of_a_station_are_at_the_time_by_its_clock(tmp_path: Path) -> None:
    write_run(tmp_path, 1, 1.0)
    (tmp_path / "truth.bin").unlink()
    config = Config(swarm=SwarmParams(agents=1))
    (tmp_path / "config.toml").write_text(dump(config))
    noted = (
        {"event": "started", "agents": [], "t_us": 5_000, "utc_us": UTC_US},
        {"event": "sender_clock", "agent": 0, "behind_us": 300_000, "t_us": 5_000, "utc_us": UTC_US},
    )
    (tmp_path / "launch.events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in noted))
    finish_run(tmp_path, config.rules(), Outcome(outcome="failed"))
    first_us = int(load_run(tmp_path).tick_rows(0)["t_us"][0])
    assert messages(export_mcap(tmp_path, None), "/agent/0/tick")[0][0] == (first_us + 300_000 + UTC_US - 5_000) * 1000


def test_up_is_up_and_a_vehicle_is_where_it_was(folder: Path, path: Path) -> None:
    frames = messages(path, "/tf")
    root = next(frame for _, frame in frames if frame.parent_frame_id == "world")
    q = root.rotation
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(NED), [2.0, 1.0, 3.0], atol=1e-12)
    rows = load_run(folder).tick_rows(2)
    last = [frame for _, frame in frames if frame.child_frame_id == "agent-2"][-1]
    assert last.parent_frame_id == "ned"
    at = last.translation
    np.testing.assert_allclose([at.x, at.y, at.z], rows["pos_ned_m"][-1])
    turned = Rotation.from_quat([last.rotation.x, last.rotation.y, last.rotation.z, last.rotation.w])
    expected = Rotation.from_quat(rows["q_nb"][-1], scalar_first=True)
    assert (turned.inv() * expected).magnitude() < 1e-6


def test_vehicles_references_and_obstacles_are_drawn(path: Path) -> None:
    drawn = [(at_ns, entity) for at_ns, update in messages(path, "/scene") for entity in update.entities]
    names = {entity.id for _, entity in drawn}
    assert {f"{what}-{agent}" for what in ("agent", "reference") for agent in range(3)} <= names
    begin_ns = min(at_ns for at_ns, _ in drawn)
    moving = [(at_ns, entity) for at_ns, entity in drawn if entity.id == "obstacle-0"]
    at_ns, entity = moving[-1]
    moved_m = entity.spheres[0].pose.position.x - MOVING.center_ned_m[0]
    assert moved_m == pytest.approx(0.5 * (at_ns - begin_ns) * 1e-9, abs=1e-3)
    assert moved_m > 1.0
    assert next(entity for _, entity in drawn if entity.id == "obstacle-1").cylinders


def test_obstacles_and_goals_are_those_of_the_moment(tmp_path: Path) -> None:
    directory = tmp_path / "steered"
    directory.mkdir()
    write_run(directory, 2, 8.0)
    (directory / "config.toml").write_text(dump(Config(obstacles=(COLUMN,))))
    begin_us, moved = UTC_US + 5_000_000, COLUMN.model_copy(update={"center_ned_m": (9.0, 0.0, 0.0)})
    lists = [(1.0, (COLUMN,)), (3.0, (moved,)), (6.0, ())]
    rows = []
    for version, (at_s, obstacles) in enumerate(lists, 1):
        at_us = begin_us + round(at_s * 1e6)
        row = {"utc_us": at_us + 50_000, "source": "launch", "event": "obstacles"}  # the launch hears of it later
        rows.append(row | recorded_list(first_list(obstacles, at_us, version)))
    (directory / "launch.events.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    ticks = np.fromfile(directory / "agent-1.ticks", TICK_DTYPE)
    again = np.flatnonzero(ticks["phase"] == Phase.TRACK)[100:]
    ticks["mission_t_s"][again] -= ticks["mission_t_s"][again[0]]
    ticks["ref_pos_ned_m"][again] = NED
    ticks.tofile(directory / "agent-1.ticks")
    finish_run(directory, Config().rules(), Outcome(outcome="completed"))
    scene = messages(export_mcap(directory, None), "/scene")
    drawn = [(at_ns, entity) for at_ns, update in scene for entity in update.entities]
    there = [(at_ns, e.cylinders[0].pose.position.x) for at_ns, e in drawn if e.id == "obstacle-0"]
    assert there == [((begin_us + round(at_s * 1e6)) * 1000, x_m) for at_s, x_m in ((1.0, 4.0), (3.0, 9.0))]
    (gone,) = ((at_ns, deletion.id) for at_ns, update in scene for deletion in update.deletions)
    assert gone == ((begin_us + 6_050_000) * 1000, "obstacle-0")
    ((at_ns, goal),) = ((at_ns, e) for at_ns, e in drawn if e.id.startswith("goal-"))
    assert (at_ns, goal.id) == (int(ticks["utc_us"][again[0]]) * 1000, "goal-1")
    at = goal.spheres[0].pose.position
    np.testing.assert_allclose([at.x, at.y, at.z], NED)


def test_events_are_a_log_in_order_of_time(folder: Path, path: Path) -> None:
    logs = messages(path, "/events")
    assert len(logs) == len(load_run(folder).events)
    assert [at_ns for at_ns, _ in logs] == sorted(at_ns for at_ns, _ in logs)


def test_another_program_opens_it_and_finds_all_in_order(path: Path) -> None:
    checked = subprocess.run([viewer_binary(), "mcap", "check", path], capture_output=True, text=True, check=False)
    assert checked.returncode == 0
    assert "PROBLEM" not in checked.stdout
    assert checked.stdout.count("\nok") == 9  # of three agents: frames, scene, ticks, true states, events


def test_without_the_library_it_is_said_how_to_install_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(StartError, match=r"pip install '\.\[mcap\]'"):
        export_mcap(folder, None)


def test_a_folder_without_a_run_and_a_file_that_can_not_be_written_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        export_mcap(tmp_path, None)
    with pytest.raises(StartError, match=r"can't be written: .*\. Choose another with --output"):
        export_mcap(folder, tmp_path / "nowhere" / "run.mcap")
