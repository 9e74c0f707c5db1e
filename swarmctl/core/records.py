"""The byte layout of per-tick records: one table serves the bus, the run files and every reader.

`TICK_DTYPE` holds one tick of an agent, `TRUTH_DTYPE` one true state of a simulated vehicle. Both are little-endian and
of fixed size, so a file of them is an array.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import Array, TickRecord

TICK_DTYPE = np.dtype(
    [
        ("t_us", "<i8"),
        ("utc_us", "<i8"),
        ("seq", "<u4"),
        ("mission_t_s", "<f8"),
        ("phase", "u1"),
        ("mode", "u1"),
        ("flight_mode", "u1"),
        ("armed", "u1"),
        ("state_age_ms", "<f4"),
        ("pos_ned_m", "<f8", (3,)),
        ("vel_ned_m_s", "<f8", (3,)),
        ("q_nb", "<f4", (4,)),
        ("ref_pos_ned_m", "<f8", (3,)),
        ("setpoint_q_nb", "<f4", (4,)),
        ("setpoint_thrust_01", "<f4"),
        ("hover_thrust_01", "<f4"),
        ("disturbance_ned_m_s2", "<f4", (3,)),
        ("nearest_peer_m", "<f4"),
        ("nearest_obstacle_m", "<f4"),
        ("plan_staleness_ms", "<f4"),
        ("peers", "<u2"),
        ("rejected", "<u4"),
        ("plan_status", "u1"),
        ("slack_m", "<f4"),
        ("residual_m", "<f4"),
        ("iterations", "<u4"),
        ("solve_ms", "<f4"),
        ("tick_ms", "<f4"),
        ("deadline_misses", "<u4"),
        ("safety_filter_acted", "u1"),
    ]
)

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
_TICK_FIELDS = TICK_DTYPE.names or ()


def tick_row(record: TickRecord) -> NDArray[np.void]:
    """Return one record as a (1,) structured array of `TICK_DTYPE`."""
    row = np.zeros(1, TICK_DTYPE)
    row[0] = tuple(getattr(record, name) for name in _TICK_FIELDS)
    return row


def pack_tick(record: TickRecord) -> bytes:
    """Encode a record for the bus: a fixed row, the number of plan points (u16), and the points as float32."""
    plan = np.ascontiguousarray(record.plan_pos_ned_m, dtype="<f4")
    return tick_row(record).tobytes() + _PLAN_HEADER.pack(len(plan)) + plan.tobytes()


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
