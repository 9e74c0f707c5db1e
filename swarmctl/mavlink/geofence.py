"""The geofence of a configuration: one polygon within which autopilots keep their vehicles by themselves. Pure."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field

from swarmctl.core.params import Params, Vec2
from swarmctl.core.types import Array

_Side = tuple[Vec2, Vec2]  # begin and end
_LEAST_CORNERS = 3
_ROUNDING_M = 1e-6


class GeofenceParams(Params):
    """A fence that `check --apply` uploads to PX4; what happens at it is PX4's GF_ACTION."""

    corners_ne_m: tuple[Vec2, ...] = Field((), strict=False, max_length=40)  # of one polygon, in order; empty: no fence

    def problems(self, starts_ned_m: Sequence[tuple[float, float, float]]) -> Iterator[str]:
        """Yield what is wrong with the fence, given the start (north, east, down) [m] of every agent."""
        if problem := self._form_problem():
            yield problem
            return
        area = self.area()
        outside = [agent for agent, start in enumerate(starts_ned_m) if area and not area.contains(start[:2])]
        if outside:
            yield f"geofence.corners_ne_m: the starts of agents {outside} lie outside; move the corners or the starts"

    def area(self) -> Geofence | None:
        """Return the area that the fence encloses; None without one, and of corners that enclose none."""
        return Geofence(self.corners_ne_m) if self.corners_ne_m and not self._form_problem() else None

    def _form_problem(self) -> str:
        """Return why the corners are no polygon, or ""."""
        sides = _sides(self.corners_ne_m)
        if self.corners_ne_m and len(sides) < _LEAST_CORNERS:
            return f"geofence.corners_ne_m: {len(sides)} corners are no polygon; list {_LEAST_CORNERS} or more"
        for one, other in itertools.combinations(sides, 2):
            if _cross(one, other):
                (a, b), (c, d) = ([list(corner) for corner in side] for side in (one, other))
                return (
                    f"geofence.corners_ne_m: the side from {a} to {b} crosses or touches that from {c} to {d}; list "
                    "corners in order around an area, each once"
                )
        return ""


class Geofence:
    """An area with a polygon around it.

    Args:
        corners_ne_m: of the polygon, in order; it does not cross itself.
    """

    def __init__(self, corners_ne_m: Sequence[tuple[float, float]]) -> None:
        self._sides = np.array(_sides(corners_ne_m), np.float64)  # (S, 2, 2)

    @property
    def span(self) -> str:
        """Return in words from where to where it reaches."""
        corners = self._sides[:, 0]
        (south, west), (north, east) = corners.min(axis=0), corners.max(axis=0)
        return f"north {south:g} to {north:g} m, east {west:g} to {east:g} m"

    def beyond_m(self, at_ne_m: Array) -> Array:
        """Return how far (K,) positions (K, 2) are outside of it, 0 inside."""
        north, east = at_ne_m.T
        inside = np.zeros(len(at_ne_m), dtype=bool)
        for (n0, e0), (n1, e1) in self._sides:
            if n0 != n1:  # a ray to the east may cross it
                inside ^= ((n0 > north) != (n1 > north)) & (east < e0 + (north - n0) * ((e1 - e0) / (n1 - n0)))
        beyond_m = np.where(inside, 0.0, np.inf)
        outside_ne_m = at_ne_m[~inside]
        for begin, end in self._sides if len(outside_ne_m) else ():
            side, away = end - begin, outside_ne_m - begin
            part_01 = np.clip(away @ side / (side @ side), 0.0, 1.0)
            distance_m = np.linalg.norm(away - part_01[:, None] * side, axis=1)
            beyond_m[~inside] = np.minimum(beyond_m[~inside], distance_m)
        return beyond_m

    def contains(self, at_ne_m: Sequence[float]) -> bool:
        """Return whether a position (2,) lies in it or on its border."""
        return bool(self.beyond_m(np.array([at_ne_m], dtype=np.float64))[0] <= _ROUNDING_M)


def _sides(corners_ne_m: Sequence[Vec2]) -> list[_Side]:
    """Return the sides of a polygon; a corner that is listed again at once, as the first at the end, adds none."""
    sides = zip(corners_ne_m, [*corners_ne_m[1:], *corners_ne_m[:1]], strict=True)
    return [(begin, end) for begin, end in sides if begin != end]


def _cross(one: _Side, other: _Side) -> bool:
    """Return whether two sides have more in common than a corner at which one goes on from the other."""
    (a, b), (c, d) = one, other
    if b == c:
        return d == a or _is_between(a, d, b) or _is_between(d, a, b)
    if d == a:
        return _is_between(b, c, a) or _is_between(c, b, a)
    turns = [np.sign(_turn_m2(*three)) for three in ((a, b, c), (a, b, d), (c, d, a), (c, d, b))]
    if 0.0 not in turns:
        return bool(turns[0] != turns[1] and turns[2] != turns[3])
    return any(_is_between(*three) for three in ((c, a, b), (d, a, b), (a, c, d), (b, c, d)))


def _is_between(at: Vec2, begin: Vec2, end: Vec2) -> bool:
    """Return whether a place is on the straight way between two others, these included."""
    inside = all(min(p, q) <= k <= max(p, q) for k, p, q in zip(at, begin, end, strict=True))
    return inside and _turn_m2(begin, end, at) == 0.0


def _turn_m2(a: Vec2, b: Vec2, c: Vec2) -> float:
    """Return twice the area of a triangle, positive where the way from a by b to c turns from north to east."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
