"""Obstacles for the viewer, read from JSON of the configuration or from the operator's message."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmctl.core.types import Array


class MovingObstacle(NamedTuple):
    """A sphere, or a column of any height, with constant velocity."""

    center_ned_m: Array  # (3,) when the obstacle was set
    radius_m: float
    keep_out_m: float
    vel_ned_m_s: Array  # (3,)
    column: bool = False

    def center_after(self, elapsed_s: float) -> Array:
        """Return the centre (3,) NED [m], `elapsed_s` after the obstacle was set."""
        return self.center_ned_m + elapsed_s * self.vel_ned_m_s

    @property
    def moves(self) -> bool:
        return bool(np.any(self.vel_ned_m_s))


def read_obstacles(listed: object) -> list[MovingObstacle] | None:
    """Return the obstacles of parsed JSON; None when one of them is invalid."""
    if not isinstance(listed, Sequence) or isinstance(listed, str):
        return None
    try:
        return [_obstacle(item) for item in listed]
    except (KeyError, TypeError, ValueError):
        return None


def _obstacle(item: Mapping[str, Any]) -> MovingObstacle:
    center_ned_m = np.array(item["center_ned_m"], np.float64).reshape(3)
    vel_ned_m_s = np.array(item.get("vel_ned_m_s", (0.0, 0.0, 0.0)), np.float64).reshape(3)
    radius_m, keep_out_m = float(item["radius_m"]), float(item["keep_out_m"])
    if not all(map(math.isfinite, (*center_ned_m, *vel_ned_m_s, radius_m, keep_out_m))):
        raise ValueError("not finite")
    return MovingObstacle(center_ned_m, radius_m, keep_out_m, vel_ned_m_s, bool(item.get("column", False)))
