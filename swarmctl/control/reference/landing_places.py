"""Landing deconfliction: finds free places before autopilots, which know no peers and no obstacles, take over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array

_ITERATIONS = 20
_TINY_M = 1e-3
_TURN_RAD = 2.4  # golden angle: directions of a few agents, and of places that follow each other, all differ
_SEARCHED = 400  # places
_REACH = 3.0  # how far they are, in distances to be kept


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """A disc in which nobody else may land, as a landing vehicle passes all heights."""

    center_ned_m: Array  # (3,)
    apart_m: float  # radius


def nearest_in_plane_m(pos_ned_m: Array, others_ned_m: Sequence[Array]) -> float:
    """Return the smallest horizontal distance [m], as a landing vehicle passes all heights; infinite without others."""
    return min((math.dist(pos_ned_m[:2], other[:2]) for other in others_ned_m), default=math.inf)


def landing_place_ned_m(
    pos_ned_m: Array, taken: Sequence[Taken], agent: int, volume: FlightVolume | None = None
) -> Array:
    """Return a place (3,) at the same height, outside of every disc and near `pos_ned_m` (3,).

    It is in the flight volume, if there is one, where the sides leave room for it.

    Every agent moves the whole distance itself, so that none depends on another. Agents above each other part along
    directions that follow from `agent`, the own index.
    """
    place, own_rad = pos_ned_m.copy(), _TURN_RAD * agent
    for _ in range(_ITERATIONS):
        moved = False
        for disc in taken:
            away = place[:2] - disc.center_ned_m[:2]
            distance = math.hypot(*away)
            if distance >= disc.apart_m - _TINY_M:
                continue
            unit = away / distance if distance > _TINY_M else np.array([math.cos(own_rad), math.sin(own_rad)])
            place[:2] = disc.center_ned_m[:2] + disc.apart_m * unit
            moved = True
        if not moved:
            return place
        if volume is not None:
            place[:2] = volume.brought_inside(place)[:2]
    return _searched_ned_m(pos_ned_m, taken, own_rad, volume)


def _searched_ned_m(pos_ned_m: Array, taken: Sequence[Taken], first_rad: float, volume: FlightVolume | None) -> Array:
    """Return the first free place (3,) along a spiral round `pos_ned_m` (3,), or else the one with most room.

    Discs that overlap may push a place from one into the other for ever.
    """
    turns = np.arange(_SEARCHED)
    away_m = _REACH * max(disc.apart_m for disc in taken) * np.sqrt(turns / _SEARCHED)
    angle_rad = first_rad + _TURN_RAD * turns
    places = np.tile(pos_ned_m, (_SEARCHED, 1))
    places[:, :2] += away_m[:, None] * np.stack((np.cos(angle_rad), np.sin(angle_rad)), axis=1)
    if volume is not None:
        normals_ne, offsets_m = volume.planned_sides
        inside = (places[:, :2] @ normals_ne.T >= offsets_m).all(axis=1)
        places = places[inside] if inside.any() else places
    spare_m = np.min(
        [np.linalg.norm((places - disc.center_ned_m)[:, :2], axis=1) - disc.apart_m for disc in taken], axis=0
    )
    free = np.flatnonzero(spare_m >= 0.0)
    found: Array = places[free[0] if len(free) else int(spare_m.argmax())]
    return found
