"""The order of the tests, the longest first, so that no worker idles at the end; and what each begins with."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

import swarmctl  # noqa: F401  (before anything loads numpy)

TESTS = Path(__file__).parent


@pytest.fixture(autouse=True)
def heard_hangup() -> Iterator[None]:
    """Begin a test, and the processes it starts, as on a terminal: under `nohup` SIGHUP would stay ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--nudged", metavar="SEED", default="0", help="fly tests/closed_loop from starts a millimetre off")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Two workers begin with the first item and with the middle one.

    One flies in real time, which leaves its processor half idle, while the other computes; short tests follow both.
    """
    groups: dict[str, list[pytest.Item]] = {"process": [], "closed_loop": [], "": []}
    for item in items:
        folder = item.path.relative_to(TESTS).parts[0]
        groups[folder if folder in groups else ""].append(item)
    flown, computed, short = groups.values()
    before = max(0, (len(items) + 1) // 2 - len(flown))
    items[:] = flown + short[:before] + computed + short[before:]
