"""A finished run for tests that read one; and no deadlines of property tests, as the machine is shared."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

from tests.benches.recorded_runs import write_finished_run

settings.register_profile("unit", deadline=None)
settings.load_profile("unit")


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished run of three agents without faults, for reading and copying."""
    directory = tmp_path_factory.mktemp("run")
    write_finished_run(directory)
    return directory
