"""Bytes of predicted paths: a little-endian struct header, and points as float32 or compact.

Compact points are whole multiples of a unit, a power of two between 15 micrometres and a millimetre: the first one, the
first step, and by how much each step differs from the one before, a signed byte for each axis. Those differences are
the acceleration, which is small where positions are not: 41 points take 183 bytes, as float32 534.

A field more in the header is a new version, which receivers that do not know it refuse.
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache

import numpy as np

from swarmctl.core.types import MAX_MARGIN_M, MAX_SPEED_M_S, MAX_STEP_US, MIN_STEP_US, Array, PredictedPath

FLOAT_VERSION = 3
COMPACT_VERSION = 4
MAX_POINTS = 250
# magic, version, flags, agent, boot, seq, t0, dt, margin, points, own length, exponent of the unit, acceleration
_HEADER = struct.Struct("<2sBBIIIqifBBbx3h")
_MAGIC = b"SP"
_NUMBER = np.dtype("<f4")
_BEGIN, _BEND = np.dtype("<i4"), np.dtype("i1")
_BEGIN_BYTES = 6 * _BEGIN.itemsize  # first point and first step
_FINEST, _COARSEST = -16, -10  # exponents
_FARTHEST_M = 2.0 ** (30 + _FINEST)  # 16 km; a step may be twice as long
_LARGEST_BEND = 125  # units; two fewer than fit, by which rounding positions may change a difference of steps
_REMEMBERED = 256  # paths: two of each of a hundred agents, which all hear within a tick
_HAS_SETPOINT = 1  # flag
_PER_M_S2 = 1024.0  # units of accelerations; 32 m/s2 are the most
_MOST_ACCEL = 32767
_NO_ACCEL = (0, 0, 0)
_FARTHEST_M_US = 1e-6 * MAX_SPEED_M_S
_ROUNDING_01 = 0.5 * math.sqrt(3.0)  # largest distance, in units, of a point from its rounded one


def encode_path(path: PredictedPath, *, compact: bool = False) -> bytes:
    """Encode a predicted path.

    Args:
        path: to be encoded.
        compact: whether points are rounded to fewer bytes, and the margin widened by the rounding. A path that bends
            too much for its steps, or is too far away, is encoded as float32 all the same.
    """
    exponent = _exponent(path.pos_ned_m) if compact else None
    if exponent is None:
        return _header(path, FLOAT_VERSION, path.margin_m, 0) + path.pos_ned_m.astype(_NUMBER).tobytes()
    units = np.rint(path.pos_ned_m * 2.0**-exponent)
    steps = units[1:] - units[:-1]
    bends = (steps[1:] - steps[:-1]).astype(_BEND)
    begin = np.concatenate((units[0], steps[0])).astype(_BEGIN)
    margin_m = min(MAX_MARGIN_M, path.margin_m + _ROUNDING_01 * 2.0**exponent)
    points: bytes = begin.tobytes() + bends.tobytes()
    return _header(path, COMPACT_VERSION, margin_m, exponent) + points


def _header(path: PredictedPath, version: int, margin_m: float, exponent: int) -> bytes:
    return _HEADER.pack(
        _MAGIC,
        version,
        0 if path.setpoint_accel_ned_m_s2 is None else _HAS_SETPOINT,
        path.agent,
        path.boot_id,
        path.seq,
        path.t0_utc_us,
        path.dt_us,
        margin_m,
        len(path.pos_ned_m),
        _HEADER.size,
        exponent,
        *_accel_units(path.setpoint_accel_ned_m_s2),
    )


def _accel_units(accel_ned_m_s2: Array | None) -> tuple[int, int, int]:
    """Return an acceleration (3,) in units; that of float32, as it is recorded, so that both are rounded alike."""
    if accel_ned_m_s2 is None:
        return _NO_ACCEL
    units = accel_ned_m_s2.astype(_NUMBER).astype(np.float64) * _PER_M_S2
    north, east, down = (round(max(-_MOST_ACCEL, min(_MOST_ACCEL, unit))) for unit in units.tolist())
    return north, east, down


def _exponent(pos_ned_m: Array) -> int | None:
    """Return the exponent of the finest unit in which points (K, 3) can be compact; None if they can't be."""
    if len(pos_ned_m) < 3:
        return None
    steps = pos_ned_m[1:] - pos_ned_m[:-1]
    largest_m = float(np.abs(steps[1:] - steps[:-1]).max())
    farthest_m = float(np.abs(pos_ned_m).max())
    if not (largest_m <= _LARGEST_BEND * 2.0**_COARSEST and farthest_m < _FARTHEST_M):
        return None
    return next(e for e in range(_FINEST, _COARSEST + 1) if largest_m <= _LARGEST_BEND * 2.0**e)


