"""Certifies that a plan stays in the flight volume, independently of the rows that made it.

A plan is judged by where it goes and by where it could stop behind its end. With p the distance inside of a face, v the
speed towards it and a the braking that plans leave room for, e = p - v^2 / 2a is where braking from now on would end.
A plan that never falls below a limit, e of its last point included, is inside. One that begins outside, where the
vehicle was found or blown to, is flown if it never falls below e of the first point that it can change: it brakes at
least with a, or comes back. That is granted nowhere else: plans that put braking off from tick to tick would carry a
vehicle out.
"""

from __future__ import annotations

import numpy as np

from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.types import Array

_TOLERANCE_M = 0.02  # of a plan that begins outside: its first changeable point is not known better


def volume_margin_m(volume: FlightVolume | None, pos_ned_m: Array, vel_ned_m_s: Array, from_step: int) -> float:
    """Return by how much a plan is inside of what may be flown; negative: it must not be. Infinite without a volume.

    Args:
        volume: to stay in.
        pos_ned_m, vel_ned_m_s: (N+1, 3) of the plan.
        from_step: first step that the plan can still change.
    """
    if volume is None:
        return np.inf
    first = min(from_step, len(pos_ned_m) - 1)
    inside = pos_ned_m @ volume.normals_ned.T - volume.certified_m  # (N+1, F)
    towards = np.maximum(-(vel_ned_m_s[[first, -1]] @ volume.normals_ned.T), 0.0)
    stops = inside[[first, -1]] - towards**2 / (2.0 * volume.brakes_m_s2)  # (2, F)
    least = np.minimum(inside[first:].min(axis=0), stops[1])
    allowed = np.where(inside[0] < 0.0, np.minimum(0.0, stops[0] - _TOLERANCE_M), 0.0)
    return float((least - allowed).min())
