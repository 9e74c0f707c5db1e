"""The smallest distance of any two vehicles at each instant, from sampled positions."""

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
