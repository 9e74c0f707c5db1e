"""Smooth flights through points: least snap, as fast as limits allow, or at given times."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import Place, SharedReference, mission_kind
from swarmctl.control.reference.minimum_snap import fastest_minimum_snap, minimum_snap
from swarmctl.control.reference.polynomial import PiecewisePolynomial
from swarmctl.core.goal import Goal
from swarmctl.core.params import Params, Vec3
from swarmctl.core.types import Sampled

_MAX_POINTS = 100  # of one agent: the equations grow with the square
_APART_M = 1e-3  # two points in a row are farther apart


class WaypointsList(Params):
    """The points of one agent, or of all if it is the only list, from the first to the last."""

    points_ned_m: tuple[Vec3, ...] = Field((), strict=False, max_length=_MAX_POINTS)  # two or more
    times_s: tuple[float, ...] = Field((), strict=False)  # one for each point, from 0 on; empty: as fast as allowed


@mission_kind("waypoints")
class WaypointsParams(SharedReference):
    """Describes flights of least snap through points, from rest to rest."""

    speed_m_s: float = Field(2.0, gt=0, le=20)  # peak of a flight without times
    accel_m_s2: float = Field(2.0, gt=0, le=20)  # peak of a flight without times
    lists: tuple[WaypointsList, ...] = Field((), strict=False)  # one for each agent, or one that all share

    @property
    def fixed_in_time(self) -> bool:
        """Return whether every agent has points of its own at given times."""
        return len(self.lists) > 1 and all(own.times_s for own in self.lists)

    def reference(self, place: Place) -> Sampled:
        return self._flight(place).sample

    def goal(self, place: Place) -> Goal | None:
        """Return the agent's last point; agents that share their points can't all be there."""
        if len(self.lists) < len(place.starts_ned_m):
            return None
        return Goal(pos_ned_m=np.array(self._list(place).points_ned_m[-1]))

    def ends_s(self, place: Place) -> float:
        return self._flight(place).end_s

    def problems(self, agents: int) -> Iterator[str]:
        if len(self.lists) not in (1, agents):
            yield (
                f"mission.waypoints.lists: {len(self.lists)} lists for swarm.agents = {agents}; "
                "give one [[mission.waypoints.lists]] for each agent, or one for all"
            )
        if self.goal_assignment and len(self.lists) > 1:
            yield "mission.waypoints.goal_assignment = true: is for lists that agents share; set it to false"
        for i, own in enumerate(self.lists):
            yield from (f"mission.waypoints.lists.{i}.{problem}" for problem in _problems(own))

    def _flight(self, place: Place) -> PiecewisePolynomial:
        own = self._list(place)
        points = np.array(own.points_ned_m)
        if own.times_s:
            return minimum_snap(np.array(own.times_s), points)
        return fastest_minimum_snap(points, self.speed_m_s, self.accel_m_s2)

    def _list(self, place: Place) -> WaypointsList:
        return self.lists[place.agent if len(self.lists) > 1 else 0]


def _problems(own: WaypointsList) -> Iterator[str]:
    points, times_s = np.array(own.points_ned_m), own.times_s
    if len(points) < 2:
        yield f"points_ned_m: {len(points)} points; a flight needs 2 or more"
        return
    near = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) < _APART_M)
    if len(near) and not times_s:
        yield f"points_ned_m: points {near[0]} and {near[0] + 1} are the same; leave one out, or give times_s"
    if times_s and len(times_s) != len(points):
        yield f"times_s: {len(times_s)} times for {len(points)} points; give one for each, or none"
    elif times_s and (times_s[0] != 0.0 or min(np.diff(times_s)) <= 0.0):
        yield f"times_s: {list(times_s)} must begin at 0 and increase"
