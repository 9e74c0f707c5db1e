"""The matrix: all rows, by name."""

from __future__ import annotations

from tests.faults import rows_solver
from tests.faults.row import Row

ROWS: dict[str, Row] = {row.name: row for rows in (rows_solver.ROWS,) for row in rows}
