"""Real autopilots that sign: they are given a key, and from then on flown over signed frames alone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from swarmctl.mavlink.signing.key_file import write_new_key
from swarmctl.mavlink.signing.refusals import HARMLESS
from tests.process.test_readme import ROOT
from tests.real.autopilots import ARDUCOPTER, PX4, Kind
from tests.real.conftest import Fielder
from tests.real.test_flights import ARDUPILOT_CONFIG, END_S, LONE_PX4, PX4_CONFIG, booted, flown

pytestmark = [pytest.mark.process, pytest.mark.timeout(600)]


@pytest.mark.parametrize("kind", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_a_vehicle_is_flown_with_its_key_once_it_has_it(field: Fielder, tmp_path: Path, kind: Kind) -> None:
    here = field(PX4, 1) if kind is PX4 else booted(field, 1)
    write_new_key(tmp_path / "0.key")
    signed = ("--set", f"mavlink.signing_keys=['{tmp_path / '0.key'}']")
    config = (*((PX4_CONFIG, *LONE_PX4) if kind is PX4 else (ARDUPILOT_CONFIG,)), *signed)
    unsigned = here.launch(*config)
    assert unsigned.end(END_S) == 3
    assert "unsigned; see mavlink.signing_keys" in unsigned.text()
    installed = subprocess.run(
        [*here.fleet.network.prefix, sys.executable, "-m", "swarmctl", "keys", "install", *config],
        cwd=ROOT,
        env={**os.environ, "XDG_STATE_HOME": str(tmp_path / "state")},
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert installed.returncode == 0, installed.stdout + installed.stderr
    launched = flown(here, *config, "--duration", "5")
    assert set(launched.summary()["comms"]["refused_frames"]) <= HARMLESS
    if kind is PX4:  # ArduCopter goes on to take unsigned frames on its first port, which this is
        plain = here.launch(*config[: -len(signed)])
        assert plain.end(END_S) == 3, "without the key it is not answered"
