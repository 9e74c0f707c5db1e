"""Fewer points for a curve: over time its extremes are kept, on a map its shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import Array

_FINEST_PX = 0.2  # a tenth of the width of a line
_MOST_LOOKED_AT = 20_000  # points of one curve, a few minutes of flight


def thin(x: Array, y: Array, points: int) -> tuple[Array, Array]:
    """Return at most `points` points of a curve (T,), with the smallest and largest value of every part."""
    if len(x) <= points:
        return x, y
    buckets = np.array_split(np.arange(len(x)), max(1, points // 2))
    kept: list[int] = []
    for bucket in buckets:
        values = y[bucket]
        if not np.isfinite(values).any():
            kept.append(int(bucket[0]))
            continue
        kept += sorted({int(bucket[np.nanargmin(values)]), int(bucket[np.nanargmax(values)])})
    chosen = np.array(kept)
    return x[chosen], y[chosen]


def evenly_spaced(count: int, points: int) -> NDArray[np.intp]:
    """Return at most `points` indices (K,), evenly spread over `count`."""
    return np.unique(np.linspace(0, max(0, count - 1), min(points, count)).astype(np.intp))


def shape_of(px: Array, py: Array, points: int) -> tuple[Array, Array]:
    """Return a curve (T,) in pixels with few points, everywhere within a hair of where it was; NaN interrupts it.

    Where more than `points` are needed the curve may be farther off, twice as far until they are enough.
    """
    looked_at = evenly_spaced(len(px), _MOST_LOOKED_AT)
    px, py = px[looked_at], py[looked_at]
    known = np.isfinite(px) & np.isfinite(py)
    breaks = np.flatnonzero(~known & np.concatenate([[True], known[:-1]]))  # one of each gap
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]))).reshape(-1, 2)
    corners, tolerance_px = breaks, _FINEST_PX
    for _ in range(30):
        parts = [_corners(px, py, int(first), int(end) - 1, tolerance_px) for first, end in edges]
        corners = np.sort(np.concatenate([breaks, *parts]))
        if len(corners) <= max(points, len(breaks) + 2 * len(edges)):
            break
        tolerance_px *= 2.0
    return px[corners], py[corners]


def _corners(px: Array, py: Array, first: int, last: int, tolerance_px: float) -> NDArray[np.intp]:
    """Return the points that remain of `first` to `last`, which have no gap: Douglas and Peucker's."""
    kept, open_parts = {first, last}, [(first, last)]
    while open_parts:
        begin, end = open_parts.pop()
        if end - begin < 2:
            continue
        away_px = _off_chord(px[begin : end + 1], py[begin : end + 1])
        farthest = int(np.argmax(away_px))
        if away_px[farthest] > tolerance_px:
            middle = begin + farthest
            kept.add(middle)
            open_parts += [(begin, middle), (middle, end)]
    return np.array(sorted(kept), np.intp)


def _off_chord(px: Array, py: Array) -> Array:
    """Return the distances (T,) of points to the stretch from the first to the last."""
    along_x, along_y = px[-1] - px[0], py[-1] - py[0]
    squared = along_x * along_x + along_y * along_y
    from_x, from_y = px - px[0], py - py[0]
    share = np.clip((from_x * along_x + from_y * along_y) / squared, 0.0, 1.0) if squared > 0.0 else 0.0
    return np.asarray(np.hypot(from_x - share * along_x, from_y - share * along_y))
