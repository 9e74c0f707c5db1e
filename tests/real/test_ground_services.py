"""What MAVSDK does for a real PX4 that stands on the ground: its own arming checks, geofence, parameters, logs."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest

from tests.process.test_readme import ROOT
from tests.real.autopilots import PX4
from tests.real.conftest import Field, Fielder

pytestmark = [pytest.mark.process, pytest.mark.timeout(900)]

READY_S = 60.0
CONFIG = """[swarm]
agents = 1
[start]
center_ned_m = [0.0, 0.0, -2.0]
[sitl]
enabled = false
[geofence]
corners_ne_m = [[40.0, 40.0], [40.0, -40.0], [-40.0, -40.0], [-40.0, 40.0]]
[[vehicles]]
sysid = 1
url = "udpin://127.0.0.1:14540"
"""


def swarmctl(here: Field, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [*here.fleet.network.prefix, sys.executable, "-m", "swarmctl", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)


def check(here: Field, folder: Path, *arguments: str) -> dict[str, dict[str, Any]]:
    """Return the findings of a check by topic."""
    (folder / "config.toml").write_text(CONFIG)
    told = folder / "check.json"
    done = swarmctl(here, "check", str(folder / "config.toml"), "--json", str(told), *arguments)
    assert told.exists(), done.stderr
    return {line["topic"]: line for line in json.loads(told.read_text())["findings"]}


def check_until(here: Field, folder: Path, topic: str, words: str) -> dict[str, dict[str, Any]]:
    """Check until a topic was found like this: PX4 is not ready at once."""
    deadline_s = time.monotonic() + READY_S
    while words not in (found := check(here, folder))[topic]["found"]:
        assert time.monotonic() < deadline_s, found[topic]
    return found


def test_a_geofence_is_stored_and_a_bundle_holds_the_log(field: Fielder, tmp_path: Path) -> None:
    here = field(PX4, 1)
    found = check_until(here, tmp_path, "sensors", "ready to arm")
    assert found["geofence"]["verdict"] == "FIX"
    assert found["arming checks"]["verdict"] in ("OK", "NOTE")
    assert found["arming checks"]["found"] != "not told by this autopilot; see sensors"
    found = check(here, tmp_path, "--apply")
    assert found["geofence"]["found"] == "4 corners, the same"
    assert (found["COM_OBL_RC_ACT"]["found"], found["COM_OF_LOSS_T"]["found"]) == ("4", "0.5")
    assert check(here, tmp_path)["geofence"]["verdict"] == "OK", "it has stayed"

    done = swarmctl(here, "bundle", str(tmp_path), "--output", str(tmp_path / "run.zip"))
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(tmp_path / "run.zip") as archive:
        told = json.loads(archive.read("vehicles.json"))["agent-0"]
        assert told["incomplete"] == {}
        newest = max(told["logs"], key=lambda log: log["number"])
        log = archive.read(f"logs/agent-0-log-{newest['number']}.ulg")
        assert len(log) == newest["size_bytes"] > 100_000
        assert log[:4] == b"ULog"
        assert archive.read(f"{tmp_path.name}/config.toml").decode() == CONFIG


def test_an_uncalibrated_sensor_is_named(field: Fielder, tmp_path: Path) -> None:
    here = field(PX4, 1, {"CAL_ACC0_ID": 0})
    found = check_until(here, tmp_path, "arming checks", "Accelerometer 0 uncalibrated")
    assert found["arming checks"]["verdict"] == "FIX"
