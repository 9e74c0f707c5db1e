"""Accelerations that both autopilots' position controllers ask for: limited, and as an attitude. Local NED, scalar."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.core.frames import GRAVITY_M_S2, quat_from_body_z
from swarmctl.core.types import Array


def limited(north: float, east: float, limit: float) -> tuple[float, float]:
    """Return a horizontal vector, shortened to at most `limit`."""
    size = math.hypot(north, east)
    if size <= limit:
        return north, east
    return north * limit / size, east * limit / size


def attitude_for(acc_ned_m_s2: tuple[float, float, float], yaw_rad: float) -> Array:
    """Return the attitude (4,) wxyz whose thrust, of the right size, accelerates like that."""
    north, east, acc_d = acc_ned_m_s2
    down = np.array([-north, -east, GRAVITY_M_S2 - acc_d])
    return quat_from_body_z(down / math.sqrt(float(down @ down)), yaw_rad)
