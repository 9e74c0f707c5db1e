"""What `tools/soak.py` makes of a long flight."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np

from swarmctl.core.recorded.records import PLAN_COLUMNS, PLAN_DTYPE
from swarmctl.telemetry.recording.run_files import write_parquet
from tests.benches.recorded_runs import flight

TOOL = Path(__file__).parents[2] / "tools" / "soak.py"


def test_every_agent_is_looked_at_and_nothing_else(tmp_path: Path) -> None:
    for agent in (2, 11, 100):
        write_parquet(tmp_path / f"agent-{agent}.parquet", flight(agent, 3, 6.0)[0])
        write_parquet(tmp_path / f"agent-{agent}.plans.parquet", np.zeros(1, PLAN_DTYPE), PLAN_COLUMNS)
    found = runpy.run_path(str(TOOL))["tick_p99_ms"](tmp_path)
    assert list(found) == ["agent-2", "agent-11", "agent-100"]
    assert all(len(tenths) == 10 for tenths in found.values())


def test_a_flight_too_short_for_samples_has_no_growth() -> None:
    assert runpy.run_path(str(TOOL))["growth"]([]) == {}
