"""The conformance rows against a real PX4, played by the suite that plays them against the simulator."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.benches.scheduling import realtime_where_permitted
from tests.conformance.dialogue import Dialogue
from tests.conformance.partners import ByUrl
from tests.conformance.player import Player
from tests.conformance.test_dialogue import test_row as test_row  # with the player of this module
from tests.process.test_readme import ROOT
from tests.real.autopilots import PX4
from tests.real.conftest import require
from tests.real.network import Network, own_network
from tests.real.turns import row_turn

pytestmark = [pytest.mark.process, pytest.mark.timeout(1500)]

URL, GCS_URL = "udpin://127.0.0.1:14540", "udpin://127.0.0.1:14550"
_PRIORITY = 12  # above launched agents, at 10, that fly in other lanes


def px4(network: Network, folder: Path) -> str:
    """Return the shell line that starts the PX4 of these tests."""
    require(PX4, network, 1)
    start = PX4.place(0, 1, folder / "0")
    start.folder.mkdir()
    return shlex.join(PX4.shell_line(start, network))


@pytest.fixture(scope="module")
def player(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Player]:
    """Return one that starts PX4 itself, again for rows that need a reboot; it is for all rows of a lane."""
    with own_network() as network, realtime_where_permitted(_PRIORITY):
        line = px4(network, tmp_path_factory.mktemp("vehicles"))
        with network.inside():
            partner = ByUrl(URL, GCS_URL, line)
        yield Player(Dialogue(partner))
        partner.close()


@pytest.fixture(autouse=True)
def beside_no_judged_flight(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Wait for one's turn; the vehicle of the rows before neither flies on meanwhile nor takes processor time."""
    plays_rows = "player" in request.fixturenames

    def put_away() -> None:
        if plays_rows:
            request.getfixturevalue("player").put_away()

    with row_turn(tmp_path_factory.getbasetemp().parent, put_away):
        yield


def test_every_stream_comes_at_its_rate(network: Network, tmp_path: Path) -> None:
    """The suite starts PX4 itself and listens in silence."""
    links = ("--autopilot-url", URL, "--autopilot-gcs-url", GCS_URL, "--autopilot-restart", px4(network, tmp_path))
    command = [sys.executable, "-m", "pytest", "-q", "tests/conformance/test_streams.py", *links]
    played = subprocess.run([*network.prefix, *command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert played.returncode == 0, played.stdout
