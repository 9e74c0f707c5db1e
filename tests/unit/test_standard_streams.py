"""The command line prints whatever its output takes, and has its exit code where that takes nothing."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

COARSE = ("--set", "sitl.start=air", "--set", "sitl.physics_hz=100", "--set", "agent.rate_hz=25")
SHORT = ("--agents", "1", "--duration", "1", "--no-view", "--set", "telemetry.enabled=false", *COARSE)


def test_what_the_encoding_lacks_is_printed_as_escapes(tmp_path: Path) -> None:
    """The path of a run folder ended simulations in a traceback, after the flight."""
    command = [sys.executable, "-m", "swarmctl", "simulate", *SHORT, "--run-dir", str(tmp_path / "flüge")]
    where = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, env=where, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert f"run folder {tmp_path}/fl\\xfcge" in done.stdout


def test_closed_streams_change_neither_exit_code_nor_files(tmp_path: Path) -> None:
    for redirected in (">&-", "<&- >&- 2>&-"):
        for arguments, code in ((("config", "show", "seed"), 0), (("config", "show", "none"), 2)):
            command = f'"$0" -m swarmctl "$@" {redirected}'
            done = subprocess.run(["sh", "-c", command, sys.executable, *arguments], timeout=60, check=False)
            assert done.returncode == code, (redirected, arguments)
    command = '"$0" -m swarmctl "$@" <&- >&- 2>&-'
    flight = ("simulate", *SHORT, "--run-dir", str(tmp_path / "run"))
    assert subprocess.run(["sh", "-c", command, sys.executable, *flight], timeout=120, check=False).returncode == 0
    recorded = [path.read_bytes() for path in (tmp_path / "run").iterdir()]
    assert recorded and not any(b"summed mean tracking error" in content[:80] for content in recorded)


def test_a_reader_that_closes_the_pipe_ends_no_verb(tmp_path: Path) -> None:
    """`| head` ended a sweep before its first flight in a traceback, and measurements without a file."""
    short = ("--set", "swarm.agents=1", *COARSE, "--duration", "1", "--jobs", "1")
    sweep = ("sweep", "--set", "mission.circle.radius_m=2,3", *short, "--out", str(tmp_path))
    for arguments, unbuffered in ((sweep, ""), (("config", "show"), ""), (("config", "show"), "1")):
        command = ["bash", "-c", '"$0" -m swarmctl "$@" | head -0; exit ${PIPESTATUS[0]}', sys.executable, *arguments]
        where = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
        done = subprocess.run(command, env=where, stderr=subprocess.PIPE, text=True, timeout=120, check=False)
        assert (done.returncode, done.stderr) == (0, ""), arguments
    assert (tmp_path / "rows.parquet").exists()


@pytest.mark.parametrize("arguments", [("config", "show", "seed"), ("config", "schema"), ("--version",)])
def test_a_full_disk_is_told_and_is_no_success(arguments: tuple[str, ...]) -> None:
    """A program would read an empty file of `status --json > FILE` as the answer."""
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "swarmctl", *arguments]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert done.stderr == "standard output can't be written: No space left on device\n"
    assert done.returncode == 4


def test_a_pipe_that_is_set_not_to_be_waited_for_loses_nothing() -> None:
    """Another program that has the same terminal or pipe may set it so; what did not fit in at once was lost."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    program = "from swarmctl.standard_streams import *; prepare_standard_streams(); print('x' * 200_000)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=write) as writer:
        while select.select((), (write,), (), 0.0)[1] and writer.poll() is None:
            time.sleep(0.05)  # until the pipe is full
        os.close(write)
        with os.fdopen(read, "rb") as reader:
            assert len(reader.read()) == 200_001
        assert writer.wait(60) == 0
