"""The result of a flight is printed whatever happens to the disk it was recorded on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from swarmctl.config import Config, dump
from swarmctl.errors import StartError
from swarmctl.ops.flight.summary import rewrite_report
from swarmctl.ops.running_launches import LAUNCH_FILE, RunningLaunch, process_start_s
from swarmctl.telemetry.recording.run_folder import Outcome, finish_run
from tests.benches.recorded_runs import RULES, write_run

# What the launcher does after all agents have landed; `limit` is the largest file the system lets it write.
_SUM_UP = """
import resource, sys
from pathlib import Path
from swarmctl.config import Config
from swarmctl.ops.supervision.launch_result import LaunchResult
from swarmctl.ops.flight.summary import sum_up
directory, limit, had_viewer = Path(sys.argv[1]), int(sys.argv[2]), len(sys.argv) > 3
if limit >= 0:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
result = LaunchResult(problems=["agent-1 was killed by SIGKILL", "agent-2 has been silent for 5 s"])
violated = sum_up(Config(), directory, result, print, had_viewer=had_viewer)
print("exit code", result.exit_code(violated))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A flight of three, landed, not judged yet."""
    write_run(tmp_path, 3, 6.0)
    (tmp_path / "config.toml").write_text(dump(Config()))
    return tmp_path


def sum_up(folder: Path, limit: int, *more: str) -> list[str]:
    command = [sys.executable, "-c", _SUM_UP, str(folder), str(limit), *more]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout.splitlines()


def test_a_run_folder_that_was_removed_is_named_as_removed(tmp_path: Path) -> None:
    lines = sum_up(tmp_path / "removed", -1)
    assert [line for line in lines if "was removed or renamed" in line]
    assert not [line for line in lines if "What was recorded is in" in line]
    assert "exit code 4" in lines


def test_a_full_disk_costs_the_files_and_not_the_verdict(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    lines = sum_up(folder, 0)
    assert lines[:2] == ["violation: agent-1 was killed by SIGKILL", "violation: agent-2 has been silent for 5 s"]
    result, separation, *_ = (line for line in lines if not line.startswith("violation: "))
    assert result.startswith("failed, summed mean tracking error")
    assert separation.startswith("separation 1.039 m (required 0.850 m)")
    assert f"run folder {folder}" in lines
    assert "summary.json: File too large" in lines[-2]
    assert f"swarmctl report {folder}" in lines[-2]
    assert lines[-1] == "exit code 4"
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


_REPORT = """
import resource, sys
from swarmctl.ops.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
sys.argv = ["swarmctl", "report", sys.argv[1]]
main()
"""


@pytest.mark.parametrize("finished", [True, False])
def test_a_report_that_a_full_disk_does_not_take_is_an_error(folder: Path, finished: bool) -> None:
    if finished:
        finish_run(folder, RULES, Outcome(outcome="completed"))
    command = [sys.executable, "-c", _REPORT, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (3, "")
    [line] = done.stderr.splitlines()
    assert "report.html" in line and "File too large" in line


def test_a_disk_that_fills_on_the_way_keeps_what_fits(folder: Path) -> None:
    lines = sum_up(folder, 30_000)  # the report does not fit
    assert "report.html" in lines[-2]
    assert "summary.json" not in lines[-2]
    assert (folder / "summary.json").exists()
    assert not list(folder.glob("*.part"))


def test_a_recording_that_cannot_be_judged_costs_the_figures_and_not_the_verdict(folder: Path) -> None:
    (folder / "truth.bin").unlink()
    (folder / "truth.bin").mkdir()
    lines = sum_up(folder, -1)
    assert lines[:2] == ["violation: agent-1 was killed by SIGKILL", "violation: agent-2 has been silent for 5 s"]
    assert lines[2].startswith("failed, ")
    assert "can't be judged" in lines[-2]
    assert lines[-1] == "exit code 4"


def test_a_viewer_that_had_no_processor_time_costs_no_recording(folder: Path) -> None:
    sum_up(folder, -1)
    assert not (folder / "telemetry.rrd").exists(), "nobody has asked for one"
    lines = sum_up(folder, -1, "there was a viewer")
    assert "telemetry.rrd: drawn after the flight, because the viewer has recorded nothing" in lines
    drawn = (folder / "telemetry.rrd").read_bytes()
    assert len(drawn) > 100_000
    lines = sum_up(folder, -1, "there was a viewer")
    assert not any("drawn" in line for line in lines), "one that is there is kept"


def test_a_recording_that_can_not_be_drawn_either_is_told(folder: Path) -> None:
    lines = sum_up(folder, 30_000, "there was a viewer")
    assert any(
        line.startswith("no telemetry.rrd: the viewer has written none, and it can't be drawn") for line in lines
    )
    assert lines[-1] == "exit code 4"


def test_report_of_a_launch_that_runs_is_refused_until_it_has_ended(folder: Path) -> None:
    before = {path.name for path in folder.iterdir()}
    started_s, pid = process_start_s()
    launch = RunningLaunch("run", "unixsock-stream//x", pid, started_s, 3, str(folder), ending=True)
    (folder / LAUNCH_FILE).write_bytes(msgspec.json.encode(launch))
    with pytest.raises(StartError, match="still flies or is ending, see: swarmctl status"):
        rewrite_report(folder)
    assert {path.name for path in folder.iterdir()} == before | {LAUNCH_FILE}
    (folder / LAUNCH_FILE).write_bytes(msgspec.json.encode(msgspec.structs.replace(launch, started_s=started_s - 60)))
    assert rewrite_report(folder).exists()
    (folder / LAUNCH_FILE).write_bytes(msgspec.json.encode(launch))
    assert rewrite_report(folder).exists(), "it is finished: nothing is packed"
