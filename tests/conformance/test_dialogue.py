"""Every row of the sheet, against the simulator in this process, or against an autopilot by URL (see conftest)."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.conformance.conftest import OPTIONS
from tests.conformance.dialogue import Dialogue
from tests.conformance.partners import ByUrl, InProcess, Partner
from tests.conformance.player import Player
from tests.conformance.rows import DEVIATIONS, ROWS
from tests.conformance.vocabulary import GCS_LINK, Row


def option(config: pytest.Config, name: str) -> str:
    given = config.getoption(name, default=None)  # unknown when the folder was not named on the command line
    return str(given if given is not None else os.environ.get(OPTIONS[name][0], ""))


@pytest.fixture(scope="module")
def player(pytestconfig: pytest.Config) -> Iterator[Player]:
    url, gcs_url, restart = (option(pytestconfig, name) for name in OPTIONS)
    partner: Partner = ByUrl(url, gcs_url, restart) if url else InProcess()
    yield Player(Dialogue(partner))
    partner.close()


def reason_to_skip(row: Row, partner: Partner) -> str:
    if partner.simulated:
        return ""
    if row.needs_gcs and GCS_LINK not in partner.links:
        return "needs the ground station link: --autopilot-gcs-url"
    if row.needs_reboot and not partner.can_restart():
        return "needs a reboot: --autopilot-restart"
    return row.not_by_url


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.section}: {row.name}")
def test_row(row: Row, player: Player, request: pytest.FixtureRequest) -> None:
    partner = player.dialogue.partner
    reason = reason_to_skip(row, partner)
    if reason:
        pytest.skip(reason)
    if partner.simulated and row.name in DEVIATIONS:
        request.applymarker(pytest.mark.xfail(reason=DEVIATIONS[row.name], strict=True))
    if not partner.simulated and row.real_px4:
        request.applymarker(pytest.mark.xfail(reason=row.real_px4, strict=False))
    player.play(row)
