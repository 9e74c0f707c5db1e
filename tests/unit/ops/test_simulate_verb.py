"""`simulate` prints its result whatever happens to the disk and the terminal."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import sitl.simulate as verb
from swarmctl.errors import StartError
from swarmctl.telemetry.evaluation.referee import Rules
from swarmctl.telemetry.recording.run_folder import report_run

COARSE = ("--set", "sitl.physics_hz=100", "--set", "agent.rate_hz=25")  # nothing here depends on the rates
SHORT = ("--agents", "1", "--duration", "2", "--set", "telemetry.enabled=false", "--set", "sitl.start=air", *COARSE)


def test_a_full_disk_costs_the_files_and_not_the_verdict(tmp_path: Path) -> None:
    code = "import resource, sys; from sitl.simulate import main\n"
    code += "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\nsys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *SHORT, "--agents", "2", "--jobs", "2", "--run-dir", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    lines = done.stdout.splitlines()
    assert done.returncode == 4, done.stderr
    assert lines[0].startswith("completed, summed mean tracking error")
    assert [lines[-1].count(f"agent-{i}.ticks: File too large") for i in (0, 1)] == [1, 1]
    assert "What of agent-0.ticks, agent-1.ticks, truth.bin was not written is lost" in lines[-1]
    assert "swarmctl report" not in lines[-1], "the rows were in memory"
    (tmp_path / "run" / "summary.json").unlink()
    report_run(tmp_path / "run", Rules(agents=2, required_separation_m=0.5))
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["outcome"], summary["mode"]) == ("failed", "lockstep")


def test_a_window_that_can_not_be_opened_changes_no_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for code in (0, 4):
        monkeypatch.setattr(verb, "simulate", lambda config, directory, jobs, code=code: code)
        assert verb.main(["--view", "--run-dir", str(tmp_path / f"run-{code}")]) == code
        assert f"rerun --port auto {tmp_path}/run-{code}/telemetry.rrd" in capsys.readouterr().err


def long_simulation(folder: Path) -> list[str]:
    """Return the command of one that is to be interrupted."""
    longer = ("--duration", "600", "--run-dir", str(folder))
    return [sys.executable, "-m", "sitl.simulate", "--agents", "2", "--jobs", "2", *COARSE, *longer]


def until_it_flies(folder: Path) -> None:
    until_s = time.monotonic() + 60.0
    while not (folder / "agent-0.tlog").exists() and time.monotonic() < until_s:
        time.sleep(0.05)


def test_a_closed_terminal_lands_and_keeps_the_verdict(tmp_path: Path) -> None:
    """The kernel and the shell both send SIGHUP: the second one is no second request."""
    folder = tmp_path / "run"
    master, terminal = pty.openpty()
    process = subprocess.Popen(
        long_simulation(folder), stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True
    )
    os.close(terminal)
    until_it_flies(folder)
    time.sleep(1.0)
    os.close(master)
    for _ in range(2):
        process.send_signal(signal.SIGHUP)
        time.sleep(0.1)
    assert process.wait(120) == 130
    assert json.loads((folder / "summary.json").read_text())["outcome"] == "interrupted"


def test_a_second_ctrl_c_ends_every_process_at_once(tmp_path: Path) -> None:
    process = subprocess.Popen(long_simulation(tmp_path / "run"), stderr=subprocess.PIPE, start_new_session=True)
    until_it_flies(tmp_path / "run")
    time.sleep(1.0)
    for _ in range(2):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(0.1)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert b"Traceback" not in told
    with pytest.raises(ProcessLookupError):
        os.killpg(process.pid, 0)


def test_a_simulation_that_flies_is_not_finished_by_a_report(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = subprocess.Popen(long_simulation(folder), stdout=subprocess.DEVNULL)
    until_it_flies(folder)
    time.sleep(1.0)  # until it heeds signals
    with pytest.raises(StartError, match="is still written"):
        report_run(folder, Rules(agents=2, required_separation_m=0.5))
    process.send_signal(signal.SIGINT)
    assert process.wait(120) == 130
    assert json.loads((folder / "summary.json").read_text())["outcome"] == "interrupted"
    kept = json.loads((folder / "outcome.json").read_text())
    assert (kept["outcome"], kept["mode"]) == ("interrupted", "lockstep")


def test_ctrl_c_while_files_are_packed_is_too_late(tmp_path: Path) -> None:
    code = "import os, signal, sys; from sitl import simulate\nfinish = simulate.finish_run\n"
    code += "def finish_run(*given):\n    os.kill(os.getpid(), signal.SIGINT)\n    return finish(*given)\n"
    code += "simulate.finish_run = finish_run\nsys.exit(simulate.main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *SHORT, "--run-dir", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.startswith("completed"), done.stderr
    assert done.returncode == 0, "as it says"


@pytest.mark.parametrize("verb", ["simulate", "sweep"])
def test_ctrl_c_while_modules_are_imported_is_an_interruption(verb: str, tmp_path: Path) -> None:
    """It ended in a traceback and by the signal, which is no exit code."""
    folder = ("--set", "mission.circle.radius_m=2,3", "--out") if verb == "sweep" else ("--run-dir",)
    command = [sys.executable, "-m", "swarmctl", verb, *folder, str(tmp_path / "run")]
    where = {**os.environ, "PYTHONPROFILEIMPORTTIME": "1"}  # prints what is imported, as it is
    process = subprocess.Popen(
        command,
        env=where,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # ignored in the background of a shell
    )
    assert process.stderr is not None
    told = []
    for line in process.stderr:
        told.append(line)
        if line.split()[-1:] == ["numpy"]:
            process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    assert "Traceback" not in "".join(told)
    assert not (tmp_path / "run").exists()
