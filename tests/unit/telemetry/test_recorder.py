"""The recorder never holds up a tick and never loses more than it says."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl.core.recorded.received import frame_rows
from swarmctl.core.recorded.records import TICK_DTYPE, tick_row
from swarmctl.core.types import Plan
from swarmctl.files import is_held
from swarmctl.telemetry.recording import recorder as recorder_module
from swarmctl.telemetry.recording.recorder import Recorder
from swarmctl.telemetry.recording.run_files import load_run, read_plans, read_received, read_rows
from tests.benches.tick_records import tick_record


def told(seq: int) -> tuple[NDArray[np.void], Plan | None]:
    """What a recorder is told of a tick."""
    record = tick_record(t_us=seq * 20_000, utc_us=1_780_000_000_000_000 + seq * 20_000, seq=seq)
    return tick_row(record), record.flown


def test_round_trip(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 2)
    for seq in range(100):
        recorder.tick(*told(seq))
    recorder.frame(1_780_000_000_000_000, b"\xfdframe")
    (row,) = frame_rows(20_000, 2, [19_000])
    for received in (row, b"", row + row):
        recorder.received(received)
    recorder.event("plan_failed", 5, 6, status="max_iter", gap_m=float("nan"))
    recorder.close(5.0)
    assert recorder.lost == 0
    rows = load_run(tmp_path).ticks[2]
    assert rows["seq"].tolist() == list(range(100))
    assert rows["pos_ned_m"][7].tolist() == [1.1, -2.2, -3.3]
    (_, plan), points = told(0), read_plans(tmp_path, 2)
    assert plan is not None
    assert np.unique(points["t_us"]).tolist() == [seq * 20_000 for seq in range(100)]
    first = points[points["t_us"] == 0]
    np.testing.assert_array_equal(first["pos_ned_m"], plan.pos_ned_m.astype(np.float32))
    assert first["at_us"].tolist() == [plan.t0_us + step * plan.dt_us for step in range(len(plan.pos_ned_m))]
    assert read_received(tmp_path, 2)["stamp_us"].tolist() == [19_000] * 3
    stamp = (1_780_000_000_000_000).to_bytes(8, "big")
    assert (tmp_path / "agent-2.tlog").read_bytes() == stamp + b"\xfdframe"
    (event,) = [json.loads(line) for line in (tmp_path / "agent-2.events.jsonl").read_text().splitlines()]
    assert event == {
        "utc_us": 6,
        "t_us": 5,
        "source": "agent-2",
        "event": "plan_failed",
        "status": "max_iter",
        "gap_m": None,
    }


def test_rows_lost_to_a_full_disk_are_counted_and_raise_nothing(tmp_path: Path) -> None:
    (tmp_path / "agent-0.ticks").symlink_to("/dev/full")
    recorder = Recorder(tmp_path, 0)
    for seq in range(10):
        recorder.tick(*told(seq))
    recorder.event("still_here", 1, 2)
    recorder.close(5.0)
    assert recorder.lost == 10
    assert "still_here" in (tmp_path / "agent-0.events.jsonl").read_text()


def test_vanished_folder_is_counted(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "gone", 0)
    recorder.tick(*told(0))
    recorder.close(5.0)
    assert recorder.lost == 2, "the tick and its predicted path"


def test_full_queue_drops_without_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "agent-0.ticks")  # opening it for writing blocks for ever: a disk that hangs
    monkeypatch.setattr(recorder_module, "_QUEUE", 100)
    recorder = Recorder(tmp_path, 0)
    recorder.tick(*told(0))
    until_s = time.monotonic() + 10.0
    while recorder._queue and time.monotonic() < until_s:  # from then on the thread hangs with the first row
        time.sleep(0.01)
    began_s = time.monotonic()
    for seq in range(500):
        recorder.tick(*told(seq))
    assert recorder.lost == 900, "of 500 ticks and 500 plans a hundred fit, and no more is kept in memory"
    recorder.close(0.1)
    assert time.monotonic() - began_s < 1.0
    assert recorder.lost >= 900


def test_tick_costs_the_caller_little(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 0)
    one = told(0)
    costs_us = []
    for _ in range(2000):
        began_ns = time.perf_counter_ns()
        recorder.tick(*one)
        costs_us.append((time.perf_counter_ns() - began_ns) / 1e3)
    recorder.close(5.0)
    assert np.median(costs_us) < 60.0, f"median {np.median(costs_us):.1f} us"


_CHILD = """
import sys, time, resource
from pathlib import Path
sys.path.insert(0, {folder!r})
from test_recorder import Recorder, told
limit = {limit}
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
recorder = Recorder(Path({directory!r}), 0)
for seq in range({count}):
    recorder.tick(*told(seq))
    time.sleep({pause_s})
