"""Goal assignment: agents sent to one point, at rest or moving, each get a place of their own around it.

Without it they push for ever and stay wherever they block each other: of three agents one ends on the goal and two
beside it, with a sum of distances up to 18 % above the least, and which of the two it is may be chance. The places are
those points of a triangular lattice whose sum of distances to the goal is least. Every agent knows all starts and goals
and computes the same places, so nothing has to be agreed in flight and no leader can be lost.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from swarmctl.control.reference.least_assignment import least_assignment
from swarmctl.core.types import Array

ROOM = 1.05  # places are this much farther apart than agents keep, so that no agent pushes once all have arrived
_CENTRE_SAMPLES = 13  # candidate centres along each edge of a lattice triangle
_ROTATIONS = 72
_ITERATIONS = 30
_FAIRNESS = 1e-4  # weight of the sum of squares, which breaks ties in favour of equal distances
_TINY_M, _TINY_M2 = 1e-6, 1e-6  # above rounding: all computers must choose alike


def assigned_goals_ned_m(
    starts_ned_m: Array, goals_ned_m: Array, apart_m: float, room: float = ROOM
) -> tuple[Array, list[list[int]]]:
    """Return goals (N, 3) NED [m] that all agents can occupy at once, and the groups that share a goal.

    Args:
        starts_ned_m: (N, 3) start of each agent.
        goals_ned_m: (N, 3) requested goal of each agent.
        apart_m: distance that agents keep.
        room: factor by which places are farther apart.

    Returns:
        Places at the height of the goal; an agent that shares none keeps its own. Groups of agent indices, sorted.
    """
    places, groups = goals_ned_m.copy(), [[agent] for agent in range(len(goals_ned_m))]
    while len(merged := _merged(places, groups, apart_m)) < len(groups):
        groups = merged
        for members in groups:
            if len(members) > 1:
                center = goals_ned_m[members].mean(axis=0)
                offsets = room * apart_m * arrangement(len(members))
                places[members] = center
                places[members, :2] += _assigned(starts_ned_m[members, :2] - center[:2], offsets)
    return places, groups


def arrangement(count: int) -> Array:
    """Return points (count, 2), at least 1 apart, whose sum of distances to the origin is about the least."""
    reach = math.ceil(math.sqrt(count)) + 2
    rows, columns = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij")
    lattice = np.stack([columns + 0.5 * rows, math.sqrt(0.75) * rows], axis=-1).reshape(-1, 2)
    best, least = lattice[:count], math.inf
    for i, j in itertools.product(range(_CENTRE_SAMPLES), repeat=2):
        if i + j >= _CENTRE_SAMPLES:
            continue
        u, v = i / (_CENTRE_SAMPLES - 1), j / (_CENTRE_SAMPLES - 1)
        points = _round_median(lattice, np.array([u + 0.5 * v, math.sqrt(0.75) * v]), count)
        total = float(np.linalg.norm(points, axis=1).sum()) + _FAIRNESS * float((points**2).sum())
        if total < least - _TINY_M:
            best, least = points, total
    return best


def _round_median(lattice: Array, center: Array, count: int) -> Array:
    """Return the `count` lattice points nearest to `center` (2,), relative to their geometric median (Weiszfeld)."""
    chosen = lattice[np.argsort(np.round(np.linalg.norm(lattice - center, axis=1), 6), kind="stable")[:count]]
    for _ in range(_ITERATIONS):
        weight = 1.0 / np.maximum(np.linalg.norm(chosen - center, axis=1), 1e-9)
        center = weight @ chosen / weight.sum()
    return np.asarray(chosen - center)


def _merged(places: Array, groups: list[list[int]], apart_m: float) -> list[list[int]]:
    """Return the groups, merged where a place of one is too close to a place of another."""
    merged: list[list[int]] = []
    for group in groups:
        near = [m for m in merged if _min_distance_m(places[m], places[group]) < apart_m - _TINY_M]
        merged = [m for m in merged if m not in near] + [sorted(itertools.chain(group, *near))]
    return sorted(merged)


def _min_distance_m(some: Array, others: Array) -> float:
    return float(np.linalg.norm(some[:, None] - others[None], axis=2).min())


def _assigned(starts: Array, places: Array) -> Array:
    """Return places (N, 2), rotated about the origin and permuted so that paths from `starts` (N, 2) are short.

    The sum of squares is the least of any permutation, so paths flown in the same time cross as little as possible.
    Squares are whole multiples of _TINY_M2: rounding of the last digit decides no tie.
    """
    best, least = places, math.inf
    for rotation in range(_ROTATIONS):
        angle = 2.0 * math.pi * rotation / _ROTATIONS
        c, s = math.cos(angle), math.sin(angle)
        rotated = places @ np.array([[c, s], [-s, c]])
        squares = ((starts[:, None] - rotated) ** 2).sum(axis=2)  # (N, N) of every agent to every place [m2]
        assigned = rotated[least_assignment(np.rint(squares / _TINY_M2))]
        total = float(((assigned - starts) ** 2).sum())
        if total < least - _TINY_M2:
            best, least = assigned, total
    return best
