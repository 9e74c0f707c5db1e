"""Deadlock recovery: detects that an agent makes no progress, reports it, and resolves it by rule.

An agent is deadlocked when it is far from its reference, has not moved for a while, and a peer or an obstacle is
between the two. It then replaces the reference, which pulls it straight on, by a path around what it knows. Each
further deadlock raises the escalation level:

1. The path leads around the obstacles that the agent has seen.
2. It also leads around peers of a lower id that have blocked the agent, and around other such peers that stand near
   it. The lower id goes on, the higher id yields, so that of two never both yield or both insist.
3. It also leads around every other peer that stands near the agent.

The path only replaces the reference. Distances are kept by the same plans as always, and an agent that is never
deadlocked flies as without recovery.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.reference.deadlock_params import DeadlockParams
from swarmctl.control.reference.shortest_path import Polyline, shortest_path
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array, Sampled

_REPLAN_US = 500_000
_REPLACE_01 = 0.85  # a new path replaces the old one when its length is below this share
_NEAR_RADII = 5.0  # in units of the distance that agents keep: paths ignore peers that are farther away
_STANDING_M = 0.15  # a peer that moves less over its plan counts as standing
_MARGIN_M = 0.02  # added to the distance at which corners are passed
_GAP_PRICE = 3.0  # factor on the price of doubtful gaps at every escalation level
_ACCEL_M_S2 = 0.8  # deceleration towards the end of a path


@dataclass(frozen=True, slots=True)
class Deadlock:
    """Describes one deadlock of an agent, from when it stopped making progress."""

    since_us: int
    by: tuple[int, ...]  # ids of blocking peers, -1 for an obstacle

    @property
    def names(self) -> str:
        """Return the blocking peers and obstacles in words."""
        return ", ".join("an obstacle" if blocker < 0 else f"agent {blocker}" for blocker in self.by)


class ProgressMonitor:
    """Detects that an agent makes no progress towards its reference.

    Args:
        params: thresholds.
    """

    def __init__(self, params: DeadlockParams) -> None:
        self._params = params
        self._anchor: tuple[Array, int] | None = None  # position and time of the last progress

    def reset(self) -> None:
        """Forget the last progress."""
        self._anchor = None

    def step(self, now_us: int, pos_ned_m: Array, wanted_ned_m: Array, keep_outs: Sequence[KeepOut]) -> Deadlock | None:
        """Return a deadlock once it has lasted `patience_s`, and again every `patience_s`; otherwise None."""
        p = self._params
        if math.dist(pos_ned_m, wanted_ned_m) < p.behind_m:
            self._anchor = None
            return None
        if self._anchor is None or math.dist(pos_ned_m, self._anchor[0]) > p.moved_m:
            self._anchor = (pos_ned_m.copy(), now_us)
            return None
        since_us = self._anchor[1]
        if now_us - since_us < p.patience_s * 1e6:
            return None
        to_reference = wanted_ned_m - pos_ned_m
        by = sorted({k.priority_id for k in keep_outs if _blocks(k, pos_ned_m, to_reference, p.near_m)})
        if not by:
            return None  # wind or a weak vehicle, not a deadlock
        self._anchor = (pos_ned_m.copy(), now_us)
        return Deadlock(since_us, tuple(by))


class DeadlockRecovery:
    """Replaces the reference of a deadlocked agent by a path, until the agent has caught up with the reference.

    Args:
        params: thresholds and speed.
        agent: own id.
        radius_m: distance that agents keep; it also sets the cell size of the path search.
        volume: that paths stay in; None for none.
    """

    def __init__(self, params: DeadlockParams, agent: int, radius_m: float, volume: FlightVolume | None = None) -> None:
        self._sides = None if volume is None else volume.planned_sides
        self._params, self._agent, self._radius_m = params, agent, radius_m
        self._progress = ProgressMonitor(params)
        self._path: Polyline | None = None
        self._planned_us = 0
        self._escalation_level = 0
        self._pos_ned_m, self._goal_ned_m = np.zeros(3), np.zeros(3)
        self._stuck_ned_m: Array | None = None
        self._blocking_peers: set[int] = set()  # have blocked the agent and are still near
        self.deadlock: Deadlock | None = None  # None again once the agent has moved on

    @property
    def active(self) -> bool:
        """Tell whether a path replaces the reference."""
        return self._path is not None

    def reset(self) -> None:
        """Forget everything, after a handover or a change of mission phase."""
        self._progress.reset()
        self._path, self.deadlock, self._stuck_ned_m, self._escalation_level = None, None, None, 0
        self._blocking_peers.clear()

    def step(
        self,
        now_us: int,
        pos_ned_m: Array,
        wanted_ned_m: Array,
        reference: Sampled,
        keep_outs: Sequence[KeepOut],
        *,
        obstacles: Callable[[], Sequence[Obstacle]],
    ) -> None:
        """Check progress, and plan a path while the agent is in recovery.

        Args:
            now_us: monotonic time.
            pos_ned_m: (3,) own position.
            wanted_ned_m: (3,) the reference now.
            reference: reference to follow.
            keep_outs: keep-outs from now on.
            obstacles: returns the obstacles at rest that have been seen so far.
        """
        p, self._pos_ned_m = self._params, pos_ned_m
        behind_m = math.dist(pos_ned_m, wanted_ned_m)
        found = self._progress.step(now_us, pos_ned_m, wanted_ned_m, keep_outs)
        if found is not None:
            since_us = found.since_us if self.deadlock is None else self.deadlock.since_us
            self.deadlock, self._stuck_ned_m = Deadlock(since_us, found.by), pos_ned_m.copy()
            self._escalation_level += 1
            self._blocking_peers.update(found.by)
        elif self._escalation_level:
            self._forget(behind_m, keep_outs)
        if not p.enabled or (self._path is None and found is None):
            return
        if behind_m < p.behind_m:
            self._path, self._escalation_level = None, 0
            return
        if found is not None or now_us - self._planned_us >= _REPLAN_US:
            self._planned_us = now_us
            self._goal_ned_m = reference(np.array([behind_m / p.speed_m_s]))[0][0]
            self._plan(found is not None, keep_outs, obstacles())

    def _forget(self, behind_m: float, keep_outs: Sequence[KeepOut]) -> None:
        """End the deadlock once the agent has left its place, and forget blocking peers that are no longer near."""
        near = {k.priority_id for k in keep_outs if k.distance_m(self._pos_ned_m) < _NEAR_RADII * self._radius_m}
        self._blocking_peers &= near - {-1}
        moved_m = 0.0 if self._stuck_ned_m is None else math.dist(self._pos_ned_m, self._stuck_ned_m)
        if behind_m < self._params.behind_m or moved_m > 2.0 * self._radius_m:
            self.deadlock, self._stuck_ned_m = None, None
        if self.deadlock is None and not self._blocking_peers:
            self._escalation_level = 1 if self.active else 0

    def sample(self, offsets_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) NED each, at `offsets_s` (K,) [s] from now along the path."""
        assert self._path is not None
        at_m = self._path.arc_length_m(self._pos_ned_m[:2])
        left_m = self._path.length_m - at_m
        speed_m_s = min(self._params.speed_m_s, math.sqrt(2.0 * _ACCEL_M_S2 * left_m))
        pos, vel = np.empty((len(offsets_s), 3)), np.zeros((len(offsets_s), 3))
        pos[:, :2], along = self._path.sample(at_m + speed_m_s * offsets_s)
        pos[:, 2], vel[:, :2] = self._goal_ned_m[2], speed_m_s * along
        return pos, vel

    def _plan(self, anew: bool, keep_outs: Sequence[KeepOut], obstacles: Sequence[Obstacle]) -> None:
        discs = self._discs(keep_outs, obstacles)
        start, goal = self._pos_ned_m[:2], self._goal_ned_m[:2]
        squeeze = _GAP_PRICE**self._escalation_level
        path = shortest_path(start, goal, discs, self._radius_m / 3.0, squeeze=squeeze, sides=self._sides)
        if not anew and self._path is not None and math.dist(self._path.corners[-1], goal) < self._params.behind_m:
            remainder = self._path.remainder(start)
            if remainder.is_clear(discs) and path.length_m > _REPLACE_01 * remainder.length_m:
                return
        self._path = path

    def _discs(self, keep_outs: Sequence[KeepOut], obstacles: Sequence[Obstacle]) -> Array:
        """Return discs (M, 3) that the path has to avoid: north, east and radius [m]."""
        found = [_disc(o, float(self._goal_ned_m[2])) for o in obstacles]
        for k in keep_outs:
            if k.priority_id < 0 or k.distance_m(self._pos_ned_m) > _NEAR_RADII * self._radius_m:
                continue
            goes_first = k.priority_id < self._agent
            stands = math.dist(k.pos_ned_m[0], k.pos_ned_m[-1]) < _STANDING_M
            blocked = goes_first and k.priority_id in self._blocking_peers
            if self._escalation_level >= 2 and (blocked or (stands and (goes_first or self._escalation_level >= 3))):
                found.append((k.pos_ned_m[0, 0], k.pos_ned_m[0, 1], k.radius_m + _MARGIN_M))
        return np.array([d for d in found if d[2] > 0.0]).reshape(-1, 3)


def _disc(obstacle: Obstacle, height_z_m: float) -> tuple[float, float, float]:
    """Return the section (north, east, radius) of an obstacle at a height; radius 0 when it does not reach there."""
    below_m = 0.0 if obstacle.column else obstacle.center_ned_m[2] - height_z_m
    radius_m = math.sqrt(max(obstacle.keep_out_m**2 - below_m**2, 0.0))
    return obstacle.center_ned_m[0], obstacle.center_ned_m[1], radius_m + _MARGIN_M * (radius_m > 0.0)


def _blocks(keep_out: KeepOut, pos_ned_m: Array, to_reference: Array, near_m: float) -> bool:
    towards = keep_out.pos_ned_m[0] - pos_ned_m
    if keep_out.any_height:
        towards = towards * [1.0, 1.0, 0.0]
    return keep_out.distance_m(pos_ned_m) < keep_out.radius_m + near_m and float(towards @ to_reference) > 0.0
