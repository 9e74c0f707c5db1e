"""All rows, in the order an autopilot given by URL plays them, and the simulator's known deviations.

Those on the ground come before those in the air, so that it seldom lands, and those that need a reboot together.
"""

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
from tests.conformance.vocabulary import Row, State

_TABLES = (rows_link, rows_parameters, rows_state, rows_arming, rows_offboard, rows_flight, rows_missions)
_STARTS = tuple(State)
ROWS: tuple[Row, ...] = tuple(
    sorted((row for table in _TABLES for row in table.ROWS), key=lambda row: (row.spoils, _STARTS.index(row.start)))
)
DEVIATIONS: dict[str, str] = {}  # name of a row: why the simulator differs from the sheet on purpose
