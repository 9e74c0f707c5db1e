"""Tests that a run folder is unique, survives crashes and ends up complete."""

from __future__ import annotations

import errno
import json
import os
import re
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier, Event
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from swarmctl import __version__
from swarmctl.bus.messages.json_messages import first_list
from swarmctl.config import Config, dump
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.received import frame_rows, status_row
from swarmctl.core.recorded.records import PLAN_DTYPE, TICK_DTYPE, TRUTH_COLUMNS, TRUTH_DTYPE
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.types import ControlMode, FlightMode, Mode, Phase, PlanStatus
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import hold
from swarmctl.telemetry.evaluation.referee import Rules
from swarmctl.telemetry.recording import run_folder
from swarmctl.telemetry.recording.file_names import OUTCOME
from swarmctl.telemetry.recording.new_run_folder import create_run_folder, held_run, write_config
from swarmctl.telemetry.recording.obstacle_lists import recorded_list
from swarmctl.telemetry.recording.run_files import load_run, read_parquet, read_plans, read_received, write_parquet
from swarmctl.telemetry.recording.run_folder import Outcome, finish_run, report_run
from swarmctl.telemetry.report.thinning import thin
from tests.benches.pages import parsed
from tests.benches.recorded_runs import FAR_BALL, RULES, UTC_US, flight, write_run


def test_obstacles_that_an_operator_has_set_are_judged_and_drawn_also_later(tmp_path: Path) -> None:
    near = Obstacle(center_ned_m=(-2.0, 4.6, -1.4), radius_m=0.2, keep_out_m=1.0)  # where the circle is after 4 s
    for directory, changes in ((tmp_path / "plain", ()), (tmp_path / "set", ((1, ()), (2, (near,)), (3, ())))):
        directory.mkdir()
        write_run(directory, 3, 6.0)
        (directory / "config.toml").write_text(dump(Config()))
        rows = []
        for version, obstacles in changes:
            utc_us = UTC_US + 5_000_000 + version * 1_500_000  # there from 3 s to 4.5 s
            listed = recorded_list(first_list(obstacles, utc_us, version))
            rows.append({"utc_us": utc_us, "source": "launch", "event": "obstacles", **listed})
        (directory / "launch.events.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
        summary = finish_run(directory, RULES, Outcome(outcome="completed")).summary
        (directory / "report.html").unlink()
        page = report_run(directory, RULES).read_text()
        if changes:
            assert summary["obstacles"]["min_clearance_m"] < 0.95
            assert any("and obstacle 0" in text for text in summary["violations"])
        assert page.count('<circle class="obstacle"') == 1, "the one that was set, or the configured one"
        assert ("and obstacle 0" in page) is bool(changes)


def test_launches_in_the_same_second_get_folders_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: create_run_folder(None, "circle", UTC_US), range(20)))
    assert len(set(folders)) == 20
    assert all(folder.is_dir() and not any(folder.iterdir()) for folder in folders)
    assert Path("runs/20260528T202640Z-circle") in folders


def test_a_given_folder_is_used_once(tmp_path: Path) -> None:
    folder = create_run_folder(tmp_path / "a" / "b", "circle", UTC_US)
    assert folder == tmp_path / "a" / "b"
    (folder / "console.log").write_text("")
    create_run_folder(folder, "circle", UTC_US)
    (folder / "agent-0.ticks").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"holds a run already \(agent-0.ticks\)"):
        create_run_folder(folder, "circle", UTC_US)


@pytest.mark.parametrize("within", ["", "run0"])
def test_a_folder_that_is_a_file_is_refused_as_a_wrong_option(tmp_path: Path, within: str) -> None:
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(ConfigError, match="is a file, or within one"):
        create_run_folder(tmp_path / "notes" / within, "a", 0)
    assert (tmp_path / "notes").read_text() == "mine"


def test_folder_that_cannot_be_made_is_a_start_error(tmp_path: Path) -> None:
    with pytest.raises(StartError, match="--run-dir"):
        create_run_folder(tmp_path / ("n" * 300), "circle", UTC_US)


def test_parquet_gives_back_every_column(tmp_path: Path) -> None:
    rows, _ = flight(1, 3, 6.0)
    write_parquet(tmp_path / "agent-1.parquet", rows)
    again = read_parquet(tmp_path / "agent-1.parquet")
    for name in TICK_DTYPE.names or ():
        np.testing.assert_array_equal(again[name], rows[name], err_msg=name)


