"""The conformance rows against a real PX4, played by the suite that plays them against the simulator."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.process.test_readme import ROOT
from tests.real.autopilots import PX4
from tests.real.conftest import Fielder

pytestmark = [pytest.mark.process, pytest.mark.timeout(3600)]

LINKS = ("--autopilot-url", "udpin://127.0.0.1:14540", "--autopilot-gcs-url", "udpin://127.0.0.1:14550")
BOOTED_S = 30.0


@pytest.mark.parametrize("part", ["test_streams.py", "test_dialogue.py"])
def test_every_row_is_met(field: Fielder, part: str) -> None:
    here = field(PX4, 1)
    here.witness.wait(lambda: len(here.witness.vehicles[0].beats) > BOOTED_S, 2 * BOOTED_S, "booted")
    here.witness.close()  # the suite is the ground station now
    command = [sys.executable, "-m", "pytest", "-q", f"tests/conformance/{part}", *LINKS]
    played = subprocess.run(
        [*here.fleet.network.prefix, *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert played.returncode == 0, played.stdout
