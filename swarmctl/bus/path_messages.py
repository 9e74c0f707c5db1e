"""Bytes of predicted paths: a little-endian struct header, then points in hundredths of a millimetre.

After the first point, the way to the second and the bend to the third come third differences of the rounded points,
which add up to these without error, in the narrowest integers that hold them all. One byte does at steps of 20 ms while
accelerations change by less than 3 m/s2 in a step, so that 40 steps take 198 bytes.

A coarser unit would save nothing and spoil velocities: peers take them from two points, at worst 0.5 mm/s wrong on each
axis, half a metre per second with centimetres. With tenths of a millimetre OSQP takes half as many iterations again in
a problem with two peers, since all of its rows tremble from tick to tick.

A field more in the header is a new `PATH_VERSION`, which receivers of another version refuse.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from swarmctl.core.types import MAX_MARGIN_M, PredictedPath

PATH_VERSION = 2
MAX_POINTS = 250
# By how much a received point is wrong, at most: half a unit on each axis is 8.7 um. Beyond its end a path goes on
# with its last velocity, at worst 0.9 mm/s wrong; in the first 0.5 ms that is up to 0.1 um more than the margin for the
# age of a path, and less from then on.
ROUNDING_M = 1e-5
_UNITS_PER_M = 1e5
_FARTHEST = 1e12  # units; states are refused from 100 km on
_NOWHERE = -(2**62)  # first coordinate of a path with a point that is too far or not a number
_HEADER = struct.Struct(
    "<2sBBIIIqifBB2x"
)  # magic, version, width, agent, boot, seq, t0, dt, margin, points, own length
_MAGIC = b"SP"
_BEGIN = struct.Struct("<3q6i")  # first point, way to the second, bend to the third
_TWISTS = {width: np.dtype(f"<i{width}") for width in (1, 2, 4)}  # third differences, by bytes of a number
_LARGEST = 2.0**31  # way, bend or twist


def encode_path(path: PredictedPath) -> bytes:
    """Encode a predicted path; peers refuse one with points that are too far or no numbers."""
    points = np.rint(path.pos_ned_m * _UNITS_PER_M)
    ways = points[1:] - points[:-1]
    bends = ways[1:] - ways[:-1]
    twists = bends[1:] - bends[:-1]
    first, others = points[0].tolist(), [*ways[:1].ravel().tolist(), *bends[:1].ravel().tolist()]
    most = float(np.maximum.reduce(np.abs(twists), axis=None, initial=0.0))
    width = 1 if most < 2.0**7 else 2 if most < 2.0**15 else 4
    begin = [0] * 9
    if all(abs(n) < _FARTHEST for n in first) and all(abs(n) < _LARGEST for n in (*others, most)):
        begin[: 3 + len(others)] = map(int, first + others)
    else:
        begin[0], twists = _NOWHERE, np.zeros_like(twists)
    header = _HEADER.pack(
        _MAGIC,
        PATH_VERSION,
        width,
        path.agent,
        path.boot_id,
        path.seq,
        path.t0_utc_us,
        path.dt_us,
        path.margin_m,
        len(points),
        _HEADER.size,
    )
    return header + _BEGIN.pack(*begin) + bytes(twists.astype(_TWISTS[width]))


def decode_path(payload: bytes) -> PredictedPath | None:
    """Decode a path, with `ROUNDING_M` more margin; None unless magic, version, lengths and all numbers are valid."""
    if len(payload) < _HEADER.size:
        return None
    magic, version, width, agent, boot_id, seq, t0_utc_us, dt_us, margin_m, count, size = _HEADER.unpack_from(payload)
    if magic != _MAGIC or version != PATH_VERSION or size < _HEADER.size or width not in _TWISTS:
        return None
    first, further = size + _BEGIN.size, 3 * max(0, count - 3)
    if not 2 <= count <= MAX_POINTS or dt_us <= 0 or len(payload) != first + width * further:
        return None
    begin = _BEGIN.unpack_from(payload, size)
    if not (math.isfinite(margin_m) and 0.0 <= margin_m <= MAX_MARGIN_M and max(map(abs, begin)) < _FARTHEST):
        return None
    numbers = np.empty(9 + further)
    numbers[:9] = begin
    numbers[9:] = np.frombuffer(payload, _TWISTS[width], further, first)
    points = numbers.reshape(-1, 3)
    for behind in (points[2:], points[1:], points):  # twists to bends to ways; sums of whole numbers are exact
        np.add.accumulate(behind, axis=0, out=behind)
    points /= _UNITS_PER_M
    return PredictedPath(
        agent=agent,
        boot_id=boot_id,
        seq=seq,
        t0_utc_us=t0_utc_us,
        dt_us=dt_us,
        margin_m=margin_m + ROUNDING_M,
        pos_ned_m=points[:count],
    )
