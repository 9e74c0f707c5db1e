"""Bytes of predicted paths: a little-endian struct header and float32 points.

A field more in the header is a new `PATH_VERSION`, which receivers of another version refuse.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from swarmctl.core.types import MAX_MARGIN_M, PredictedPath

PATH_VERSION = 1
MAX_POINTS = 250
_HEADER = struct.Struct(
    "<2sBBIIIqifBB2x"
)  # magic, version, flags, agent, boot, seq, t0, dt, margin, points, own length
_MAGIC = b"SP"
_NUMBER = np.dtype("<f4")


def encode_path(path: PredictedPath) -> bytes:
    """Encode a predicted path."""
    points = path.pos_ned_m.astype(_NUMBER)
    header = _HEADER.pack(
        _MAGIC,
        PATH_VERSION,
        0,
        path.agent,
        path.boot_id,
        path.seq,
        path.t0_utc_us,
        path.dt_us,
        path.margin_m,
        len(points),
        _HEADER.size,
    )
    return header + points.tobytes()


def decode_path(payload: bytes) -> PredictedPath | None:
    """Decode a path; None unless magic, version, lengths and all numbers are valid."""
    if len(payload) < _HEADER.size:
        return None
    magic, version, _, agent, boot_id, seq, t0_utc_us, dt_us, margin_m, count, header_len = _HEADER.unpack_from(payload)
    if magic != _MAGIC or version != PATH_VERSION or header_len < _HEADER.size:
        return None
    if not 2 <= count <= MAX_POINTS or dt_us <= 0 or len(payload) != header_len + 12 * count:
        return None
    numbers = np.frombuffer(payload, _NUMBER, 3 * count, header_len).astype(np.float64)
    finite = math.isfinite(numbers @ numbers)  # squares of float32 can't overflow
    if not (finite and math.isfinite(margin_m) and 0.0 <= margin_m <= MAX_MARGIN_M):
        return None
    return PredictedPath(
        agent=agent,
        boot_id=boot_id,
        seq=seq,
        t0_utc_us=t0_utc_us,
        dt_us=dt_us,
        margin_m=margin_m,
        pos_ned_m=numbers.reshape(count, 3),
    )
