"""Stopping along a commitment: its own places, later, where those are apart from all places that others may pass.

Such a stop needs no acknowledgement. Its places are among those that peers keep clear of already, and what they may fly
passes none that is near, whenever they do: late, early, or along a stop of this kind as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarmctl.core.trajectory import Trajectory, joined
from swarmctl.core.types import Array

_LEAST_M_S = 0.05  # a slower motion has nearly stopped
_LOOK_AHEAD_S = 1.0  # over which the speed is looked up that has to be lost
_APART_M = 0.1  # at most, between neighbouring places of a trajectory that are compared with those of others
_LONGEST_US = 100_000  # at most, between the times at which it passes them


def halted(committed: Trajectory, begin_us: int, from_us: int, dt_us: int, brake_m_s2: float) -> Trajectory | None:
    """Return a trajectory that slows down to a stand from `begin_us` on; None if it hardly moves then.

    Time passes on it at a rate that falls to 0, so that it passes the same places, in the same order.

    Args:
        committed: to slow down.
        begin_us: UTC at which it begins to slow down.
        from_us: UTC of its first point, or a little later; not later than `begin_us`.
        dt_us: step of its grid.
        brake_m_s2: deceleration along it, of a motion at constant speed.
    """
    ahead_us = np.linspace(0.0, 1e6 * _LOOK_AHEAD_S, 11)
    speed_m_s = float(np.linalg.norm(committed.sample(begin_us + ahead_us)[1], axis=1).max())
    if speed_m_s < _LEAST_M_S:
        return None
    stop_s, dt_s = speed_m_s / brake_m_s2, 1e-6 * dt_us
    since_s = np.minimum(dt_s * np.arange(math.ceil(stop_s / dt_s) + 1), stop_s)
    rate_01 = 1.0 - since_s / stop_s
    rate_01[-1] = 0.0  # exactly
    pos, vel = committed.sample(begin_us + 1e6 * since_s * (0.5 + 0.5 * rate_01))
    stop = Trajectory(t0_utc_us=begin_us, dt_us=dt_us, pos_ned_m=pos, vel_ned_m_s=vel * rate_01[:, None])
    return joined(committed, stop, from_us)


def places_apart_m(own: Trajectory, begin_us: int, known: Sequence[Trajectory], utc_us: int, downwash: float) -> float:
    """Return the least distance [m] of places of a trajectory from `begin_us` on to those of others from `utc_us` on.

    Heights count by `downwash` less, and the error of clocks as more places that are passed. Infinite without others.
    """
    mine, scale = _places(own, begin_us), np.array([1.0, 1.0, 1.0 / downwash])
    least2_m2 = math.inf
    for other in known:
        apart = (mine[:, None] - _places(other, utc_us - other.clock_error_us)[None]) * scale
        least2_m2 = min(least2_m2, float(np.einsum("ijc,ijc->ij", apart, apart).min()))
    return math.sqrt(least2_m2)


def _places(trajectory: Trajectory, from_us: int) -> Array:
    """Return places (M, 3) that a trajectory passes from a time on, close to each other, with its end."""
    fastest_m_s = math.sqrt(float(np.einsum("kc,kc->k", trajectory.vel_ned_m_s, trajectory.vel_ned_m_s).max()))
    step_us = min(_LONGEST_US, max(1, round(1e6 * _APART_M / max(fastest_m_s, 1e-3))))
    return trajectory.sample(np.append(np.arange(from_us, trajectory.end_utc_us, step_us), trajectory.end_utc_us))[0]
