"""The sample begins its flights when tests/closed_loop does, and all of `python -m tests.faults` when launches do."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.benches.early_starts import begun_early


@pytest.fixture(scope="module", autouse=True)
def early_starts() -> Iterator[None]:
    with begun_early():
        yield
