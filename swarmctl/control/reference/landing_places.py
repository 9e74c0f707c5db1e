"""Landing deconfliction: finds places apart from each other before autopilots, which ignore each other, take over."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array

_ITERATIONS = 20
_TINY_M = 1e-3


def nearest_in_plane_m(pos_ned_m: Array, others_ned_m: Sequence[Array]) -> float:
    """Return the smallest horizontal distance [m], as a landing vehicle passes all heights; infinite without others."""
    return min((math.dist(pos_ned_m[:2], other[:2]) for other in others_ned_m), default=math.inf)


def landing_place_ned_m(
    pos_ned_m: Array,
    others_ned_m: Sequence[Array],
    apart_m: float,
    agent: int,
    volume: FlightVolume | None = None,
) -> Array:
    """Return a place (3,) at the same height, `apart_m` from every other in the plane and near `pos_ned_m` (3,).

    It is in the flight volume, if there is one, where the sides leave room for it within a few rounds.

    Every agent moves the whole distance itself, so that none depends on another. Agents above each other part along
    directions that follow from `agent`, the own index.
    """
    place = pos_ned_m.copy()
    own_rad = 2.4 * agent  # golden angle: directions of a few agents all differ
    for _ in range(_ITERATIONS):
        moved = False
        for other in others_ned_m:
            away = place[:2] - other[:2]
            distance = math.hypot(*away)
            if distance >= apart_m - _TINY_M:
                continue
            unit = away / distance if distance > _TINY_M else np.array([math.cos(own_rad), math.sin(own_rad)])
            place[:2] = other[:2] + apart_m * unit
            moved = True
        if moved and volume is not None:
            place[:2] = volume.brought_inside(place)[:2]
        if not moved:
            break
    return place