def test_parquet_says_unit_meaning_and_version(tmp_path: Path) -> None:
    write_parquet(tmp_path / "agent-1.parquet", flight(1, 3, 6.0)[0])
    schema = pq.read_schema(tmp_path / "agent-1.parquet")
    assert schema.metadata[b"swarmctl_version"].decode() == __version__
    told = schema.field("ref_pos_ned_m_y").metadata
    assert told == {b"unit": b"m", b"description": b"the mission's reference now", b"entity": b"world/reference/{}"}
    assert [field.name for field in schema] == [part for column in COLUMNS for part in column.parts]
    assert all(field.metadata[b"description"] for field in schema)
    named = {"phase": Phase, "mode": Mode, "flight_mode": FlightMode, "plan_status": PlanStatus, "control": ControlMode}
    for field in schema:
        said = {b"unit", b"description", b"entity"} | ({b"names"} if field.name in named else set())
        assert set(field.metadata) == said
    for name, kind in named.items():
        assert json.loads(schema.field(name).metadata[b"names"]) == {str(int(member)): member.name for member in kind}


def test_true_states_become_parquet_with_units_and_names(tmp_path: Path) -> None:
    write_run(tmp_path, 3, 6.0)
    raw = load_run(tmp_path).truth
    finish_run(tmp_path, RULES, Outcome(outcome="completed"))
    assert not (tmp_path / "truth.bin").exists()
    np.testing.assert_array_equal(load_run(tmp_path).truth, raw)
    schema = pq.read_schema(tmp_path / "truth.parquet")
    assert [field.name for field in schema] == [part for column in TRUTH_COLUMNS for part in column.parts]
    assert schema.field("vel_ned_m_s_z").metadata[b"unit"] == b"m/s"
    assert json.loads(schema.field("landed").metadata[b"names"])["1"] == "ON_GROUND"


def test_predicted_paths_become_parquet(tmp_path: Path) -> None:
    write_run(tmp_path, 3, 6.0)
    points = np.zeros(82, PLAN_DTYPE)
    points["t_us"] = np.repeat([0, 100_000], 41)
    points["at_us"] = points["t_us"] + np.tile(np.arange(41) * 50_000, 2)
    points["pos_ned_m"] = np.arange(82 * 3).reshape(82, 3)
    points.tofile(tmp_path / "agent-1.plans")
    np.testing.assert_array_equal(read_plans(tmp_path, 1), points)
    finish_run(tmp_path, RULES, Outcome(outcome="completed"))
    assert not (tmp_path / "agent-1.plans").exists()
    np.testing.assert_array_equal(read_plans(tmp_path, 1), points)
    assert len(read_plans(tmp_path, 0)) == 0
    assert sorted(load_run(tmp_path).ticks) == [0, 1, 2], "they are no ticks"
    assert pq.read_schema(tmp_path / "agent-1.plans.parquet").field("pos_ned_m_z").metadata[b"unit"] == b"m"
    (tmp_path / "agent-1.plans.parquet").write_bytes(b"PAR1")
    with pytest.raises(ConfigError, match=r"agent-1.plans.parquet"):
        read_plans(tmp_path, 1)


def test_what_ticks_have_received_becomes_parquet(tmp_path: Path) -> None:
    write_run(tmp_path, 3, 6.0)
    rows = b"".join([*frame_rows(20_000, 1, [15_000, 19_000]), status_row(20_000, 2, 7, 9_000, keeps_up=True)])
    (tmp_path / "agent-1.received").write_bytes(rows)
    finish_run(tmp_path, RULES, Outcome(outcome="completed"))
    assert not (tmp_path / "agent-1.received").exists()
    assert read_received(tmp_path, 1).tobytes() == rows
    assert len(read_received(tmp_path, 0)) == 0
    assert sorted(load_run(tmp_path).ticks) == [0, 1, 2], "they are no ticks"


def test_raw_true_states_replace_packed_ones(tmp_path: Path) -> None:
    """As raw ticks do: an unfinished packing leaves both."""
    write_run(tmp_path, 3, 6.0)
    raw = (tmp_path / "truth.bin").read_bytes()
    finish_run(tmp_path, RULES, Outcome(outcome="completed"))
    (tmp_path / "truth.bin").write_bytes(raw[: 4 * TRUTH_DTYPE.itemsize])
    assert len(load_run(tmp_path).truth) == 4


