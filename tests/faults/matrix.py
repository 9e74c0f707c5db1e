"""The matrix: all rows, by name."""

from __future__ import annotations

from tests.faults import rows_agents, rows_bus, rows_solver, rows_vehicle
from tests.faults.row import Row

ROWS: dict[str, Row] = {row.name: row for rows in (rows_solver.ROWS, rows_bus.ROWS, rows_agents.ROWS, rows_vehicle.ROWS) for row in rows}
