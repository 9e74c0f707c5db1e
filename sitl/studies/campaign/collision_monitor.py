"""Collision monitor on true states: closest approaches between samples, arrival, standstill.

Between two samples every body is taken to move in a straight line. It knows nothing of the agents' beliefs or plans.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.closest_pair import closest_m
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array

Mask = NDArray[np.bool_]

_ARRIVED_M_S = 0.2  # a faster vehicle passes through
STILL_M = 0.1  # a vehicle that moves less than this ...
_STILL_S = 3.0  # ... in this time stands still


class CollisionMonitor:
    """Evaluates every true state of one flight, in order.

    Args:
        body_m: distance of the centres of two bodies that touch.
        goals_ned_m: (N, 3), or None without goals.
        arrive_m: a slow vehicle closer than this to its goal has arrived.
        expected: (N,) vehicles whose arrival counts.
    """

    def __init__(self, body_m: float, goals_ned_m: Array | None, arrive_m: float, expected: Mask) -> None:
        self._body_m, self._goals, self._arrive_m, self._expected = body_m, goals_ned_m, arrive_m, expected
        self._pairs = np.triu_indices(len(expected), 1)
        self._before: tuple[Array, tuple[Obstacle, ...]] | None = None
        self._since_s = np.full(len(expected), math.inf)  # time of each final arrival; inf: not arrived
        self._trail: list[tuple[float, Array]] = []
        self.min_separation_m = math.inf
        self.min_clearance_m = math.inf  # of a hull from a surface

    def see(self, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array, obstacles: Sequence[Obstacle] = ()) -> None:
        """Take one sample of every vehicle (N, 3) and obstacle; a new number of obstacles restarts the comparison."""
        before_pos, before_obstacles = self._before or (pos_ned_m, tuple(obstacles))
        i, j = self._pairs
        if len(i):
            apart = closest_m((before_pos[i] - before_pos[j]), (pos_ned_m[i] - pos_ned_m[j]))
            self.min_separation_m = min(self.min_separation_m, float(apart.min()))
        if len(before_obstacles) != len(obstacles):
            before_obstacles = tuple(obstacles)
        for was, now in zip(before_obstacles, obstacles, strict=True):
            moved = (before_pos - was.center_ned_m)[:, : now.axes], (pos_ned_m - now.center_ned_m)[:, : now.axes]
            apart = closest_m(*moved)
            clearance_m = float(apart.min()) - now.radius_m - 0.5 * self._body_m
            self.min_clearance_m = min(self.min_clearance_m, clearance_m)
        self._before = (pos_ned_m, tuple(obstacles))
        self._note_arrivals(t_s, pos_ned_m, vel_ned_m_s)
        if not self._trail or t_s - self._trail[-1][0] >= 0.1:
            self._trail.append((t_s, pos_ned_m))

    @property
    def collided(self) -> bool:
        """Whether two bodies have touched, or a body and an obstacle."""
        return self.min_separation_m < self._body_m or self.min_clearance_m < 0.0

    @property
    def arrived(self) -> Mask:
        """Vehicles (N,) that are at their goals, for good so far."""
        return np.asarray(np.isfinite(self._since_s))

    @property
    def arrived_s(self) -> float:
        """Arrival time of the last expected vehicle; infinite when not all have arrived, or none is expected."""
        return float(self._since_s[self._expected].max()) if self._expected.any() else math.inf

    def standing(self, still_m: float = STILL_M) -> Mask:
        """Return the vehicles (N,) that have moved less than `still_m` in the last 3 s; none before."""
        end_s = self._trail[-1][0] if self._trail else 0.0
        recent = [pos for t_s, pos in self._trail if t_s >= end_s - _STILL_S]
        if not self._trail or end_s - self._trail[0][0] < _STILL_S:
            return np.zeros(len(self._expected), bool)
        moved = np.linalg.norm(np.stack(recent) - recent[-1], axis=2).max(axis=0)
        return np.asarray(moved < still_m)

    def distance_m(self) -> Array:
        """Return the distances (N,) to the goals at the last sample."""
        assert self._before is not None and self._goals is not None
        return np.asarray(np.linalg.norm(self._before[0] - self._goals, axis=1))

    def _note_arrivals(self, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        if self._goals is None:
            return
        near = np.linalg.norm(pos_ned_m - self._goals, axis=1) < self._arrive_m
        there = near & (np.linalg.norm(vel_ned_m_s, axis=1) < _ARRIVED_M_S)
        self._since_s = np.where(there, np.minimum(self._since_s, t_s), math.inf)