def rewrite(path: Path, keep: Callable[[str], str]) -> None:
    """Rename the columns of a recording; those that `keep` gives no name are left out."""
    table = pq.read_table(path)
    names = {name: keep(name) for name in table.column_names if keep(name)}
    renamed = table.select(list(names)).rename_columns(list(names.values()))
    pq.write_table(renamed.replace_schema_metadata(table.schema.metadata), path)


def test_what_an_older_recording_lacks_is_no_zero(tmp_path: Path) -> None:
    path, (rows, _) = tmp_path / "agent-1.parquet", flight(1, 3, 6.0)
    write_parquet(path, rows)
    rewrite(path, lambda name: "" if name.startswith(("vel_ned_m_s", "solve_ms")) else name)
    old = read_parquet(path)
    assert np.isnan(old["vel_ned_m_s"]).all()
    assert np.isnan(old["solve_ms"]).all()
    np.testing.assert_array_equal(old["pos_ned_m"], rows["pos_ned_m"])
    rewrite(path, lambda name: "" if name == "phase" else name)
    with pytest.raises(ConfigError, match=f"column phase is missing .written by swarmctl {__version__}"):
        read_parquet(path)


@pytest.mark.parametrize("more", ["<f4", "u1", "<f8"])
def test_raw_rows_of_another_layout_are_refused(tmp_path: Path, more: str) -> None:
    rows, _ = flight(0, 1, 6.0)
    columns: list[tuple[str, Any]] = [(name, rows.dtype[name]) for name in rows.dtype.names or ()]
    other = np.zeros(len(rows), np.dtype([*columns, ("x", more)]))
    for name in rows.dtype.names or ():
        other[name] = rows[name]
    other.tofile(tmp_path / "agent-0.ticks")
    with pytest.raises(ConfigError, match="or raw rows of another version"):
        load_run(tmp_path)


# Columns of the first recordings: what was added later must be readable without.
FIRST = {"t_us", "utc_us", "seq", "mission_t_s", "phase", "mode", "flight_mode", "armed", "state_age_ms", "pos_ned_m"}
FIRST |= {"vel_ned_m_s", "q_nb", "ref_pos_ned_m", "setpoint_q_nb", "setpoint_thrust_01", "hover_thrust_01", "peers"}
FIRST |= {"disturbance_ned_m_s2", "nearest_peer_m", "nearest_obstacle_m", "path_age_ms", "rejected", "plan_status"}
FIRST |= {"slack_m", "residual_m", "iterations", "solve_ms", "tick_ms", "late_ticks"}


def test_the_first_recordings_stay_readable(tmp_path: Path) -> None:
    path, (rows, _) = tmp_path / "agent-1.parquet", flight(1, 3, 6.0)
    rows["deadline_misses"] = np.arange(len(rows))
    rows["safety_filter_acted"] = 1
    write_parquet(path, rows)
    old_names = {column.name: column.formerly or column.name for column in COLUMNS}
    first = {p: p.replace(c.name, old_names[c.name]) for c in COLUMNS for p in c.parts if old_names[c.name] in FIRST}
    rewrite(path, lambda name: first.get(name, ""))
    old = read_parquet(path)
    for column in COLUMNS:
        if old_names[column.name] in FIRST:
            np.testing.assert_array_equal(old[column.name], rows[column.name], err_msg=column.name)
        elif column.absent is None:
            assert np.isnan(old[column.name]).all(), column.name
    assert not old["safety_filter_acted"].any(), "they were flown without the filter"


def test_partial_rows_and_lines_are_ignored(tmp_path: Path) -> None:
    write_run(tmp_path, 2, 5.0)
    whole = load_run(tmp_path)
    for name in ("agent-0.ticks", "truth.bin", "agent-1.events.jsonl"):
        with (tmp_path / name).open("ab") as file:
            file.write(b'{"utc_us": 1')
    again = load_run(tmp_path)
    assert len(again.ticks[0]) == len(whole.ticks[0])
    assert len(again.truth) == len(whole.truth)
    assert again.events == whole.events


