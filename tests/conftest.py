"""The order of the test files, the longest first, so that no worker idles at the end; and how each test begins.

Hundreds of processes import the program: it is compiled once, whatever the environment says of keeping that.
"""

from __future__ import annotations

import compileall
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import swarmctl  # noqa: F401  (before anything loads numpy)

TESTS = Path(__file__).parent
LONGEST = [  # over a minute each
    "process/test_readme.py",
    "closed_loop/test_guaranteed.py",
    "closed_loop/test_failures.py",
    "process/test_launch.py",
    "closed_loop/test_deadlock.py",
    "closed_loop/test_real_autopilot.py",
    "closed_loop/test_circle.py",
    "closed_loop/test_campaign.py",
    "closed_loop/test_solvers.py",
    "closed_loop/test_gusts.py",
    "closed_loop/test_swap.py",
    "closed_loop/test_forgery.py",
    "closed_loop/test_identify.py",
    "process/test_viewer.py",
    "closed_loop/test_obstacle.py",
    "closed_loop/test_processors.py",
]
FOLDERS = ["process", "closed_loop", "faults", "conformance", "unit"]


@pytest.fixture(autouse=True)
def heard_hangup() -> Iterator[None]:
    """Begin a test, and the processes it starts, as on a terminal: under `nohup` SIGHUP would stay ignored."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--nudged", metavar="SEED", default="0", help="fly tests/closed_loop from starts a millimetre off")


def pytest_configure(config: pytest.Config) -> None:
    """Compile what the tests start, before there are workers; they and their processes inherit the environment."""
    if hasattr(config, "workerinput"):
        return
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False  # this is for the tests themselves, whose rewriting is slower still
    for package in ("swarmctl", "sitl"):
        compileall.compile_dir(TESTS.parent / package, quiet=2)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files as workers take them, one at a time (`--dist loadfile --no-loadscope-reorder`).

    The longest come first. A file that flies in real time leaves its processor half idle, while others compute.
    """
    items.sort(key=lambda item: place(item.path))


def place(path: Path) -> tuple[int, int, str]:
    """Return where a file comes in the order: the named ones as listed, then folder by folder."""
    name = path.relative_to(TESTS).as_posix()
    folder = name.partition("/")[0]
    return (
        LONGEST.index(name) if name in LONGEST else len(LONGEST),
        FOLDERS.index(folder) if folder in FOLDERS else len(FOLDERS),
        name,
    )
