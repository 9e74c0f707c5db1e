"""Default output of an autopilot without traffic to it: every message of section 1, counted on both links at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

from tests.conformance.conftest import OPTIONS
from tests.conformance.dialogue import Dialogue
from tests.conformance.partners import ByUrl, InProcess, Partner
from tests.conformance.rows_streams import ALL_PER_S, SILENT, STREAMS, StreamRow
from tests.conformance.test_dialogue import option
from tests.conformance.vocabulary import GCS_LINK, OFFBOARD_LINK

SETTLE_S = 8.0  # from its start: PX4 says what has changed until 2 s after it can be armed
WATCH_S = 20.0
TOLERANCE, ONE_MORE = 0.03, 1.01  # of the rate; and of the count
Counts = dict[str, Counter[int]]


@pytest.fixture(scope="module")
def watched(pytestconfig: pytest.Config) -> Iterator[tuple[Partner, Counts]]:
    """Counts of every message id on every link over `WATCH_S`, without a word from us."""
    url, gcs_url, restart = (option(pytestconfig, name) for name in OPTIONS)
    if url.startswith("udpout"):
        pytest.skip("udpout: it must be talked to before it sends here")
    partner: Partner = ByUrl(url, gcs_url, restart) if url else InProcess()
    dialogue = Dialogue(partner, passive=True)
    dialogue.run(SETTLE_S if partner.simulated or restart else 0.5)
    before = dialogue.counts()
    start_s = partner.now_s()
    dialogue.run(WATCH_S)
    after = dialogue.counts()
    counts = {link: after[link] - before[link] for link in after}
    assert partner.now_s() - start_s == pytest.approx(WATCH_S, abs=0.1)
    yield partner, counts
    partner.close()


def link_counts(watched: tuple[Partner, Counts], link: str) -> Counter[int]:
    if link not in watched[1]:
        pytest.skip("needs the ground station link: --autopilot-gcs-url")
    return watched[1][link]


def expected(row: StreamRow, link: str, slack_s: float) -> Any:
    """How many of a message `WATCH_S` brings; none at all where it is not sent."""
    wanted_hz = row.offboard_hz if link == OFFBOARD_LINK else row.gcs_hz
    if wanted_hz is None:
        return 0
    count = wanted_hz * WATCH_S
    return pytest.approx(count, abs=ONE_MORE + count * (TOLERANCE + slack_s))


@pytest.mark.parametrize("link", [OFFBOARD_LINK, GCS_LINK])
@pytest.mark.parametrize("row", STREAMS, ids=lambda row: row.name)
def test_default_rate(row: StreamRow, link: str, watched: tuple[Partner, Counts]) -> None:
    assert link_counts(watched, link)[row.number] == expected(row, link, watched[0].slack_s)


@pytest.mark.parametrize("link", [OFFBOARD_LINK, GCS_LINK])
@pytest.mark.parametrize("name", SILENT)
def test_only_when_asked(name: str, link: str, watched: tuple[Partner, Counts]) -> None:
    assert not link_counts(watched, link)[SILENT[name]]


@pytest.mark.parametrize("link", [OFFBOARD_LINK, GCS_LINK])
def test_nothing_else_comes(link: str, watched: tuple[Partner, Counts]) -> None:
    counts = link_counts(watched, link)
    assert set(counts) <= {row.number for row in STREAMS}
    assert counts.total() / WATCH_S == pytest.approx(ALL_PER_S[link], rel=0.05 + watched[0].slack_s)
