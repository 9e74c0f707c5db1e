"""The geofence of a configuration: one polygon within which autopilots keep their vehicles by themselves. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pydantic import Field

from swarmctl.core.params import Params, Vec2

_LEAST_CORNERS = 3


class GeofenceParams(Params):
    """A fence that `check --apply` uploads to PX4; what happens at it is PX4's GF_ACTION."""

    corners_ne_m: tuple[Vec2, ...] = Field((), strict=False, max_length=40)  # of one polygon; empty: no fence

    def problems(self, starts_ned_m: Sequence[tuple[float, float, float]]) -> Iterator[str]:
        """Yield what is wrong with the fence, given the start (north, east, down) [m] of every agent."""
        corners = self.corners_ne_m
        if not corners:
            return
        if len(corners) < _LEAST_CORNERS:
            yield f"geofence.corners_ne_m: {len(corners)} corners are no polygon; list {_LEAST_CORNERS} or more"
            return
        outside = [agent for agent, start in enumerate(starts_ned_m) if not is_inside(start[:2], corners)]
        if outside:
            yield f"geofence.corners_ne_m: the starts of agents {outside} lie outside; move the corners or the starts"


def is_inside(at_ne_m: tuple[float, float], corners_ne_m: Sequence[tuple[float, float]]) -> bool:
    """Return whether a position lies inside a polygon, by the number of edges that a ray to the east crosses."""
    north, east = at_ne_m
    inside = False
    for (n0, e0), (n1, e1) in zip(corners_ne_m, [*corners_ne_m[1:], corners_ne_m[0]], strict=True):
        if (n0 > north) != (n1 > north) and east < e0 + (north - n0) / (n1 - n0) * (e1 - e0):
            inside = not inside
    return inside
