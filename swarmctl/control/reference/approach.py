"""The way to a reference from far away: no faster than the vehicle may fly, or could stop before the ground.

A controller that minimises distances flies to a reference 30 m away as fast as it can, however slow the reference is,
and falls to one that is 20 m below: by no more than gravity, while braking has only what thrust is left beside it.
"""

from __future__ import annotations

import numpy as np

from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array

_FAR_S = 0.8  # at the largest speed: what is nearer is braked for
_LEAST_SINK_M_S = 0.3  # however little thrust is left


def sink_max_m_s(thrust_max_m_s2: float) -> float:
    """Return the largest speed downwards with so much thrust over mass: it stops in half of what `_FAR_S` leads to."""
    return max(_LEAST_SINK_M_S, _FAR_S * (thrust_max_m_s2 - GRAVITY_M_S2))


def approached(
    pos_ned_m: Array,
    vel_ned_m_s: Array,
    ahead_s: Array,
    from_ned_m: Array,
    *,
    speed_max_m_s: float,
    sink_max_m_s: float,
) -> tuple[Array, Array]:
    """Return a reference, positions and velocities (N, 3) each; of one that is far away, what can be reached by then.

    The rest is replaced by the straight way there at the largest speed: a vehicle that already flies as fast is then on
    its reference.

    Args:
        pos_ned_m, vel_ned_m_s: reference (N, 3).
        ahead_s: (N,) times of it from now, >= 0.
        from_ned_m: where the vehicle is now (3,).
        speed_max_m_s: largest speed.
        sink_max_m_s: largest speed downwards.
    """
    way_ned_m = pos_ned_m - from_ned_m
    far_m, down_m = np.sqrt((way_ned_m * way_ned_m).sum(axis=1)), way_ned_m[:, 2]
    ahead_or_near_s = np.maximum(ahead_s, _FAR_S)
    if (far_m <= speed_max_m_s * ahead_or_near_s).all() and (down_m <= sink_max_m_s * ahead_or_near_s).all():
        return pos_ned_m, vel_ned_m_s
    least_s = np.maximum(far_m / speed_max_m_s, down_m / sink_max_m_s)  # that the way takes
    beyond = least_s > ahead_s
    pos, vel = pos_ned_m.copy(), vel_ned_m_s.copy()
    vel[beyond] = way_ned_m[beyond] / least_s[beyond, None]
    pos[beyond] = from_ned_m + vel[beyond] * ahead_s[beyond, None]
    return pos, vel
