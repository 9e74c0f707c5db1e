"""The byte layout of per-tick records, on the bus and in run files.

`TICK_DTYPE` holds the columns of one tick of an agent, `PLAN_DTYPE` those of one point of a predicted path,
`TRUTH_DTYPE` those of one true state of a simulated vehicle. All are little-endian and of fixed size, so a file of them
is an array.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.recorded.stored_column import StoredColumn, dtype_of
from swarmctl.core.recorded.tick_record import COLUMNS, TickRecord
from swarmctl.core.types import Array, FlightMode, Landed, Plan

TICK_DTYPE = dtype_of(COLUMNS)

_F4, _F8, _U1, _U2, _I8 = "<f4", "<f8", "u1", "<u2", "<i8"
TRUTH_COLUMNS = (
    StoredColumn(name="t_us", dtype=_I8, unit="us", text="monotonic clock of the simulator's host"),
    StoredColumn(name="vehicle", dtype=_U2, text="number of the vehicle, from 0"),
    StoredColumn(name="pos_ned_m", dtype=_F8, size=3, unit="m", text="true position, shared frame"),
    StoredColumn(name="vel_ned_m_s", dtype=_F8, size=3, unit="m/s", text="true velocity"),
    StoredColumn(name="q_nb", dtype=_F4, size=4, text="true attitude"),
    StoredColumn(name="armed", dtype=_U1, text="1: armed"),
    StoredColumn(name="landed", dtype=_U1, text="whether it is on the ground", names=Landed),
    StoredColumn(name="flight_mode", dtype=_U1, text="the autopilot's mode", names=FlightMode),
)
TRUTH_DTYPE = dtype_of(TRUTH_COLUMNS)

PLAN_COLUMNS = (
    StoredColumn(name="t_us", dtype=_I8, unit="us", text="monotonic time of the tick that flew the plan"),
    StoredColumn(name="at_us", dtype=_I8, unit="us", text="monotonic time of this point of it"),
    StoredColumn(name="pos_ned_m", dtype=_F4, size=3, unit="m", text="predicted position at that time"),
)
PLAN_DTYPE = dtype_of(PLAN_COLUMNS)

# code in `struct` of each number of a tick
_CODES = {_F4: "f", _F8: "d", _U1: "B", _U2: "H", "<u4": "I", _I8: "q"}
_TICK = struct.Struct("<" + "".join(f"{max(1, column.size)}{_CODES[column.dtype]}" for column in COLUMNS))
_VALUES = [(column.value, column.size, [column.none] * max(1, column.size)) for column in COLUMNS]

_PLAN_HEADER = struct.Struct("<H")
_NO_PLAN = np.empty((0, 3))
NO_POINTS = np.zeros(0, PLAN_DTYPE)


def tick_row(record: TickRecord) -> NDArray[np.void]:
    """Return one record as a (1,) structured array of `TICK_DTYPE`."""
    numbers: list[Any] = []
    for value_of, size, none in _VALUES:
        value = value_of(record)
        numbers += none if value is None else value.tolist() if size else (value,)
    try:
        return np.frombuffer(_TICK.pack(*numbers), TICK_DTYPE)
    except (struct.error, OverflowError):  # of another type, by a controller of somebody else, or too large for float32
        row = np.zeros(1, TICK_DTYPE)
        with np.errstate(over="ignore"):
            row[0] = tuple(column.recorded(record) for column in COLUMNS)
        return row


def plan_rows(row: NDArray[np.void], flown: Plan | None) -> NDArray[np.void]:
    """Return the points of the plan flown in a tick as rows (M,) of `PLAN_DTYPE`.

    Args:
        row: the tick, a (1,) array of `TICK_DTYPE`.
        flown: the plan, None without one.
    """
    if flown is None:
        return NO_POINTS
    rows = np.empty(len(flown.pos_ned_m), PLAN_DTYPE)
    rows["t_us"] = row["t_us"]
    rows["at_us"] = flown.t0_us + flown.dt_us * np.arange(len(rows))
    rows["pos_ned_m"] = flown.pos_ned_m
    return rows


def pack_tick(row: NDArray[np.void], flown: Plan | None) -> bytes:
    """Encode a tick for the bus: its row, the number of points of the flown plan (u16), the points as float32."""
    plan = (_NO_PLAN if flown is None else flown.pos_ned_m).astype(_F4)
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
