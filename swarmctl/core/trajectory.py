"""Timed motions that end at rest, to which agents commit or which they propose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import Array

Times = NDArray[Any]  # UTC [us], integer or float
_STOPPED_M_S = 1e-3  # a slower plan is not continued by braking
_AT_REST_M_S = 1e-6  # a slower velocity has no direction


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Holds positions and velocities at equal steps from `t0_utc_us` on; at rest before and after them."""

    t0_utc_us: int
    dt_us: int
    pos_ned_m: Array  # (K+1, 3)
    vel_ned_m_s: Array  # (K+1, 3); the last is zero
    clock_error_us: int = 0  # by which it may be flown earlier or later: its sender's clock is known no better

    @property
    def end_utc_us(self) -> int:
        """Return the UTC [us] from which the motion is at rest."""
        return self.t0_utc_us + (len(self.pos_ned_m) - 1) * self.dt_us

    def sample(self, t_utc_us: Times) -> tuple[Array, Array]:
        """Return positions and velocities, (M, 3) NED each, at times (M,); cubic interpolation."""
        last, dt_s = len(self.pos_ned_m) - 1, self.dt_us * 1e-6
        k = (np.asarray(t_utc_us, np.float64) - self.t0_utc_us) / self.dt_us
        k = np.minimum(np.maximum(k, 0.0), last)
        low = np.minimum(k.astype(int), last - 1)
        s = (k - low)[:, None]
        p0, v0 = self.pos_ned_m.take(low, axis=0), self.vel_ned_m_s.take(low, axis=0) * dt_s
        back, v1 = p0 - self.pos_ned_m[1:].take(low, axis=0), self.vel_ned_m_s[1:].take(low, axis=0) * dt_s
        ends, rise = 2.0 * back + v0 + v1, -3.0 * back - 2.0 * v0 - v1
        pos = ((ends * s + rise) * s + v0) * s + p0
        vel = ((3.0 * ends * s + 2.0 * rise) * s + v0) / dt_s
        outside = (t_utc_us < self.t0_utc_us) | (t_utc_us > self.end_utc_us)
        vel[outside] = 0.0
        return pos, vel

    def at(self, t_utc_us: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return position and velocity, (3,) each, at one time; faster than `sample` for one."""
        last, dt_s = len(self.pos_ned_m) - 1, self.dt_us * 1e-6
        k = (t_utc_us - self.t0_utc_us) / self.dt_us
        if not 0.0 <= k < last:
            return tuple(self.pos_ned_m[0 if k < 0.0 else last].tolist()), (0.0, 0.0, 0.0)
        low = int(k)
        s, pos, vel = k - low, [], []
        ends = self.pos_ned_m[low : low + 2].tolist(), self.vel_ned_m_s[low : low + 2].tolist()
        for p0, p1, v0, v1 in zip(*ends[0], *ends[1], strict=True):
            a, b = 2.0 * (p0 - p1) + dt_s * (v0 + v1), 3.0 * (p1 - p0) - dt_s * (2.0 * v0 + v1)
            pos.append(((a * s + b) * s + dt_s * v0) * s + p0)
            vel.append((3.0 * a * s + 2.0 * b) * s / dt_s + v0)
        return tuple(pos), tuple(vel)

    def spread_m(self, from_utc_us: int) -> float:
        """Return how far off, at most, the error of the clock may put the vehicle from a time on [m]."""
        if not self.clock_error_us:
            return 0.0
        since = (from_utc_us - self.clock_error_us - self.t0_utc_us) // self.dt_us
        vel = self.vel_ned_m_s[min(max(0, since), len(self.vel_ned_m_s) - 1) :]
        return 1e-6 * self.clock_error_us * math.sqrt(float(np.einsum("kc,kc->k", vel, vel).max()))

    def acceleration(self, t_utc_us: float) -> Array:
        """Return the acceleration (3,) NED [m/s2] at a time, by the difference of velocities up to half a step away.

        One that begins in motion is not at rest before: its vehicle has moved at the velocity at which it begins.
        """
        half_us = 0.5 * self.dt_us
        since_us, until_us = max(t_utc_us - half_us, self.t0_utc_us), min(t_utc_us + half_us, self.end_utc_us)
        if until_us <= since_us:
            return np.zeros(3)
        vel = self.sample(np.array([since_us, until_us]))[1]
        return np.asarray((vel[1] - vel[0]) / ((until_us - since_us) * 1e-6))


def positions_at(trajectories: Sequence[Trajectory], t_utc_us: Times) -> Array:
    """Return positions (N, M, 3) NED of N trajectories at times (M,), by linear interpolation."""
    begins = np.array([t.t0_utc_us for t in trajectories], np.float64)[:, None]
    steps = np.array([t.dt_us for t in trajectories], np.float64)[:, None]
    return Polylines([t.pos_ned_m for t in trajectories]).at(np.maximum((t_utc_us - begins) / steps, 0.0))


@lru_cache(maxsize=64)
def grid(steps: int) -> Array:
    """Return 0, 1, ... `steps` as floats (steps+1,), read-only."""
    found = np.arange(steps + 1, dtype=np.float64)
    found.flags.writeable = False
    return found


def interpolated(points: Array, k: Array, last: int | NDArray[np.int64], first: int | NDArray[np.int64] = 0) -> Array:
    """Return positions (..., 3) at fractional indices k (...) into polylines, by linear interpolation.

    Before the first point the first segment is extrapolated; after the last point the last point is returned.

    Args:
        points: (K, 3) of one polyline, or of several one behind the other.
        k: counted from the first point of each.
        last: index of the last point of each, counted likewise.
        first: index of that first point.
    """
    low = np.minimum(np.maximum(k.astype(np.int64), 0), last - 1)
    index = first + low
    begins = points.take(index, axis=0)
    found: Array = points[1:].take(index, axis=0)
    found -= begins
    found *= (np.minimum(k, last) - low)[..., None]
    found += begins
    return found


class Polylines:
    """N polylines, interpolated all at once.

    Args:
        corners: at least 2 of each, (K, 3).
    """

    def __init__(self, corners: Sequence[Array]) -> None:
        self._points = corners[0] if len(corners) == 1 else np.concatenate(corners)
        self._firsts, self.lasts = _layout(tuple(map(len, corners)))

    def at(self, k: Array) -> Array:
        """Return positions (N, M, 3) at fractional indices (N, M); see `interpolated`."""
        return interpolated(self._points, k, self.lasts, self._firsts)

    def last_legs(self) -> Array:
        """Return the differences (N, 3) of the last two points."""
        before = (self._firsts + self.lasts)[:, 0] - 1
        return np.asarray(self._points[1:].take(before, axis=0) - self._points.take(before, axis=0))


@lru_cache(maxsize=256)
def _layout(counts: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of the first points of polylines in all points, and of their last points in their own.

    Both are (N, 1) and read-only; `counts` are the numbers of points.
    """
    firsts, lasts = np.array([0, *accumulate(counts[:-1])])[:, None], np.array(counts)[:, None] - 1
    firsts.flags.writeable = lasts.flags.writeable = False
    return firsts, lasts


def resting(pos_ned_m: Array, t_utc_us: int, dt_us: int) -> Trajectory:
    """Return the trajectory that rests at a position (3,)."""
    return Trajectory(
        t0_utc_us=t_utc_us, dt_us=dt_us, pos_ned_m=np.tile(pos_ned_m, (2, 1)), vel_ned_m_s=np.zeros((2, 3))
    )


def stopping(pos_ned_m: Array, vel_ned_m_s: Array, t_utc_us: int, dt_us: int, *, brake_m_s2: float) -> Trajectory:
    """Return the trajectory that brakes from a position and velocity, (3,) each, at constant deceleration."""
    return ending_at_rest(t_utc_us, dt_us, pos_ned_m[None], vel_ned_m_s[None], brake_m_s2=brake_m_s2)


def ending_at_rest(
    t0_utc_us: int, dt_us: int, pos_ned_m: Array, vel_ned_m_s: Array, *, brake_m_s2: float
) -> Trajectory:
    """Return a plan, positions and velocities (K+1, 3), continued by braking from its last velocity."""
    pos, vel = _brake(pos_ned_m[-1], vel_ned_m_s[-1], dt_us * 1e-6, brake_m_s2)
    return Trajectory(
        t0_utc_us=t0_utc_us,
        dt_us=dt_us,
        pos_ned_m=np.vstack([pos_ned_m, pos]),
        vel_ned_m_s=np.vstack([vel_ned_m_s, vel]),
    )


def by_exact_clock(trajectory: Trajectory) -> Trajectory:
    """Return the same motion as if the clock of its sender were known exactly; the same object if it is."""
    return replace(trajectory, clock_error_us=0) if trajectory.clock_error_us else trajectory


def delayed(trajectory: Trajectory, by_us: int) -> Trajectory:
    """Return the same motion, so much later; the same object for 0."""
    return replace(trajectory, t0_utc_us=trajectory.t0_utc_us + by_us) if by_us else trajectory


def joined(first: Trajectory, then: Trajectory, from_utc_us: int) -> Trajectory:
    """Return `first` from a time on, continued by `then` where that begins, on the grid of `then`.

    A point of that grid before the begin of `first` lies where its vehicle was at the velocity at which it begins.
    """
    missing = max(0, math.ceil((then.t0_utc_us - from_utc_us) / then.dt_us))
    if missing == 0:
        return then
    times = then.t0_utc_us - np.arange(missing, 0, -1) * then.dt_us
    pos, vel = first.sample(np.maximum(times, first.t0_utc_us))
    pos -= 1e-6 * np.maximum(first.t0_utc_us - times, 0)[:, None] * vel
    return Trajectory(
        t0_utc_us=int(times[0]),
        dt_us=then.dt_us,
        pos_ned_m=np.vstack([pos, then.pos_ned_m]),
        vel_ned_m_s=np.vstack([vel, then.vel_ned_m_s]),
    )


def braking_displacement(vel_ned_m_s: Array, t_s: Array, brake_m_s2: float) -> Array:
    """Return displacements (K, 3) NED [m] at times (K,) after the begin of braking to rest from a velocity (3,)."""
    speed = math.sqrt(float(vel_ned_m_s @ vel_ned_m_s))
    direction = vel_ned_m_s / speed if speed >= _AT_REST_M_S else np.zeros(3)
    return _braked_m(speed, t_s, brake_m_s2)[:, None] * direction


def braking_displacements(vel_ned_m_s: Array, t_s: Array, brake_m_s2: float) -> Array:
    """Return displacements (N, K, 3) NED [m] at times (N, K) after N velocities (N, 3) begin to brake to rest."""
    speed = np.sqrt(np.einsum("nc,nc->n", vel_ned_m_s, vel_ned_m_s))[:, None]
    directions = vel_ned_m_s / np.maximum(speed, _AT_REST_M_S)
    speed[speed < _AT_REST_M_S] = 0.0
    return np.asarray(_braked_m(speed, t_s, brake_m_s2)[:, :, None] * directions[:, None])


def _braked_m(speed: Array | float, t_s: Array, brake_m_s2: float) -> Array:
    """Return the distances [m] at times after the begin of braking to rest."""
    t_s = np.minimum(np.maximum(t_s, 0.0), speed / brake_m_s2)
    return np.asarray(speed * t_s - 0.5 * brake_m_s2 * t_s * t_s)


def _brake(pos_ned_m: Array, vel_ned_m_s: Array, dt_s: float, brake_m_s2: float) -> tuple[Array, Array]:
    """Return positions and velocities of braking, (L, 3) each, L >= 1, after the given point; the last is at rest."""
    speed = math.sqrt(float(vel_ned_m_s @ vel_ned_m_s))
    if speed < _STOPPED_M_S:
        return pos_ned_m[None].copy(), np.zeros((1, 3))
    stop_s = speed / brake_m_s2
    t_s = np.minimum(dt_s * np.arange(1, math.ceil(stop_s / dt_s) + 2), stop_s)
    velocities = (speed - brake_m_s2 * t_s)[:, None] * (vel_ned_m_s / speed)
    return pos_ned_m + braking_displacement(vel_ned_m_s, t_s, brake_m_s2), velocities
