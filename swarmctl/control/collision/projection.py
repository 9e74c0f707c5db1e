"""Projection onto a polyhedron, exact, for few dimensions and rows, in plain Python.

Rows are added one after the other. A row that the projection so far violates is active at the next one (strict
convexity), so the search continues in the row's plane, one dimension lower, with the rows before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

from swarmctl.core.ordered_sums import dot

Vector: TypeAlias = tuple[float, ...]
Row: TypeAlias = tuple[Vector, float]  # normal (n,) and offset of `normal . x >= offset`

_PARALLEL = 1e-9
_EPS = 1e-9


def project(wanted: Vector, rows: Sequence[Row]) -> Vector | None:
    """Return the x (n,) nearest to `wanted` (n,) with `normal . x >= offset` for every row; None if there is none."""
    found = wanted
    for i, (normal, offset) in enumerate(rows):
        length = math.sqrt(dot(normal, normal))
        short = offset - dot(normal, found)
        if short <= _EPS * max(1.0, length):
            continue
        if length < _PARALLEL:
            return None
        unit = tuple(c / length for c in normal)
        within = _project_onto_plane(wanted, unit, offset / length, rows[:i])
        if within is None:
            return None
        found = within
    return found


def project_or_violate_least(wanted: Vector, soft: Sequence[Row], hard: Sequence[Row], weight: float) -> Vector:
    """Project onto all rows; if no point meets them, meet `hard` and violate `soft` as little as possible.

    Args:
        wanted: (n,) point to project.
        soft, hard: rows; some point has to meet all hard ones.
        weight: weight of the squared largest violation of a unit soft row against the squared distance from `wanted`.
    """
    found = project(wanted, [*hard, *soft])
    if found is not None:
        return found
    share = 1.0 / math.sqrt(weight)  # one more coordinate: the slack of all soft rows, in the same metric
    extended = [((*normal, 0.0), offset) for normal, offset in hard]
    extended.append(((0.0,) * len(wanted) + (1.0,), 0.0))
    extended += [((*normal, share), offset) for normal, offset in soft]
    found = project((*wanted, 0.0), extended)
    return wanted if found is None else found[:-1]


def _project_onto_plane(wanted: Vector, unit: Vector, offset: float, rows: Sequence[Row]) -> Vector | None:
    """Project as `project` does, within the plane `unit . x = offset`."""
    shift = offset - dot(unit, wanted)
    foot = tuple(w + shift * u for w, u in zip(wanted, unit, strict=True))
    if len(wanted) == 1:
        kept = all(o - n[0] * foot[0] <= _EPS * max(1.0, abs(n[0])) for n, o in rows)
        return foot if kept else None
    mirror, scale = _mirror(unit)
    flat: list[Row] = []
    for normal, row_offset in rows:
        along = scale * dot(mirror, normal)
        inside = tuple(n - along * m for n, m in zip(normal[1:], mirror[1:], strict=True))
        left = row_offset - dot(normal, foot)
        size = math.sqrt(dot(inside, inside))
        if size < _PARALLEL:
            if left > _EPS:
                return None
            continue
        flat.append((inside, left))
    found = project((0.0,) * (len(wanted) - 1), flat)
    if found is None:
        return None
    along = scale * dot(mirror[1:], found)
    return tuple(f + x - along * m for f, x, m in zip(foot, (0.0, *found), mirror, strict=True))


def _mirror(unit: Vector) -> tuple[Vector, float]:
    """Return m (n,) and scale of the Householder reflection x - scale (m . x) m that maps `unit` to the first axis."""
    first = unit[0] + math.copysign(1.0, unit[0])
    mirror = (first, *unit[1:])
    return mirror, 2.0 / dot(mirror, mirror)
