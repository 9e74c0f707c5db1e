"""Regions that plans keep out of, at every step of a plan: peers, obstacles, and what they may be up to."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarmctl.core.trajectory import braking_displacement
from swarmctl.core.types import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class KeepOut:
    """Describes one thing to keep clear of, at the times of the own prediction."""

    pos_ned_m: Array  # (Hp+1, 3)
    radius_m: float  # constraint distance between centres
    hard_min_distance_m: float  # plans that come closer are refused
    any_height: bool  # a vertical cylinder instead of a sphere
    priority_id: int  # agent number, -1 an obstacle; decides the side when centres coincide
    downwash: float = 1.0  # ratio of height to width of the ellipsoid; 1 is a sphere
    key: Hashable = None  # the same in all ticks; None: encounters with it are not remembered
    entered_m: float | None = None  # distance at which the present violation began; None: with this tick

    @property
    def vertical_01(self) -> float:
        """Return the factor on vertical distances."""
        return 0.0 if self.any_height else 1.0 / self.downwash

    def apart_m(self, pos_ned_m: Array) -> float:
        """Return the distance [m] of a position (3,) from its centre now, by which it is violated or not."""
        towards = pos_ned_m - self.pos_ned_m[0]
        return math.hypot(towards[0], towards[1], towards[2] * self.vertical_01)

    def distance_m(self, pos_ned_m: Array) -> float:
        """Return the distance [m] of a position (3,) from its centre now; in the plane when it holds at any height."""
        axes = 2 if self.any_height else 3
        return math.dist(self.pos_ned_m[0, :axes], pos_ned_m[:axes])


class KeepOuts(tuple[KeepOut, ...]):
    """Several keep-outs, and what is computed of all of them at once, stacked.

    Args:
        keep_outs: with equal numbers of positions.
        pos_ned_m: these positions, if they are stacked already.

    Attributes, if there are any keep-outs:
        pos_ned_m: (S, Hp+1, 3).
        radius_m, vertical_01: (S, 1).
        obstacles: indices of those that are no peers.
    """

    pos_ned_m: Array
    radius_m: Array
    vertical_01: Array
    obstacles: list[int]

    def __new__(cls, keep_outs: Iterable[KeepOut] = (), pos_ned_m: Array | None = None) -> KeepOuts:
        found = super().__new__(cls, keep_outs)
        if not found:
            return found
        if pos_ned_m is None:
            pos_ned_m = np.concatenate([k.pos_ned_m for k in found]).reshape(len(found), -1, 3)
        found.pos_ned_m = pos_ned_m
        numbers = np.array([(k.radius_m, k.vertical_01) for k in found])
        found.radius_m, found.vertical_01 = numbers[:, :1], numbers[:, 1:]
        found.obstacles = [i for i, k in enumerate(found) if k.priority_id < 0]
        return found

    def apart(self, path_ned_m: Array) -> Array:
        """Return the way (S, Hp+1, 3) from each of them to a path (Hp+1, 3), heights as they count."""
        apart = path_ned_m - self.pos_ned_m
        apart[:, :, 2] *= self.vertical_01
        return apart


NO_KEEP_OUTS = KeepOuts()


def stacked(keep_outs: Iterable[KeepOut]) -> KeepOuts:
    """Return keep-outs as such, stacked if they are not yet."""
    return keep_outs if isinstance(keep_outs, KeepOuts) else KeepOuts(keep_outs)


def moved_on(keep_out: KeepOut, ahead_s: Array, dt_s: float, brake_m_s2: float) -> Array:
    """Return positions (N, 3) of a keep-out behind its last one: obstacles move on as they do, vehicles brake to rest.

    Args:
        keep_out: with positions `dt_s` apart.
        ahead_s: (N,) times from the last of them on.
        dt_s: time between them.
        brake_m_s2: braking of vehicles.
    """
    pos = keep_out.pos_ned_m
    vel = (pos[-1] - pos[-2]) / dt_s
    is_obstacle = keep_out.priority_id < 0
    way = ahead_s[:, None] * vel if is_obstacle else braking_displacement(vel, ahead_s, brake_m_s2)
    moved: Array = pos[-1] + way
    return moved


def lasting(keep_outs: Sequence[KeepOut], steps: int, dt_us: int, brake_m_s2: float) -> KeepOuts:
    """Return keep-outs for so many steps more; see `moved_on`."""
    dt_s = 1e-6 * dt_us
    ahead_s = dt_s * np.arange(1, steps + 1, dtype=np.float64)
    moved = ((k, moved_on(k, ahead_s, dt_s, brake_m_s2)) for k in keep_outs)
    return KeepOuts([replace(k, pos_ned_m=np.vstack([k.pos_ned_m, further])) for k, further in moved])
