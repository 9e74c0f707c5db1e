"""Several agents sent to one point: each takes a place of its own round it, so that they come to rest in order.

Left to themselves they push for ever, and stop wherever they happen to block each other: of three, one on the goal and
two beside it, a sum of distances 18 % above the least. The places are those points of a triangular lattice whose sum of
distances to the goal is least. Everybody knows all starts and goals and works out the same places: there is nothing to
agree on in flight, and no leader to lose.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from swarmctl.core.types import Array

ROOM = 1.05  # places are this much farther apart than agents keep: nobody pushes once all are there
_CENTRES = 13  # tried along each edge of a lattice triangle
_TURNS = 72
_ROUNDS = 30
_FAIR = 1e-4  # of equal sums the one with the least unequal distances
_TINY_M = 1e-6  # computers that round differently must still choose alike


def assigned_goals_ned_m(starts_ned_m: Array, goals_ned_m: Array, apart_m: float) -> tuple[Array, list[list[int]]]:
    """Goals (N, 3) that can all be reached at once, and who shares a goal with whom.

    Args:
        starts_ned_m: (N, 3) who comes from where.
        goals_ned_m: (N, 3) where each is sent.
        apart_m: distance that agents keep.

    Returns:
        Places at the height of the goal; the given ones of whoever is alone. Groups of agents, each in order.
    """
    places, groups = goals_ned_m.copy(), [[agent] for agent in range(len(goals_ned_m))]
    while len(merged := _merged(places, groups, apart_m)) < len(groups):
        groups = merged
        for members in groups:
            if len(members) > 1:
                center = goals_ned_m[members].mean(axis=0)
                offsets = ROOM * apart_m * arrangement(len(members))
                places[members] = center
                places[members, :2] += _assigned(starts_ned_m[members, :2] - center[:2], offsets)
    return places, groups


def arrangement(count: int) -> Array:
    """Points (count, 2), a distance of 1 or more apart, whose sum of distances to the origin is about the least."""
    reach = math.ceil(math.sqrt(count)) + 2
    rows, columns = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij")
    lattice = np.stack([columns + 0.5 * rows, math.sqrt(0.75) * rows], axis=-1).reshape(-1, 2)
    best, least = lattice[:count], math.inf
    for i, j in itertools.product(range(_CENTRES), repeat=2):
        if i + j >= _CENTRES:
            continue
        u, v = i / (_CENTRES - 1), j / (_CENTRES - 1)
        points = _round_median(lattice, np.array([u + 0.5 * v, math.sqrt(0.75) * v]), count)
        total = float(np.linalg.norm(points, axis=1).sum()) + _FAIR * float((points**2).sum())
        if total < least - _TINY_M:
            best, least = points, total
    return best


def _round_median(lattice: Array, center: Array, count: int) -> Array:
    """The `count` lattice points nearest to `center` (2,), as seen from their own geometric median (Weiszfeld)."""
    chosen = lattice[np.argsort(np.round(np.linalg.norm(lattice - center, axis=1), 6), kind="stable")[:count]]
    for _ in range(_ROUNDS):
        weight = 1.0 / np.maximum(np.linalg.norm(chosen - center, axis=1), 1e-9)
        center = weight @ chosen / weight.sum()
    return np.asarray(chosen - center)


def _merged(places: Array, groups: list[list[int]], apart_m: float) -> list[list[int]]:
    """Groups (of agents, in order) joined where a place of one is too close to a place of another."""
    merged: list[list[int]] = []
    for group in groups:
        near = [m for m in merged if _min_distance_m(places[m], places[group]) < apart_m - _TINY_M]
        merged = [m for m in merged if m not in near] + [sorted(itertools.chain(group, *near))]
    return sorted(merged)


def _min_distance_m(some: Array, others: Array) -> float:
    return float(np.linalg.norm(some[:, None] - others[None], axis=2).min())


def _assigned(starts: Array, places: Array) -> Array:
    """Places (N, 2), turned about the origin and dealt out so that ways from `starts` (N, 2) are short.

    No two would gain by exchanging theirs, so ways flown in the same time cross as little as they can.
    """
    best, least = places, math.inf
    for turn in range(_TURNS):
        angle = 2.0 * math.pi * turn / _TURNS
        c, s = math.cos(angle), math.sin(angle)
        dealt = _exchanged(starts, places @ np.array([[c, s], [-s, c]]))
        total = float(((dealt - starts) ** 2).sum())
        if total < least - _TINY_M:
            best, least = dealt, total
    return best


def _exchanged(starts: Array, places: Array) -> Array:
    places, settled = places.copy(), False
    while not settled:
        settled = True
        for i, j in itertools.combinations(range(len(starts)), 2):
            if float((starts[i] - starts[j]) @ (places[i] - places[j])) < -_TINY_M:
                places[[i, j]] = places[[j, i]]
                settled = False
    return places