def stamp_us(payload: bytes) -> int:
    """Return the UTC [us] of the first point of a path, unchecked; 0 where there is none."""
    return int(_HEADER.unpack_from(payload)[6]) if len(payload) >= _HEADER.size else 0


@lru_cache(maxsize=_REMEMBERED)
def decode_path(payload: bytes) -> PredictedPath | None:
    """Decode a path; None unless magic, version, lengths and all numbers are valid, and a vehicle might fly it.

    All agents of a process that hear it share the result, whose points are read-only.
    """
    if len(payload) < _HEADER.size:
        return None
    (magic, version, flags, agent, boot_id, seq, t0_utc_us, dt_us, margin_m, count, header_len, exponent, *accel) = (
        _HEADER.unpack_from(payload)
    )
    if magic != _MAGIC or header_len < _HEADER.size or not 2 <= count <= MAX_POINTS:
        return None
    if not (MIN_STEP_US <= dt_us <= MAX_STEP_US and math.isfinite(margin_m) and 0.0 <= margin_m <= MAX_MARGIN_M):
        return None
    if version == FLOAT_VERSION:
        pos_ned_m = _points(payload[header_len:], count)
    elif version == COMPACT_VERSION:
        pos_ned_m = _compact_points(payload[header_len:], count, exponent)
    else:
        return None
    if pos_ned_m is None or _is_too_fast(pos_ned_m, dt_us):
        return None
    pos_ned_m.flags.writeable = False
    return PredictedPath(
        agent=agent,
        boot_id=boot_id,
        seq=seq,
        t0_utc_us=t0_utc_us,
        dt_us=dt_us,
        margin_m=margin_m,
        pos_ned_m=pos_ned_m,
        setpoint_accel_ned_m_s2=np.array(accel) / _PER_M_S2 if flags & _HAS_SETPOINT else None,
    )


@lru_cache(maxsize=_REMEMBERED)
def longest_step_m(payload: bytes) -> float:
    """Return the largest distance [m] of two successive points of a path; 0 where there is none."""
    path = decode_path(payload)
    if path is None:
        return 0.0
    steps_m = path.pos_ned_m[1:] - path.pos_ned_m[:-1]
    return math.sqrt(float(np.einsum("kc,kc->k", steps_m, steps_m).max()))


def _points(body: bytes, count: int) -> Array | None:
    """Return points (count, 3) NED [m] from float32; None if there are more or fewer, or any is not finite."""
    if len(body) != 3 * count * _NUMBER.itemsize:
        return None
    numbers = np.frombuffer(body, _NUMBER).astype(np.float64)
    return numbers.reshape(count, 3) if math.isfinite(numbers @ numbers) else None  # squares can't overflow


def _is_too_fast(pos_ned_m: Array, dt_us: int) -> bool:
    steps_m, most_m = pos_ned_m[1:] - pos_ned_m[:-1], _FARTHEST_M_US * dt_us
    if np.vdot(steps_m, steps_m) <= most_m * most_m:  # as nearly always; half the time of looking at each of them
        return False
    return bool(np.abs(steps_m).max() > most_m)


def _compact_points(body: bytes, count: int, exponent: int) -> Array | None:
    """Return points (count, 3) NED [m] from the first one, the first step and bends; None if lengths don't fit."""
    if count < 3 or len(body) != _BEGIN_BYTES + 3 * (count - 2) or not _FINEST <= exponent <= _COARSEST:
        return None
    units = np.empty((count, 3))
    units[:2] = np.frombuffer(body, _BEGIN, 6).reshape(2, 3)
    units[2:] = np.frombuffer(body, _BEND, offset=_BEGIN_BYTES).reshape(-1, 3)
    found: Array = _summing(count) @ units  # whole numbers below 2^53, so that sums are exact
    found *= 2.0**exponent
    return found


@lru_cache(maxsize=8)
def _summing(count: int) -> Array:
    """Return what makes points of the first one, the first step and `count - 2` bends: (count, count), read-only."""
    k = np.arange(count, dtype=np.float64)
    found = np.maximum(k[:, None] - k + 1.0, 0.0)  # a bend is in every later step
    found[:, 0], found[:, 1] = 1.0, k
    found.flags.writeable = False
    return found
