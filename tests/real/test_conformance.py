"""The conformance rows against a real PX4, played by the suite that plays them against the simulator."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.process.test_readme import ROOT
from tests.real.autopilots import PX4
from tests.real.conftest import require
from tests.real.network import Network

pytestmark = [pytest.mark.process, pytest.mark.timeout(3600)]

LINKS = ("--autopilot-url", "udpin://127.0.0.1:14540", "--autopilot-gcs-url", "udpin://127.0.0.1:14550")


@pytest.mark.parametrize("part", ["test_streams.py", "test_dialogue.py"])
def test_every_row_is_met(network: Network, tmp_path: Path, part: str) -> None:
    """The suite starts PX4 itself: rows that need a reboot are played too."""
    require(PX4, network, 1)
    line = shlex.join(PX4.shell_line(PX4.place(0, 1, tmp_path)))
    command = [sys.executable, "-m", "pytest", "-q", f"tests/conformance/{part}", *LINKS, "--autopilot-restart", line]
    played = subprocess.run([*network.prefix, *command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert played.returncode == 0, played.stdout
