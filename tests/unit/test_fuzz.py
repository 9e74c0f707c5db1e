"""Every decoder of bytes from outside for a moment; `tools/fuzz.py` does it for as long as one likes."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
import time
from pathlib import Path

TOOL = Path(__file__).parents[2] / "tools" / "fuzz.py"


def test_nothing_that_a_decoder_is_given_raises_or_takes_long(tmp_path: Path) -> None:
    state = tmp_path / "state.json"
    line = [sys.executable, str(TOOL), "--executions", "2000", "--round", "0.1", "--state", str(state)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = json.loads(state.read_text())
    assert len(counts) == 24
    assert min(counts.values()) > 0


def test_what_raises_or_takes_long_is_found() -> None:
    tool = runpy.run_path(str(TOOL))
    target, execute = tool["Target"], tool["execute"]

    def busy(_: bytes) -> None:
        until_s = time.process_time() + 1.1
        while time.process_time() < until_s:
            pass

    assert execute(target([b""], lambda data: data[10]), b"") == "raised IndexError: index out of range"
    assert execute(target([b""], lambda data: data[10], (IndexError,)), b"") == ""
    assert execute(target([b""], busy), b"").startswith("took 1.")
