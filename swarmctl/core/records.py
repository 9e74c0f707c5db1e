"""The byte layout of per-tick records, on the bus and in run files.

`TICK_DTYPE` holds the columns of one tick of an agent, `TRUTH_DTYPE` one true state of a simulated vehicle. Both are
little-endian and of fixed size, so a file of them is an array.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.tick_record import COLUMNS, TickRecord
from swarmctl.core.types import Array, Plan

TICK_DTYPE = np.dtype([(column.name, column.dtype, (column.size,) if column.size else ()) for column in COLUMNS])

TRUTH_DTYPE = np.dtype(
    [
        ("t_us", "<i8"),  # monotonic clock of the simulator's host
        ("vehicle", "<u2"),  # 0-based
        ("pos_ned_m", "<f8", (3,)),  # shared frame, true
        ("vel_ned_m_s", "<f8", (3,)),
        ("q_nb", "<f4", (4,)),
        ("armed", "u1"),
        ("landed", "u1"),  # core.types.Landed
        ("flight_mode", "u1"),  # core.types.FlightMode
    ]
)

_PLAN_HEADER = struct.Struct("<H")
_NO_PLAN = np.empty((0, 3))


def tick_row(record: TickRecord) -> NDArray[np.void]:
    """Return one record as a (1,) structured array of `TICK_DTYPE`."""
    row = np.zeros(1, TICK_DTYPE)
    row[0] = tuple(column.recorded(record) for column in COLUMNS)
    return row


def pack_tick(row: NDArray[np.void], flown: Plan | None) -> bytes:
    """Encode a tick for the bus: its row, the number of points of the flown plan (u16), the points as float32."""
    plan = np.ascontiguousarray(_NO_PLAN if flown is None else flown.pos_ned_m, dtype="<f4")
    return row.tobytes() + _PLAN_HEADER.pack(len(plan)) + plan.tobytes()


def unpack_tick(payload: bytes) -> tuple[NDArray[np.void], Array] | None:
    """Decode the bytes of `pack_tick` to the (1,) row and the plan (M, 3); None when the length does not fit."""
    size = TICK_DTYPE.itemsize
    if len(payload) < size + _PLAN_HEADER.size:
        return None
    (points,) = _PLAN_HEADER.unpack_from(payload, size)
    body = payload[size + _PLAN_HEADER.size :]
    if len(body) != 12 * points:
        return None
    return np.frombuffer(payload, TICK_DTYPE, 1), np.frombuffer(body, "<f4").reshape(-1, 3).astype(np.float64)
