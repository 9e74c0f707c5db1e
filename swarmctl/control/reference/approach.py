"""The way to a reference from away from it: no faster than the vehicle may fly.

A controller that minimises distances flies to a reference 30 m away as fast as it can, however slow the reference is.
"""

from __future__ import annotations

import numpy as np

from swarmctl.core.types import Array


def approached(
    pos_ned_m: Array, vel_ned_m_s: Array, ahead_s: Array, from_ned_m: Array, *, speed_max_m_s: float
) -> tuple[Array, Array]:
    """Return a reference, positions and velocities (N, 3) each, as far as it can be reached by then.

    What is out of reach is replaced by the place on the straight way there that the largest speed leads to: a vehicle
    that already flies at it is then on its reference.

    Args:
        pos_ned_m, vel_ned_m_s: reference (N, 3).
        ahead_s: (N,) times of it from now, >= 0.
        from_ned_m: where the vehicle is now (3,).
        speed_max_m_s: largest speed.
    """
    way_ned_m = pos_ned_m - from_ned_m
    reach_m = speed_max_m_s * ahead_s
    squared_m2 = (way_ned_m * way_ned_m).sum(axis=1)
    if (squared_m2 <= reach_m * reach_m).all():
        return pos_ned_m, vel_ned_m_s
    far_m = np.sqrt(squared_m2)
    beyond = far_m > reach_m
    way_ned_m[beyond] /= far_m[beyond, None]
    pos, vel = pos_ned_m.copy(), vel_ned_m_s.copy()
    pos[beyond] = from_ned_m + reach_m[beyond, None] * way_ned_m[beyond]
    vel[beyond] = speed_max_m_s * way_ned_m[beyond]
    return pos, vel
