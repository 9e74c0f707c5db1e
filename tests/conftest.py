"""The order of the test files, the longest first, so that no worker idles at the end; and how each test begins.

Hundreds of processes import the program: it is compiled once, whatever the environment says of keeping that. Workers
begin to collect in different folders, because each loads what another has already rewritten and compiled.
"""

from __future__ import annotations

import compileall
import gc
import os
import signal
import sys
from collections.abc import Generator, Iterator, Set
from pathlib import Path

import pytest

import swarmctl  # noqa: F401  (before anything loads numpy)

TESTS = Path(__file__).parent
LONGEST = [  # half a minute and more each
    "process/test_launch.py",
    "closed_loop/test_guaranteed_cut_off.py",
    "closed_loop/test_guaranteed.py",
    "process/test_readme.py",
    "closed_loop/test_failures.py",
    "process/test_hosts.py",
    "closed_loop/test_deadlock.py",
    "closed_loop/test_real_autopilot.py",
    "process/test_launch_flight.py",
    "closed_loop/test_circle.py",
    "closed_loop/test_swap.py",
    "closed_loop/test_reproduce.py",
    "process/test_viewer.py",
    "closed_loop/test_obstacle.py",
    "closed_loop/test_campaign.py",
]
AT_ONCE = ["process", "closed_loop"]  # one flies in real time, waiting half of it, the other computes
AFTERWARDS = ["faults", "conformance", "unit"]


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


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without the garbage collector: it would traverse, again and again, what is kept to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Rotate what a folder contains, for each worker by another share; `order` makes them equal again."""
    report = yield
    worker = getattr(collector.config, "workerinput", None)
    if worker is not None and isinstance(collector, pytest.Directory) and report.result:
        number, workers = int(worker["workerid"].removeprefix("gw")), worker["workercount"]
        first = number * len(report.result) // workers
        report.result = report.result[first:] + report.result[:first]
    return report


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files as workers take them, one at a time (`--dist loadfile --no-loadscope-reorder`)."""
    places = order({item.path.relative_to(TESTS).as_posix() for item in items})
    items.sort(key=lambda item: places[item.path.relative_to(TESTS).as_posix()])


def order(names: Set[str]) -> dict[str, int]:
    """Return where each file comes: the folders of `AT_ONCE` evenly mixed, the longest first, then the other ones."""

    def folder(name: str) -> str:
        return name.partition("/")[0]

    def rank(name: str) -> tuple[int, str]:
        return LONGEST.index(name) if name in LONGEST else len(LONGEST), name

    mixed = [sorted((name for name in names if folder(name) == each), key=rank) for each in AT_ONCE]
    shares = {name: i / len(files) for files in mixed for i, name in enumerate(files)}
    last = {name: AFTERWARDS.index(folder(name)) if folder(name) in AFTERWARDS else len(AFTERWARDS) for name in names}
    keys = {name: (shares[name], 0) if name in shares else (1.0, last[name]) for name in names}
    return {name: i for i, name in enumerate(sorted(names, key=lambda name: (*keys[name], *rank(name))))}