def test_a_missing_folder_is_refused_with_a_reason(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such run folder"):
        load_run(tmp_path / "nowhere")


def test_finished_run_is_complete_and_may_be_finished_again(tmp_path: Path) -> None:
    write_run(tmp_path, 3, 20.0)
    own = ({"utc_us": UTC_US - 1, "t_us": -1, "source": "launch", "event": "started"},)
    summary, unwritten = finish_run(tmp_path, RULES, Outcome(outcome="completed", events=own))
    assert unwritten == ()
    assert summary["outcome"] == "completed", summary["violations"]
    assert summary["version"] == __version__
    assert summary["tracking"]["index_m"] == pytest.approx(3 * 0.6)
    assert summary["separation"]["min_m"] == pytest.approx(0.6 * np.sqrt(3))
    names = {path.name for path in tmp_path.iterdir()}
    parquets = {f"agent-{agent}.parquet" for agent in range(3)}
    assert names == parquets | {"truth.parquet", "config.toml", "events.jsonl", "summary.json", "report.html"}
    sources = [json.loads(line)["source"] for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert sources == ["launch", "agent-0", "agent-1", "agent-2"]
    assert finish_run(tmp_path, RULES, Outcome(outcome="completed", events=own)) == (summary, ())
    assert len((tmp_path / "events.jsonl").read_text().splitlines()) == 4
    assert json.loads((tmp_path / "summary.json").read_text()) == summary


def test_report_of_a_run_that_is_still_recorded_leaves_its_files(tmp_path: Path) -> None:
    """The launcher may have died while its agents land."""
    write_run(tmp_path, 3, 6.0)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for name in ("agent-1.ticks", "agent-1.events.jsonl", "truth.bin"):
        with (tmp_path / name).open("ab") as file:
            hold(file.fileno())
            with pytest.raises(StartError, match=rf"{name}: is still written"):
                report_run(tmp_path, RULES)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert report_run(tmp_path, RULES).exists()
    with (tmp_path / "agent-1.ticks").open("ab") as file:
        hold(file.fileno())
        assert report_run(tmp_path, RULES).exists(), "nothing of a finished run is packed"


def test_report_of_a_run_whose_launcher_died_says_so(tmp_path: Path) -> None:
    write_run(tmp_path, 3, 6.0)
    assert report_run(tmp_path, RULES).exists()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["outcome"] == "failed"
    assert summary["violations"] == ["the launcher did not finish this run"]


def test_of_runs_that_begin_at_once_in_one_folder_one_alone_flies(tmp_path: Path) -> None:
    """Each has found it empty; all flew, and wrote over each other's files."""
    folder = create_run_folder(tmp_path / "run", "x", 0)
    write_config(folder, "", "lockstep")
    assert create_run_folder(folder, "x", 0) == folder, "as by a script, which has a launch fly what it has written"
    everybody, refused = Barrier(4), Event()

    def fly(_: int) -> str:
        found = create_run_folder(folder, "x", 0)
        everybody.wait(10.0)
        try:
            with held_run(found):
                write_config(found, "", "lockstep")
                refused.wait(10.0)
        except ConfigError as error:
            said.append(str(error))
            return "refused"
        return "flew"

    said: list[str] = []
    with ThreadPoolExecutor(4) as pool:
        ends = [pool.submit(fly, number) for number in range(4)]
        while sum(end.done() for end in ends) < 3:
            time.sleep(0.005)
        with pytest.raises(ConfigError, match="another run has just begun there"):
            create_run_folder(folder, "x", 0)
        refused.set()
    assert sorted(end.result() for end in ends) == ["flew", "refused", "refused", "refused"]
    assert set(said) == {f"--run-dir {folder}: another run has just begun there. Choose a new folder"}


@pytest.mark.parametrize("recorded", ["launch.events.jsonl", "agent-0.ticks", "summary.json"])
def test_who_comes_late_does_not_fly_into_the_folder_of_a_run_that_has_been(tmp_path: Path, recorded: str) -> None:
    """It had found the folder empty, and the other has let go of it."""
    folder = create_run_folder(tmp_path / "run", "x", 0)
    (folder / recorded).touch()
    with pytest.raises(ConfigError, match=rf"holds a run already \({re.escape(recorded)}\)"), held_run(folder):
        raise AssertionError("it flew")


def test_a_simulation_that_was_cut_off_is_judged_as_one(tmp_path: Path) -> None:
    """Programs tell simulations from flights by `mode`."""
    write_config(tmp_path, "", "lockstep")
    write_run(tmp_path, 3, 6.0)
    report_run(tmp_path, RULES)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["mode"] == "lockstep"
    assert summary["violations"] == ["the launcher did not finish this run"]


def full_disk(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("problems", [(), ("agent-1 failed: battery",), tuple(f"problem {k} " * 30 for k in range(40))])
def test_how_a_run_ended_is_known_once_there_is_room(
    problems: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_config(tmp_path, "")
    write_run(tmp_path, 3, 20.0)
    for path in tmp_path.glob("agent-*.ticks"):
        rows = np.fromfile(path, TICK_DTYPE)
        rows["phase"][-1] = Phase.DONE
        path.write_bytes(rows.tobytes())
    outcome = Outcome(outcome="failed" if problems else "completed", problems=problems)
    with monkeypatch.context() as disk:
        for writer in ("replace_text", "write_parquet", "write_report"):
            disk.setattr(run_folder, writer, full_disk)
        assert finish_run(tmp_path, replace(RULES, mode="lockstep"), outcome).unwritten
    report_run(tmp_path, RULES)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["outcome"], summary["mode"]) == (outcome.outcome, "lockstep")
    assert summary["violations"][:1] == list(problems[:1])


@pytest.mark.parametrize(
    "outcome",
    [
        Outcome(outcome="completed", speed_factor=12.5),
        Outcome(outcome="interrupted"),
        Outcome(outcome="failed", problems=("agent-1 failed: battery",)),
    ],
)
def test_a_run_whose_summary_is_removed_is_judged_as_it_was(tmp_path: Path, outcome: Outcome) -> None:
    """It was judged as a failed flight in real time that its launcher did not finish, whatever it had been."""
    write_config(tmp_path, "", "lockstep")
    write_run(tmp_path, 3, 20.0)
    for path in tmp_path.glob("agent-*.ticks"):
        rows = np.fromfile(path, TICK_DTYPE)
        rows["phase"][-1] = Phase.DONE
        path.write_bytes(rows.tobytes())
    finish_run(tmp_path, replace(RULES, mode="lockstep"), outcome)
    judged = json.loads((tmp_path / "summary.json").read_text())
    for _ in range(2):
        (tmp_path / "summary.json").write_text("{")
        with pytest.raises(ConfigError, match="Remove it, and the run is judged again"):
            report_run(tmp_path, RULES)
        (tmp_path / "summary.json").unlink()
        report_run(tmp_path, RULES)
        again = json.loads((tmp_path / "summary.json").read_text())
        assert (again["outcome"], again["mode"]) == (outcome.outcome, "lockstep")
        assert again == judged


def test_a_completed_run_of_whose_flight_nothing_was_recorded_is_not_judged_as_flown(tmp_path: Path) -> None:
    """The disk was full from before its start on; with one agent no distance was missed either."""
    write_config(tmp_path, "")
    write_run(tmp_path, 3, 20.0)
    rows = np.fromfile(tmp_path / "agent-0.ticks", TICK_DTYPE)
    rows["phase"] = Phase.STANDBY
    (tmp_path / "agent-0.ticks").write_bytes(rows.tobytes())
    (tmp_path / OUTCOME).write_text('{"outcome": "completed", "problems": []}')
    report_run(tmp_path, RULES)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert "the recording of agent 0 ends in STANDBY: the rest of its flight can't be judged" in summary["violations"]


def test_a_completed_run_whose_recording_ends_in_flight_is_not_judged_to_its_end(tmp_path: Path) -> None:
    write_config(tmp_path, "")
    write_run(tmp_path, 3, 20.0)
    (tmp_path / OUTCOME).write_text('{"outcome": "completed", "problems": []}')
    report_run(tmp_path, RULES)
    summary = json.loads((tmp_path / "summary.json").read_text())
    ends = "the recording of agent 0 ends in LAND: the rest of its flight can't be judged"
    assert summary["violations"].count(ends) == 1
    (tmp_path / "summary.json").unlink()
    report_run(tmp_path, RULES)
    again = json.loads((tmp_path / "summary.json").read_text())
    assert again["violations"] == summary["violations"], "said once, however often it is judged"


@pytest.mark.parametrize(("agents", "seconds"), [(3, 60.0), (12, 40.0), (1, 3.5)])
def test_report_is_small_well_formed_and_self_contained(tmp_path: Path, agents: int, seconds: float) -> None:
    write_run(tmp_path, agents, seconds)
    rules = Rules(
        agents=agents,
        required_separation_m=0.3,
        obstacles=(FAR_BALL,),
    )
    finish_run(tmp_path, rules, Outcome(outcome="completed", problems=("one <script>alert(1)</script> problem",)))
    text = (tmp_path / "report.html").read_text()
    page = parsed(text)
    assert len(text) < 1_000_000
    assert page.addresses() == []
    assert "url(" not in text
    assert "script" not in page.tags
    assert "nan" not in text.lower().replace("covenant", "")
    assert "one <script>alert(1)</script> problem" in page.text
    assert 'name = "x<y"' in page.text
    assert page.tags.count("svg") >= 10
    assert f"Judged by swarmctl {__version__}." in page.text


def test_report_tells_the_version_that_judged_the_run(tmp_path: Path) -> None:
    write_run(tmp_path, 3, 6.0)
    summary, _ = finish_run(tmp_path, RULES, Outcome(outcome="completed"))
    for version, told in (
        ("0.0.7<b>", "Judged by swarmctl 0.0.7&lt;b&gt;."),
        (None, "Judged by swarmctl of unknown version."),
    ):
        stored = {key: value for key, value in summary.items() if key != "version"}
        stored |= {} if version is None else {"version": version}
        (tmp_path / "summary.json").write_text(json.dumps(stored))
        assert told in report_run(tmp_path, RULES).read_text()


def test_report_of_an_empty_run(tmp_path: Path) -> None:
    finish_run(tmp_path, RULES, Outcome(outcome="failed", problems=("no vehicle",)))
    assert "no vehicle" in (tmp_path / "report.html").read_text()


def test_thinning_keeps_peaks() -> None:
    x = np.arange(10_000.0)
    y = np.zeros(10_000)
    y[1234], y[8765] = 50.0, -50.0
    kept_x, kept_y = thin(x, y, 600)
    assert len(kept_x) <= 600
    assert (kept_y.max(), kept_y.min()) == (50.0, -50.0)
    assert np.all(np.diff(kept_x) > 0)


def test_a_folder_whose_name_is_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no text in UTF-8"):
        create_run_folder(tmp_path / os.fsdecode(b"bad\xff"), "circle", UTC_US)


def test_the_configuration_of_somebody_else_is_not_overwritten(tmp_path: Path) -> None:
    write_config(tmp_path, "a = 1\n")
    write_config(tmp_path, "a = 1\n")  # by the Python API, then by the launch
    with pytest.raises(ConfigError, match=r"holds another config\.toml"):
        write_config(tmp_path, "a = 2\n")
    assert (tmp_path / "config.toml").read_text() == "a = 1\n"


def test_a_folder_with_nothing_but_a_configuration_is_no_run(tmp_path: Path) -> None:
    """A sweep leaves that which ends before its first flight; it was reported as a run that has failed."""
    (tmp_path / "config.toml").write_text(dump(Config()))
    with pytest.raises(ConfigError, match=r"holds no run, only a config\.toml\. A sweep that was cut off before its"):
        report_run(tmp_path, RULES)
    assert [path.name for path in tmp_path.iterdir()] == ["config.toml"]


def test_a_run_that_was_cut_off_before_anything_was_recorded_is_one(tmp_path: Path) -> None:
    write_config(tmp_path, dump(Config()), "lockstep")
    assert report_run(tmp_path, RULES).exists()
    assert json.loads((tmp_path / "summary.json").read_text())["mode"] == "lockstep"


def test_the_folder_of_a_campaign_or_sweep_is_no_run(tmp_path: Path) -> None:
    write_run(tmp_path, 1, 4.0)
    (tmp_path / "rows.parquet").write_bytes(b"")
    (tmp_path / "report.html").write_text("its page")
    with pytest.raises(ConfigError, match="holds a campaign or a sweep"):
        report_run(tmp_path, RULES)
    assert (tmp_path / "report.html").read_text() == "its page"
    other = tmp_path / "other"
    other.mkdir()
    (other / "report.html").write_text("a page")
    with pytest.raises(ConfigError, match=r"holds a run already \(report\.html\)"):
        create_run_folder(other, "circle", UTC_US)
