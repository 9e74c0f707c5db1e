"""All rows, in the order an autopilot given by URL plays them, and the simulator's known deviations."""

from __future__ import annotations

from tests.conformance import (
    rows_arming,
    rows_flight,
    rows_link,
    rows_missions,
    rows_offboard,
    rows_parameters,
    rows_state,
)
from tests.conformance.vocabulary import Row

_TABLES = (rows_link, rows_parameters, rows_state, rows_arming, rows_offboard, rows_flight, rows_missions)
ROWS: tuple[Row, ...] = tuple(row for table in _TABLES for row in table.ROWS)
DEVIATIONS: dict[str, str] = {}  # name of a row: why the simulator differs from the sheet on purpose
