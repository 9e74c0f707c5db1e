"""The newest state that a vehicle has reported, as numbers, and as arrays where it is in the shared frame."""

from __future__ import annotations

from typing import NamedTuple

from swarmctl.core.types import Array

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Sample(NamedTuple):
    """The newest state, in the clock and the local frame of the vehicle."""

    vehicle_us: int
    t_us: int  # monotonic time of this host
    pos_ned_m: Vector
    vel_ned_m_s: Vector
    q_nb: Quaternion
    rate_frd_rad_s: Vector


class Placed(NamedTuple):
    """The newest state that has a place in the shared frame."""

    sample: Sample
    pos_ned_m: Array  # (3,) in the shared frame
    vel_ned_m_s: Array  # (3,)
    q_nb: Array  # (4,)
    rate_frd_rad_s: Array  # (3,)
