"""The way from where a vehicle is into a mission whose reference moves. Pure.

The share of the reference grows smoothly from 0 to 1, that of the place left shrinks. What a first velocity carries
along aside, the way stays between that place and the places of the reference meanwhile: an offset from the reference
that decayed would lead below both where the reference sinks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swarmctl.control.reference.mission import MissionReference
from swarmctl.control.reference.quintic import bend_to_target, out_and_back, to_target, transit_to
from swarmctl.core.types import Array, VehicleState

_POINTS = 60  # of a way whose speed and acceleration are checked, beside those of its cruise
_CRUISE_POINTS = 30
_LONGER, _MOST_LONGER = 1.15, 16  # factor of a travel time that is too short, and how often
_ROUNDING_M_S = 1e-9  # a cruise is at the peak speed
_TURNS_ROUND = 1.6  # peak acceleration of a quintic whose first velocity leads elsewhere, over the one asked for


@dataclass(frozen=True, slots=True, kw_only=True)
class WayBack:
    """A way from a place and velocity to a moving reference."""

    began_us: int  # monotonic time
    from_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    travel_s: float
    shed_s: float  # time in which the first velocity decays
    cruise_s: float = 0.0  # part of travel_s in which the share of the reference grows steadily

    def elapsed_s(self, now_us: int) -> float:
        """Return the time since it began."""
        return (now_us - self.began_us) * 1e-6

    def sample(self, t_s: Array, pos_ned_m: Array, vel_ned_m_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) each, at times `t_s` (K,) since its begin.

        Args:
            t_s: times.
            pos_ned_m, vel_ned_m_s: of the reference, (K, 3) at these times.
        """
        share, slope = to_target(t_s, self.travel_s, self.cruise_s)
        coast, coast_slope = out_and_back(t_s / self.shed_s)
        away, ramps_s = pos_ned_m - self.from_ned_m, self.travel_s - self.cruise_s
        pos = self.from_ned_m + share * away + coast * (self.shed_s * self.vel_ned_m_s)
        vel = share * vel_ned_m_s + slope * away / ramps_s + coast_slope * self.vel_ned_m_s
        return pos, vel

    def checked_s(self) -> Array:
        """Return the times (K,) at which speed and acceleration are checked, close together where it accelerates."""
        ramps_s = self.travel_s - self.cruise_s
        if self.cruise_s <= ramps_s:
            return np.linspace(0.0, self.travel_s, _POINTS)
        ramp_s = np.linspace(0.0, 0.5 * ramps_s, _POINTS // 2)
        cruise_s = 0.5 * ramps_s + np.linspace(0.0, self.cruise_s, _CRUISE_POINTS)[1:-1]
        return np.concatenate([ramp_s, cruise_s, self.travel_s - ramp_s[::-1]])

    def is_flown(self, t_s: Array, pos_ned_m: Array, vel_ned_m_s: Array, speed_m_s: float, accel_m_s2: float) -> bool:
        """Return whether speed and acceleration stay near what a transit has, beside those of the reference.

        A reference that flies away has to be overtaken, which takes almost twice its speed however long the way takes.

        Args:
            t_s: times `checked_s` (K,).
            pos_ned_m, vel_ned_m_s: of the reference, (K, 3) at these times.
            speed_m_s, accel_m_s2: peaks of a transit.
        """
        share, slope = to_target(t_s, self.travel_s, self.cruise_s)
        ramps_s = self.travel_s - self.cruise_s
        away = pos_ned_m - self.from_ned_m
        vel = share * vel_ned_m_s + slope * away / ramps_s
        its_own_m_s2 = np.gradient(vel_ned_m_s, t_s, axis=0)
        bend = bend_to_target(t_s, self.travel_s, self.cruise_s)
        joining_m_s2 = bend * away / ramps_s**2 + 2.0 * slope * vel_ned_m_s / ramps_s
        fastest_m_s, most_m_s2 = _longest(vel_ned_m_s), _TURNS_ROUND * accel_m_s2 + _longest(its_own_m_s2)
        slow = _longest(vel) <= fastest_m_s + max(speed_m_s, fastest_m_s) + _ROUNDING_M_S
        return slow and _longest(joining_m_s2 + share * its_own_m_s2) <= most_m_s2


def way_back(
    mission: MissionReference,
    mission_t_s: float,
    now_us: int,
    state: VehicleState,
    *,
    speed_m_s: float,
    accel_m_s2: float,
    shed_s: float,
) -> WayBack:
    """Return the way into a mission from where a vehicle is.

    It takes at least as long as a transit to where the reference is now, and longer where that moves.

    Args:
        mission: to join.
        mission_t_s: its time now.
        now_us: monotonic time.
        state: of the vehicle.
        speed_m_s, accel_m_s2: peaks of a transit.
        shed_s: time in which its velocity decays.
    """
    pos, vel = mission.sample(np.array([mission_t_s]))
    here, first_m_s = state.pos_ned_m, state.vel_ned_m_s
    transit = transit_to(here, first_m_s, pos[0], speed_m_s, accel_m_s2=accel_m_s2, shed_s=shed_s)
    way = WayBack(
        began_us=now_us,
        from_ned_m=here,
        vel_ned_m_s=first_m_s,
        travel_s=max(transit.travel_s, 3.0 * _longest(vel) / accel_m_s2),
        shed_s=shed_s,
        cruise_s=transit.cruise_s,
    )
    for _ in range(_MOST_LONGER):
        t_s = way.checked_s()
        if way.is_flown(t_s, *mission.sample(mission_t_s + t_s), speed_m_s, accel_m_s2):
            break
        way = replace(way, travel_s=_LONGER * way.travel_s, cruise_s=_LONGER * way.cruise_s)
    return way


def _longest(vectors: Array) -> float:
    """Return the norm of the longest of vectors (K, 3)."""
    return float(np.sqrt((vectors * vectors).sum(axis=1).max()))
