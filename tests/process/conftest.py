"""Launches of the process tests, none of which outlives its test."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.benches.launches import Launched, Start


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    launches: list[Launched] = []
    number = itertools.count()

    def starter(*arguments: str) -> Launched:
        temp = Path(tempfile.mkdtemp(prefix="sw"))
        launched = Launched(tmp_path / f"run{next(number)}", temp, *arguments)
        launches.append(launched)
        return launched

    yield starter
    for launched in launches:
        launched.clean_up()