recorder.close(5.0)
print(recorder.lost, flush=True)
"""


def child(directory: Path, limit: int, count: int, pause_s: float) -> subprocess.Popen[str]:
    code = _CHILD.format(
        folder=str(Path(__file__).parent), directory=str(directory), limit=limit, count=count, pause_s=pause_s
    )
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def test_disk_that_fills_up_mid_row_leaves_whole_rows(tmp_path: Path) -> None:
    process = child(tmp_path, limit=10 * TICK_DTYPE.itemsize + 50, count=60, pause_s=0.02)
    output, _ = process.communicate(timeout=60)
    rows = read_rows(tmp_path / "agent-0.ticks", TICK_DTYPE)
    assert (tmp_path / "agent-0.ticks").stat().st_size % TICK_DTYPE.itemsize == 0
    assert rows["seq"].tolist() == list(range(10))
    (_, plan), points = told(0), read_plans(tmp_path, 0)
    plans = len(np.unique(points["t_us"]))
    assert plan is not None and len(points) == plans * len(plan.pos_ned_m), "whole paths, too"
    assert 0 < plans < 60
    assert int(output) == 50 + 60 - plans


def test_killed_agent_loses_only_the_last_moments(tmp_path: Path) -> None:
    process = child(tmp_path, limit=0, count=10_000, pause_s=0.005)
    path = tmp_path / "agent-0.ticks"
    until_s = time.monotonic() + 30
    while (not path.exists() or path.stat().st_size < 100 * TICK_DTYPE.itemsize) and time.monotonic() < until_s:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    rows = load_run(tmp_path).ticks[0]
    assert len(rows) >= 100
    assert rows["seq"].tolist() == list(range(len(rows)))


def test_partial_row_of_a_killed_agent_does_not_shift_later_rows(tmp_path: Path) -> None:
    path = tmp_path / "agent-0.ticks"
    recorder = Recorder(tmp_path, 0)
    recorder.tick(*told(0))
    recorder.close(5.0)
    with path.open("ab") as file:
        file.write(b"\x01" * 57)
    assert load_run(tmp_path).ticks[0]["seq"].tolist() == [0]
    again = Recorder(tmp_path, 0)
    again.tick(*told(1))
    again.close(5.0)
    assert load_run(tmp_path).ticks[0]["seq"].tolist() == [0, 1]


def test_files_are_held_while_an_agent_records(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 0)
    recorder.tick(*told(0))
    recorder.event("phase", 1, 1)
    until_s = time.monotonic() + 30
    while len(list(tmp_path.iterdir())) < 3 and time.monotonic() < until_s:
        time.sleep(0.05)
    held = {path.name for path in tmp_path.iterdir() if is_held(path)}
    recorder.close(5.0)
    assert held == {"agent-0.ticks", "agent-0.plans", "agent-0.events.jsonl"}
    assert not any(map(is_held, tmp_path.iterdir()))


def test_an_agent_does_not_load_pyarrow_or_rerun() -> None:
    code = "import sys, swarmctl.telemetry.recording.recorder; print({'pyarrow', 'rerun', 'zenoh'} & set(sys.modules))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert output.stdout.strip() == "set()"
