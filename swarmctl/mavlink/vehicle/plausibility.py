"""What can't be a quadrotor's: a state, refused before anything is computed from it, and a kind of vehicle. Pure."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.mavlink.vehicle.sample import Vector

_FARTHEST_M, _FASTEST_M_S, _FASTEST_RAD_S = 1e5, 500.0, 200.0  # on each axis

_HOVERS = frozenset(
    {
        mavlink.MAV_TYPE_GENERIC,  # of an airframe that does not say what it is
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_TYPE_COAXIAL,
        mavlink.MAV_TYPE_HELICOPTER,
        mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
        mavlink.MAV_TYPE_DECAROTOR,
    }
)


def kind_problem(mav_type: int) -> str:
    """Return why a vehicle of this MAV_TYPE can't be flown, or "": the modes of a plane have a copter's numbers."""
    if mav_type in _HOVERS:
        return ""
    known = mavlink.enums["MAV_TYPE"].get(mav_type)
    kind = f"{mav_type}" if known is None else known.name.removeprefix("MAV_TYPE_").lower().replace("_", " ")
    return f"it says to be of MAV_TYPE {kind}, and only multirotors are flown"


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
