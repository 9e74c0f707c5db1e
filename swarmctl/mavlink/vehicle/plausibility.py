"""Bounds of a state that can be a quadrotor's: what is beyond is refused before anything is computed from it. Pure."""

from __future__ import annotations

import math

from swarmctl.mavlink.vehicle.sample import Vector

_FARTHEST_M, _FASTEST_M_S, _FASTEST_RAD_S = 1e5, 500.0, 200.0  # on each axis


def state_problem(pos_m: Vector, vel_m_s: Vector, rate_rad_s: Vector, q_norm: float) -> str:
    """Return why a position, a velocity and a rate, and an attitude of this norm, are no state, or ""."""
    is_attitude = 0.9 < q_norm < 1.1
    plausible = _within(_FARTHEST_M, pos_m) and _within(_FASTEST_M_S, vel_m_s) and _within(_FASTEST_RAD_S, rate_rad_s)
    if is_attitude and plausible:
        return ""
    finite = is_attitude and all(map(math.isfinite, (*pos_m, *vel_m_s, *rate_rad_s)))
    return "state not plausible" if finite else "state not finite"


def _within(most: float, vector: Vector) -> bool:
    """Return whether no component is larger; one that is not a number is."""
    x, y, z = vector
    return -most <= x <= most and -most <= y <= most and -most <= z <= most
