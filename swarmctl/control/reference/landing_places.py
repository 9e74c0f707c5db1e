"""Where to go so that everybody has room before autopilots, which know nothing of each other, take over."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarmctl.core.types import Array

_ROUNDS = 20
_TINY_M = 1e-3


def nearest_in_plane_m(pos_ned_m: Array, others_ned_m: Sequence[Array]) -> float:
    """Smallest horizontal distance: who lands passes every height below. Infinite alone."""
    return min((math.dist(pos_ned_m[:2], other[:2]) for other in others_ned_m), default=math.inf)


def landing_place_ned_m(pos_ned_m: Array, others_ned_m: Sequence[Array], apart_m: float, agent: int) -> Array:
    """A place (3,) at the same height that is `apart_m` from every other in the plane, near `pos_ned_m` (3,).

    Everybody who does this moves the whole way, so nobody depends on the other's good will. Those above each other part
    along directions of their own (`agent`: own index).
    """
    place = pos_ned_m.copy()
    own_way = 2.4 * agent  # rad, the golden angle: no two of a few agree
    for _ in range(_ROUNDS):
        moved = False
        for other in others_ned_m:
            away = place[:2] - other[:2]
            distance = math.hypot(*away)
            if distance >= apart_m - _TINY_M:
                continue
            unit = away / distance if distance > _TINY_M else np.array([math.cos(own_way), math.sin(own_way)])
            place[:2] = other[:2] + apart_m * unit
            moved = True
        if not moved:
            break
    return place
