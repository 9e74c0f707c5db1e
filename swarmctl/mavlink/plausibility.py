"""Bounds of a state that can be a quadrotor's: what is beyond is refused before anything is computed from it. Pure."""

from __future__ import annotations

import math

from swarmctl.core.types import Array

_FARTHEST_M, _FASTEST_M_S, _FASTEST_RAD_S = 1e5, 500.0, 200.0  # on each axis


def state_problem(pos_m: Array, vel_m_s: Array, rate_rad_s: Array, q_norm: float) -> str:
    """Return why a position, velocity and rate (3,), and an attitude of this norm, are no state, or ""."""
    bounds = ((pos_m, _FARTHEST_M), (vel_m_s, _FASTEST_M_S), (rate_rad_s, _FASTEST_RAD_S))
    if not (0.9 < q_norm < 1.1 and all(math.isfinite(v) for values, _ in bounds for v in values.tolist())):
        return "state not finite"
    if any(abs(v) > most for values, most in bounds for v in values.tolist()):
        return "state not plausible"
    return ""
