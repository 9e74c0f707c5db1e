"""Deadlock: noticed, reported, and resolved by rule.

An agent that is far from its reference, has not got anywhere for a while and has somebody or something before it is
deadlocked. It then leaves the reference, which pulls it straight on, for a way round what it knows:

1. round the obstacles it has seen;
2. still stuck: also round peers of a lower id that were in its way, and others that stand near it. The lower id goes
   on, the higher one round it or back, so that two never both give way or both insist;
3. still stuck: also round every other peer that stands near it.

The way only replaces the reference. Distances are kept by the same plans as ever, and who is never deadlocked flies
as if this did not exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from swarmctl.control.collision.separation import KeepOut
from swarmctl.control.reference.shortest_path import Polyline, shortest_path
from swarmctl.core.params import Params
from swarmctl.core.types import Array, Obstacle, Sampled

_REPLAN_US = 500_000
_BETTER_01 = 0.85  # a new way is taken when it is this much shorter
_NEAR_RADII = 5.0  # of the distance that agents keep: peers beyond are not gone round
_STANDS_M = 0.15  # a peer that means to move less over its plan stands
_MARGIN_M = 0.02  # corners are passed farther away than has to be kept
_SQUEEZE = 3.0  # how much less a gap that may be none is worth after every deadlock
_ACCEL_M_S2 = 0.8  # at the end of a way


class DeadlockParams(Params):
    """When an agent counts as deadlocked, and how it goes round."""

    enabled: bool = True  # false: deadlocks are only noticed
    behind_m: float = Field(0.2, gt=0, le=100)  # nearer to the reference it has arrived
    moved_m: float = Field(0.2, gt=0, le=10)  # less in `patience_s` is nowhere
    patience_s: float = Field(1.5, gt=0.1, le=60)
    near_m: float = Field(0.4, gt=0, le=10)  # beyond what is to be kept; who is nearer can be in the way
    speed_m_s: float = Field(1.0, gt=0, le=20)


@dataclass(frozen=True, slots=True)
class Deadlock:
    """One agent, from when it stopped getting anywhere until it did again."""

    since_us: int
    by: tuple[int, ...]  # ids of peers in the way, -1 for an obstacle

    @property
    def names(self) -> str:
        """Who is in the way, in words."""
        return ", ".join("an obstacle" if priority_id < 0 else f"agent {priority_id}" for priority_id in self.by)


class ProgressMonitor:
    """Watches whether an agent gets nearer to where it should be.

    Args:
        params: what counts as nowhere.
    """

    def __init__(self, params: DeadlockParams) -> None:
        self._params = params
        self._anchor: tuple[Array, int] | None = None  # where and since when

    def reset(self) -> None:
        self._anchor = None

    def step(self, now_us: int, pos_ned_m: Array, wanted_ned_m: Array, keep_outs: Sequence[KeepOut]) -> Deadlock | None:
        """A deadlock once it has lasted `patience_s`, and every `patience_s` again."""
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
        way = wanted_ned_m - pos_ned_m
        by = sorted({k.priority_id for k in keep_outs if _blocks(k, pos_ned_m, way, p.near_m)})
        if not by:
            return None  # it is weather or a weak vehicle
        self._anchor = (pos_ned_m.copy(), now_us)
        return Deadlock(since_us, tuple(by))


class DeadlockRecovery:
    """Stands in for the reference of an agent that was deadlocked until it has caught up with it.

    Args:
        params: see there.
        agent: own id.
        radius_m: distance that agents keep; also gives the grid its size.
    """

    def __init__(self, params: DeadlockParams, agent: int, radius_m: float) -> None:
        self._params, self._agent, self._radius_m = params, agent, radius_m
        self._progress = ProgressMonitor(params)
        self._way: Polyline | None = None
        self._planned_us = 0
        self._escalation_level = 0
        self._here, self._wanted = np.zeros(3), np.zeros(3)
        self._stuck_at: Array | None = None
        self._blocking_peers: set[int] = set()  # peers that were in the way and are still near
        self.deadlock: Deadlock | None = None  # until it has moved on

    @property
    def active(self) -> bool:
        return self._way is not None

    def reset(self) -> None:
        """Somebody else has flown, or something else is to be flown."""
        self._progress.reset()
        self._way, self.deadlock, self._stuck_at, self._escalation_level = None, None, None, 0
        self._blocking_peers.clear()

    def step(
        self,
        now_us: int,
        pos_ned_m: Array,
        reference: Sampled,
        keep_outs: Sequence[KeepOut],
        obstacles: Callable[[], Sequence[Obstacle]],
    ) -> None:
        """Look whether the agent gets on, and plan its way if it has to go round.

        Args:
            now_us: monotonic.
            pos_ned_m: (3,) own.
            reference: what it should follow.
            keep_outs: of now.
            obstacles: answers which ones at rest it has seen so far.
        """
        p, self._here = self._params, pos_ned_m
        now_ref = reference(np.zeros(1))[0][0]
        behind_m = math.dist(pos_ned_m, now_ref)
        found = self._progress.step(now_us, pos_ned_m, now_ref, keep_outs)
        if found is not None:
            since_us = found.since_us if self.deadlock is None else self.deadlock.since_us
            self.deadlock, self._stuck_at = Deadlock(since_us, found.by), pos_ned_m.copy()
            self._escalation_level += 1
            self._blocking_peers.update(found.by)
        elif self._escalation_level:
            self._forget(behind_m, keep_outs)
        if not p.enabled or (self._way is None and found is None):
            return
        if behind_m < p.behind_m:
            self._way, self._escalation_level = None, 0
            return
        if found is not None or now_us - self._planned_us >= _REPLAN_US:
            self._planned_us = now_us
            self._wanted = reference(np.array([behind_m / p.speed_m_s]))[0][0]
            self._plan(found is not None, keep_outs, obstacles())

    def _forget(self, behind_m: float, keep_outs: Sequence[KeepOut]) -> None:
        """A deadlock ends where it is left behind; whom it was with counts as long as they are near."""
        near = {k.priority_id for k in keep_outs if k.distance_m(self._here) < _NEAR_RADII * self._radius_m}
        self._blocking_peers &= near - {-1}
        moved_m = 0.0 if self._stuck_at is None else math.dist(self._here, self._stuck_at)
        if behind_m < self._params.behind_m or moved_m > 2.0 * self._radius_m:
            self.deadlock, self._stuck_at = None, None
        if self.deadlock is None and not self._blocking_peers:
            self._escalation_level = 1 if self.active else 0

    def sample(self, offsets_s: Array) -> tuple[Array, Array]:
        """Positions and velocities, (K, 3) each, at `offsets_s` (K,) from now, along the way."""
        assert self._way is not None
        at_m = self._way.arc_length_m(self._here[:2])
        left_m = self._way.length_m - at_m
        speed_m_s = min(self._params.speed_m_s, math.sqrt(2.0 * _ACCEL_M_S2 * left_m))
        pos, vel = np.empty((len(offsets_s), 3)), np.zeros((len(offsets_s), 3))
        pos[:, :2], along = self._way.sample(at_m + speed_m_s * offsets_s)
        pos[:, 2], vel[:, :2] = self._wanted[2], speed_m_s * along
        return pos, vel

    def _plan(self, anew: bool, keep_outs: Sequence[KeepOut], obstacles: Sequence[Obstacle]) -> None:
        discs = self._discs(keep_outs, obstacles)
        start, goal = self._here[:2], self._wanted[:2]
        way = shortest_path(start, goal, discs, self._radius_m / 3.0, squeeze=_SQUEEZE**self._escalation_level)
        if not anew and self._way is not None and math.dist(self._way.corners[-1], goal) < self._params.behind_m:
            rest = self._way.rest(start)
            if rest.is_clear(discs) and way.length_m > _BETTER_01 * rest.length_m:
                return
        self._way = way

    def _discs(self, keep_outs: Sequence[KeepOut], obstacles: Sequence[Obstacle]) -> Array:
        """What to go round (M, 3): centre and radius."""
        found = [_disc(o, float(self._wanted[2])) for o in obstacles]
        for k in keep_outs:
            if k.priority_id < 0 or k.distance_m(self._here) > _NEAR_RADII * self._radius_m:
                continue
            goes_first = k.priority_id < self._agent
            stands = math.dist(k.pos_ned_m[0], k.pos_ned_m[-1]) < _STANDS_M
            met = goes_first and k.priority_id in self._blocking_peers
            if self._escalation_level >= 2 and (met or (stands and (goes_first or self._escalation_level >= 3))):
                found.append((k.pos_ned_m[0, 0], k.pos_ned_m[0, 1], k.radius_m + _MARGIN_M))
        return np.array([d for d in found if d[2] > 0.0]).reshape(-1, 3)


def _disc(obstacle: Obstacle, height_z_m: float) -> tuple[float, float, float]:
    """An obstacle at the height that is flown; radius 0 when it does not reach it."""
    below_m = 0.0 if obstacle.column else float(obstacle.center_ned_m[2]) - height_z_m
    radius_m = math.sqrt(max(obstacle.keep_out_m**2 - below_m**2, 0.0))
    return float(obstacle.center_ned_m[0]), float(obstacle.center_ned_m[1]), radius_m + _MARGIN_M * (radius_m > 0.0)


def _blocks(keep_out: KeepOut, pos_ned_m: Array, way: Array, near_m: float) -> bool:
    towards = keep_out.pos_ned_m[0] - pos_ned_m
    if keep_out.any_height:
        towards = towards * [1.0, 1.0, 0.0]
    return keep_out.distance_m(pos_ned_m) < keep_out.radius_m + near_m and float(towards @ way) > 0.0
