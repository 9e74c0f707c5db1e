"""The shortest path in the plane around discs: Dijkstra's algorithm on a grid, then shortcuts between corners.

Only an agent that stands before something asks for it (`swarmctl.control.reference.deadlock`): the MPC looks 0.8 s
ahead and cannot know on which side a wall ends. Cells inside a disc are passable at a price, so there is always an
answer, also from inside a disc and through gaps that the grid is too coarse for. Between discs that overlap there is
no gap: who stands there already, as far from either end of it, would else try to squeeze through for ever.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from swarmctl.core.types import Array

_CELLS = 60  # along the longer side
_EDGE_CELLS = 0.7  # a cell this far inside a disc may still hold a free point
_PRICE_INSIDE = 1000.0  # price of a metre farther inside, or outside of the sides
_PRICE_THROUGH = 1e5  # price of a metre between two discs that overlap
_NEAREST = 9  # cells among which that of a place is chosen
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))


class Polyline:
    """A polyline in the plane, parametrised by arc length.

    Args:
        corners: (K, 2) points [m], at least 2.
    """

    def __init__(self, corners: Array) -> None:
        self.corners = corners
        self._legs = np.diff(corners, axis=0)
        self._lengths_m = np.maximum(np.linalg.norm(self._legs, axis=1), 1e-9)
        self._reached_m = np.concatenate([[0.0], np.cumsum(self._lengths_m)])
        self.length_m = float(self._reached_m[-1])

    def arc_length_m(self, here: Array) -> float:
        """Return the arc length [m] of the point nearest to `here` (2,); the largest of several."""
        share = np.clip(((here - self.corners[:-1]) * self._legs).sum(axis=1) / self._lengths_m**2, 0.0, 1.0)
        distance = np.linalg.norm(self.corners[:-1] + share[:, None] * self._legs - here, axis=1)
        leg = len(distance) - 1 - int(np.argmin(distance[::-1]))
        return float(self._reached_m[leg] + share[leg] * self._lengths_m[leg])

    def remainder(self, here: Array) -> Polyline:
        """Return the part from `here` (2,) to the end."""
        ahead = self._reached_m[1:] > self.arc_length_m(here)
        ahead[-1] = True
        return Polyline(np.vstack([here, self.corners[1:][ahead]]))

    def sample(self, along_m: Array) -> tuple[Array, Array]:
        """Return points and unit directions, (K, 2) each, at arc lengths (K,); past the end the end, direction 0."""
        leg = np.clip(np.searchsorted(self._reached_m, along_m, side="right") - 1, 0, len(self._legs) - 1)
        unit = self._legs[leg] / self._lengths_m[leg, None]
        here_m = np.minimum(along_m, self.length_m) - self._reached_m[leg]
        return self.corners[leg] + here_m[:, None] * unit, np.where((along_m < self.length_m)[:, None], unit, 0.0)

    def is_clear(self, discs: Array) -> bool:
        """Tell whether the polyline stays outside `discs` (M, 3)."""
        return all(clear(a, b, discs) for a, b in itertools.pairwise(self.corners))


def shortest_path(
    start: Array,
    goal: Array,
    discs: Array,
    cell_m: float,
    *,
    squeeze: float = 3.0,
    sides: tuple[Array, Array] | None = None,
) -> Polyline:
    """Return a short path from `start` (2,) to `goal` (2,) outside `discs`.

    Args:
        start, goal: first and last point [m].
        discs: (M, 3) north, east and radius [m].
        cell_m: least cell size of the grid; it grows with the area.
        squeeze: price of a metre through a gap that the grid cannot resolve.
        sides: normals (S, 2) and offsets (S,) of half-planes `normal . point >= offset` to stay in; None for none.
    """
    if clear(start, goal, discs):
        return Polyline(np.stack([start, goal]))
    points, shape, step_m = _grid(start, goal, discs, cell_m)
    price = np.ones(len(points))
    for x, y, radius in discs:
        distance = np.hypot(points[:, 0] - x, points[:, 1] - y)
        price[distance < radius] = np.maximum(price[distance < radius], min(squeeze, _PRICE_INSIDE))
        price[distance < radius - _EDGE_CELLS * step_m] = _PRICE_INSIDE
    if sides is not None:
        price[(points @ sides[0].T < sides[1]).any(axis=1)] = _PRICE_INSIDE
    walls = _walls(discs)
    first, last = _nearest(points, start, walls), _nearest(points, goal, walls)
    edges = _edges(price, points, walls, shape=shape, step_m=step_m)
    _, before = dijkstra(edges, directed=False, indices=last, return_predecessors=True)
    cells = [first]
    while cells[-1] != last and before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    return _tightened(np.vstack([start, points[cells[1:-1]], goal]), discs)


def clear(a: Array, b: Array, discs: Array) -> bool:
    """Tell whether the segment from `a` (2,) to `b` (2,) stays outside all discs; it may leave one it begins in."""
    if not len(discs):
        return True
    step = b - a
    length2 = max(float(step @ step), 1e-12)
    from_a = discs[:, :2] - a
    along = np.clip(from_a @ step / length2, 0.0, 1.0)
    nearest = np.linalg.norm(from_a - along[:, None] * step, axis=1)
    leaves = (np.linalg.norm(from_a, axis=1) < discs[:, 2]) & (along <= 0.0)
    return bool(((nearest >= discs[:, 2]) | leaves).all())


def _grid(start: Array, goal: Array, discs: Array, cell_m: float) -> tuple[Array, tuple[int, int], float]:
    """Return points (rows * columns, 2), shape and cell size of a grid around all discs, with room to pass outside."""
    largest_m = float(discs[:, 2].max())
    corners = np.vstack([start, goal, discs[:, :2] - discs[:, 2:], discs[:, :2] + discs[:, 2:]])
    low, high = corners.min(axis=0) - largest_m, corners.max(axis=0) + largest_m
    step_m = max(cell_m, float((high - low).max()) / _CELLS)
    shape = (math.ceil((high[0] - low[0]) / step_m) + 1, math.ceil((high[1] - low[1]) / step_m) + 1)
    rows, columns = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    return low + step_m * np.stack([rows.ravel(), columns.ravel()], axis=1), shape, step_m


def _walls(discs: Array) -> Array:
    """Return the segments (W, 2, 2) between the centres of discs that overlap: who passes between them crosses it."""
    pairs = itertools.combinations(discs, 2)
    found = [(a[:2], b[:2]) for a, b in pairs if math.dist(a[:2], b[:2]) < a[2] + b[2]]
    return np.array(found).reshape(-1, 2, 2)


def _nearest(points: Array, here: Array, walls: Array) -> int:
    """Return the index of the point (K, 2) that is nearest to a place (2,) on its side of the walls near it."""
    away2 = ((points - here) ** 2).sum(axis=1)
    nearest = np.argsort(away2)[:_NEAREST]
    beyond = np.zeros(len(nearest), dtype=bool)
    for wall in walls:
        beyond |= _crosses(np.tile(here, (len(nearest), 1)), points[nearest], wall)
    return int(nearest[np.argmin(beyond)])


def _edges(price: Array, points: Array, walls: Array, *, shape: tuple[int, int], step_m: float) -> csr_array:
    """Return edges between each cell and its eight neighbours, each edge once; those through walls are the dearest."""
    index = np.arange(len(price)).reshape(shape)
    starts, ends, lengths = [], [], []
    for down, right in _NEIGHBOURS:
        starts.append(index[: shape[0] - down, max(0, -right) : shape[1] - max(0, right)].ravel())
        ends.append(index[down:, max(0, right) : shape[1] + min(0, right)].ravel())
        lengths.append(np.full(len(starts[-1]), step_m * math.hypot(down, right)))
    start, end = np.concatenate(starts), np.concatenate(ends)
    dear = np.maximum(price[start], price[end])
    for wall in walls:
        low, high = wall.min(axis=0) - 2.0 * step_m, wall.max(axis=0) + 2.0 * step_m
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1)[start])
        dear[near[_crosses(points[start[near]], points[end[near]], wall)]] = _PRICE_THROUGH
    return csr_array((np.concatenate(lengths) * dear, (start, end)), shape=(len(price), len(price)))


def _crosses(a: Array, b: Array, wall: Array) -> NDArray[np.bool_]:
    """Return which of the segments from `a` to `b`, (K, 2) each, cross a wall (2, 2)."""
    along = wall[1] - wall[0]
    side_a, side_b = _cross(along, a - wall[0]), _cross(along, b - wall[0])
    step = b - a
    ends = _cross(step, wall[0] - a) * _cross(step, wall[1] - a)
    found: NDArray[np.bool_] = (side_a * side_b <= 0.0) & (ends <= 0.0)
    return found


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _tightened(points: Array, discs: Array) -> Polyline:
    """Return the polyline through as few of `points` (K, 2) as clear segments allow."""
    kept = [0]
    while kept[-1] < len(points) - 1:
        here = kept[-1]
        straight = [k for k in range(here + 2, len(points)) if clear(points[here], points[k], discs)]
        kept.append(straight[-1] if straight else here + 1)
    return Polyline(points[kept])
