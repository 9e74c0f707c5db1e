"""The smallest distances of vehicles from sampled positions: of any two at an instant, and of two between instants."""

from __future__ import annotations

import numpy as np

from swarmctl.core.types import Array


def closest_pair_m(pos_ned_m: Array) -> Array:
    """Return the smallest pairwise distance (T,) [m] of positions (T, N, 3); NaN where no two are known."""
    least_m = np.full(len(pos_ned_m), np.nan)
    for i in range(pos_ned_m.shape[1] - 1):
        apart_m = np.linalg.norm(pos_ned_m[:, i + 1 :] - pos_ned_m[:, i : i + 1], axis=2)
        least_m = np.fmin(least_m, np.fmin.reduce(apart_m, axis=1))
    return least_m


def closest_m(before: Array, now: Array) -> Array:
    """Return the least distance (M,) from the origin of points that move straight from `before` (M, D) to `now`."""
    step = now - before
    length2 = np.maximum(np.einsum("mc,mc->m", step, step), 1e-18)
    share = np.clip(-np.einsum("mc,mc->m", before, step) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(before + share[:, None] * step, axis=1))
