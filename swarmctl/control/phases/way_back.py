"""The way from where a vehicle is into a mission whose reference moves. Pure.

The share of the reference grows smoothly from 0 to 1, that of the place left shrinks. What a first velocity carries
along aside, the way stays between that place and the places of the reference meanwhile: an offset from the reference
that decayed would lead below both where the reference sinks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from swarmctl.control.reference.mission import MissionReference
from swarmctl.control.reference.quintic import out_and_back, quintic_to, to_target
from swarmctl.core.types import Array, VehicleState

_POINTS = 60  # of a way whose speed and acceleration are checked
_LONGER, _MOST_LONGER = 1.15, 16  # factor of a travel time that is too short, and how often
_TURNS_ROUND = 1.6  # peak acceleration of a quintic whose first velocity leads elsewhere, over the one asked for


@dataclass(frozen=True, slots=True, kw_only=True)
class WayBack:
    """A way from a place and velocity to a moving reference."""

    began_us: int  # monotonic time
    from_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    travel_s: float
    shed_s: float  # time in which the first velocity decays

    def elapsed_s(self, now_us: int) -> float:
        """Return the time since it began."""
        return (now_us - self.began_us) * 1e-6

    def sample(self, t_s: Array, pos_ned_m: Array, vel_ned_m_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) each, at times `t_s` (K,) since its begin.

        Args:
            t_s: times.
            pos_ned_m, vel_ned_m_s: of the reference, (K, 3) at these times.
        """
        share, slope = to_target(t_s / self.travel_s)
        coast, coast_slope = out_and_back(t_s / self.shed_s)
        away = pos_ned_m - self.from_ned_m
        pos = self.from_ned_m + share * away + coast * (self.shed_s * self.vel_ned_m_s)
        vel = share * vel_ned_m_s + slope * away / self.travel_s + coast_slope * self.vel_ned_m_s
        return pos, vel

    def is_flown(self, pos_ned_m: Array, vel_ned_m_s: Array, speed_m_s: float, accel_m_s2: float) -> bool:
        """Return whether speed and acceleration stay near what a transit has, beside those of the reference.

        A reference that flies away has to be overtaken, which takes almost twice its speed however long the way takes.

        Args:
            pos_ned_m, vel_ned_m_s: reference, (K, 3) at times from 0 to `travel_s`.
            speed_m_s, accel_m_s2: peaks of a transit.
        """
        s = np.linspace(0.0, 1.0, len(pos_ned_m))[:, None]
        share, slope = to_target(s[:, 0])
        bend = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s)
        away = pos_ned_m - self.from_ned_m
        vel = share * vel_ned_m_s + slope * away / self.travel_s
        its_own_m_s2 = np.gradient(vel_ned_m_s, self.travel_s / (len(s) - 1), axis=0)
        joining_m_s2 = bend * away / self.travel_s**2 + 2.0 * slope * vel_ned_m_s / self.travel_s
        fastest_m_s, most_m_s2 = _longest(vel_ned_m_s), _TURNS_ROUND * accel_m_s2 + _longest(its_own_m_s2)
        slow = _longest(vel) <= fastest_m_s + max(speed_m_s, fastest_m_s)
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
    transit = quintic_to(here, first_m_s, pos[0], speed_m_s, accel_m_s2=accel_m_s2, shed_s=shed_s)
    way = WayBack(
        began_us=now_us,
        from_ned_m=here,
        vel_ned_m_s=first_m_s,
        travel_s=max(transit.travel_s, 3.0 * _longest(vel) / accel_m_s2),
        shed_s=shed_s,
    )
    for _ in range(_MOST_LONGER):
        reference = mission.sample(mission_t_s + np.linspace(0.0, way.travel_s, _POINTS))
        if way.is_flown(*reference, speed_m_s, accel_m_s2):
            break
        way = replace(way, travel_s=_LONGER * way.travel_s)
    return way


def _longest(vectors: Array) -> float:
    """Return the norm of the longest of vectors (K, 3)."""
    return float(np.sqrt((vectors * vectors).sum(axis=1).max()))
