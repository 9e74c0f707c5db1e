"""The command line prints whatever its output takes, and has its exit code where that takes nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SHORT = ("--agents", "1", "--duration", "1", "--no-view", "--set", "telemetry.enabled=false", "--set", "sitl.start=air")


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
