"""The matrix: all rows, by name."""

from __future__ import annotations

from itertools import chain

from tests.faults import (
    rows_agents,
    rows_bus,
    rows_descents,
    rows_elsewhere,
    rows_processes,
    rows_solver,
    rows_start,
    rows_vehicle,
)
from tests.faults.row import Row

PARTS: tuple[tuple[str, tuple[Row, ...]], ...] = (
    ("Solver and plans", rows_solver.ROWS),
    ("Peers and the bus", rows_bus.ROWS),
    ("Agents, hosts, clocks, processors", rows_agents.ROWS),
    ("Vehicles, autopilots, pilots", rows_vehicle.ROWS),
    ("A vehicle that comes down above another or an obstacle", rows_descents.ROWS),
    ("Around the start", rows_start.ROWS),
    ("Tests that are rows", rows_elsewhere.ROWS),
    ("Processes, disk, descriptors, terminal, start", rows_processes.ROWS),
)
ROWS: dict[str, Row] = {row.name: row for row in chain.from_iterable(rows for _, rows in PARTS)}
assert len(ROWS) == sum(len(rows) for _, rows in PARTS), "two rows of one name"
