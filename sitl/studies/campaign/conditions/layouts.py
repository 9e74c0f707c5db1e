"""Seeded geometry of scenarios: starts, goals, columns and walls. Pure numpy; metres, shared NED."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.core.types import Array

_TRIES = 2000
_RESTARTS = 200
_NUDGE_M = 1e-3


def ring(agents: int, radius_m: float, turn_rad: float) -> Array:
    """Return the corners (N, 3) of a regular polygon at z = 0, the first one at `turn_rad`."""
    angle = turn_rad + 2.0 * math.pi * np.arange(agents) / agents
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(agents)], axis=1)


def nudged(starts_ned_m: Array, seed: int) -> Array:
    """Return places (N, 3) shifted by up to a millimetre in the plane; seed 0 leaves them unchanged."""
    offsets = np.zeros(starts_ned_m.shape)
    if seed:
        offsets[:, :2] = np.random.default_rng(seed).uniform(-_NUDGE_M, _NUDGE_M, (len(starts_ned_m), 2))
    return starts_ned_m + offsets


def scattered(rng: np.random.Generator, count: int, low_m: Array, high_m: Array, *, apart_m: float) -> Array:
    """Return uniform points (count, D) of a box, drawn again until no two are closer than `apart_m`.

    Raises:
        ValueError: they don't fit.
    """
    for _ in range(_RESTARTS):
        points = np.empty((0, len(low_m)))
        for _ in range(_TRIES):
            drawn = rng.uniform(low_m, high_m)
            if len(points) == 0 or np.linalg.norm(points - drawn, axis=1).min() >= apart_m:
                points = np.vstack([points, drawn])
            if len(points) == count:
                return points
    raise ValueError(f"{count} points {apart_m} m apart don't fit between {low_m} and {high_m}")


def far_goals(
    rng: np.random.Generator, starts: Array, low_m: Array, high_m: Array, *, apart_m: float, way_m: float
) -> Array:
    """Return goals (N, 3), `apart_m` from each other and each at least `way_m` from its own start."""
    for _ in range(_RESTARTS):
        goals = scattered(rng, len(starts), low_m, high_m, apart_m=apart_m)
        for _ in range(_TRIES):
            goals = rng.permutation(goals)
            if np.linalg.norm(goals - starts, axis=1).min() >= way_m:
                return goals
    raise ValueError(f"no goals {way_m} m away from {len(starts)} starts")


def permuted(rng: np.random.Generator, starts: Array, *, way_m: float) -> Array:
    """Return the starts (N, 3) in another order, each at least `way_m` from the one it replaces.

    Raises:
        ValueError: no order was found.
    """
    order = rng.permutation(len(starts))
    for _ in range(_TRIES):
        near = np.flatnonzero(np.linalg.norm(starts[order] - starts, axis=1) < way_m)
        if len(near) == 0:
            return starts[order]
        for place in near:  # an order that is far for all is one of a million: those who are near exchange theirs
            other = int(rng.integers(len(starts)))
            order[place], order[other] = order[other], order[place]
    raise ValueError(f"no order in which {len(starts)} starts are {way_m} m from their own")


def forest(rng: np.random.Generator, columns: int, radius_m: float, apart_m: float) -> Array:
    """Return axes (columns, 3) of columns inside a circle round the origin, no two closer than `apart_m`."""
    axes: list[Array] = []
    for _ in range(_TRIES * _RESTARTS):
        drawn = rng.uniform(-radius_m, radius_m, 2)
        if math.hypot(*drawn) <= radius_m and all(math.dist(drawn, a) >= apart_m for a in axes):
            axes.append(drawn)
        if len(axes) == columns:
            return np.column_stack([np.array(axes), np.zeros(columns)])
    raise ValueError(f"{columns} columns {apart_m} m apart don't fit into {radius_m} m")


def walls(
    rng: np.random.Generator, rows_x_m: Array, half_width_m: float, wall_m: tuple[float, float], *, gap_m: float
) -> Array:
    """Return columns (M, 3), `_POST_M` apart, that form rows of walls across x with gaps between them.

    Args:
        rng: draws the lengths of the walls and the begin of each row.
        rows_x_m: x of each row.
        half_width_m: of every row, about y = 0.
        wall_m: shortest and longest wall, between the axes of its first and last post.
        gap_m: between the axes of the posts on both sides of a gap.
    """
    posts = []
    for x in rows_x_m:
        y = -half_width_m - float(rng.uniform(0.0, wall_m[1] + gap_m))
        while y < half_width_m:
            count = 1 + round(float(rng.uniform(*wall_m)) / _POST_M)
            along = y + _POST_M * np.arange(count)
            posts += [(float(x), float(p), 0.0) for p in along if abs(p) <= half_width_m]
            y = float(along[-1]) + gap_m
    return np.array(posts)


_POST_M = 0.3


def least_sum_m(count: int, apart_m: float) -> float:
    """Return the least sum of distances to one point of `count` points in the plane that keep `apart_m` apart.

    It is the best of many descents from seeded starts: a good upper bound, not a proof.
    """
    from scipy.optimize import minimize  # imports for half a second, needed by one scenario

    if count == 1:
        return 0.0
    i, j = np.triu_indices(count, 1)

    def total(flat: Array) -> float:
        return float(np.sqrt((flat.reshape(-1, 2) ** 2).sum(axis=1) + 1e-12).sum())

    def room(flat: Array) -> Array:
        points = flat.reshape(-1, 2)
        return np.asarray(((points[i] - points[j]) ** 2).sum(axis=1) - apart_m**2)

    best = math.inf
    rng = np.random.default_rng([count, _LEAST])
    for _ in range(_DESCENTS):
        start = rng.normal(scale=apart_m * math.sqrt(count) / 2.0, size=2 * count)
        found = minimize(total, start, method="SLSQP", constraints={"type": "ineq", "fun": room}, options=_OPTIONS)
        if room(found.x).min() > -1e-6:
            best = min(best, float(found.fun))
    return best


_LEAST = 7  # purpose of the random stream
_DESCENTS = 20
_OPTIONS = {"maxiter": 300}
