"""Quintic trajectories: transits, stops and the flights of missions to a place, smooth in acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from swarmctl.core.types import Array

_PEAK = 1.875  # speed of a quintic from rest, over its mean
_RAMPS = 3.08  # time of one with both given peaks, over speed / acceleration: 10 / sqrt(3) / 1.875, rounded up
_RAMPS_OF_SHED = 3.0  # its least time over that in which a first velocity is shed: together they else exceed both peaks


@dataclass(frozen=True, slots=True, kw_only=True)
class QuinticTrajectory:
    """A quintic polynomial from a position and velocity to rest at a target, continuous in acceleration.

    The first velocity may be shed sooner than the target is reached: what it carries along grows with that time. A long
    way is cruised at the peak speed between both halves of the polynomial, where that does not accelerate.
    """

    from_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    to_ned_m: Array  # (3,)
    travel_s: float
    shed_s: float | None = None  # time in which the first velocity decays; None: travel_s
    cruise_s: float = 0.0  # part of travel_s between both halves of the polynomial

    def sample(self, t_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) each, at times `t_s` (K,) [s] since the start."""
        shed_s = self.travel_s if self.shed_s is None else self.shed_s
        blend, slope = to_target(t_s, self.travel_s, self.cruise_s)
        coast, coast_slope = out_and_back(t_s / shed_s)
        delta = self.to_ned_m - self.from_ned_m
        pos = self.from_ned_m + blend * delta + coast * (shed_s * self.vel_ned_m_s)
        vel = slope * delta / (self.travel_s - self.cruise_s) + coast_slope * self.vel_ned_m_s
        return pos, vel


def to_target(t_s: Array, travel_s: float, cruise_s: float = 0.0) -> tuple[Array, Array]:
    """Return the share of a way from rest to rest, and its slope times the time of both ramps, (K, 1) each.

    Args:
        t_s: times (K,) since the start.
        travel_s: of the way.
        cruise_s: part of it at the peak speed; the rest is that of both ramps.
    """
    ramps_s = travel_s - cruise_s
    s, cruised_s = _ramped(t_s, ramps_s, cruise_s)
    s2, s3 = s**2, s**3
    of_ramps = _share_of_ramps(ramps_s, cruise_s)
    share = of_ramps * (s3 * (10.0 - 15.0 * s + 6.0 * s2) + _PEAK * cruised_s / ramps_s)
    return share, of_ramps * (30.0 * s2 * (1.0 - s) ** 2)


def bend_to_target(t_s: Array, travel_s: float, cruise_s: float = 0.0) -> Array:
    """Return the second derivative (K, 1) of the share of `to_target`, times the square of the time of both ramps."""
    ramps_s = travel_s - cruise_s
    s, _ = _ramped(t_s, ramps_s, cruise_s)
    return _share_of_ramps(ramps_s, cruise_s) * (60.0 * s * (1.0 - s) * (1.0 - 2.0 * s))


def _ramped(t_s: Array, ramps_s: float, cruise_s: float) -> tuple[Array, Array]:
    """Return how much of both ramps is over, 0 to 1, and for how long it was cruised, (K, 1) each."""
    cruised_s = np.clip(t_s - 0.5 * ramps_s, 0.0, cruise_s)
    return np.clip((t_s - cruised_s) / ramps_s, 0.0, 1.0)[:, None], cruised_s[:, None]


def _share_of_ramps(ramps_s: float, cruise_s: float) -> float:
    """Return the share of the way that is flown in both ramps."""
    return 1.0 / (1.0 + _PEAK * cruise_s / ramps_s)


def out_and_back(elapsed_01: Array) -> tuple[Array, Array]:
    """Return the polynomial from 0 to 0, with slope 1 at its beginning and at rest at its end, and its slope."""
    s = np.clip(elapsed_01, 0.0, 1.0)[:, None]
    s2, s3, s4 = s**2, s**3, s**4
    return s - 6.0 * s3 + 8.0 * s4 - 3.0 * s**5, 1.0 - 18.0 * s2 + 32.0 * s3 - 15.0 * s4


def quintic_to(
    pos: Array, vel: Array, target: Array, speed_m_s: float, *, accel_m_s2: float, shed_s: float | None = None
) -> QuinticTrajectory:
    """Return the fastest `QuinticTrajectory` whose peak speed and acceleration stay near the given ones.

    A quintic from rest peaks at 1.875 of its mean speed and at 5.77 distance / T^2. The first velocity is shed in
    `shed_s`, or as soon as the acceleration allows: over a long way it would carry the vehicle far beyond its start.
    """
    distance = math.dist(pos, target)
    shed_s = shedding_s(vel, accel_m_s2) if shed_s is None else shed_s
    travel_s = max(_PEAK * distance / speed_m_s, math.sqrt(5.77 * distance / accel_m_s2), shed_s)
    return QuinticTrajectory(from_ned_m=pos, vel_ned_m_s=vel, to_ned_m=target, travel_s=travel_s, shed_s=shed_s)


def transit_to(
    pos: Array, vel: Array, target: Array, speed_m_s: float, *, accel_m_s2: float, shed_s: float | None = None
) -> QuinticTrajectory:
    """Return `quintic_to`, cruised at its peak speed from the distance on at which one has both peaks.

    One quintic over 200 m takes almost twice as long as its peak speed would.
    """
    quintic = quintic_to(pos, vel, target, speed_m_s, accel_m_s2=accel_m_s2, shed_s=shed_s)
    ramps_s = max(_RAMPS * speed_m_s / accel_m_s2, _RAMPS_OF_SHED * (quintic.shed_s or 0.0))
    cruise_s = math.dist(pos, target) / speed_m_s - ramps_s / _PEAK
    return quintic if cruise_s <= 0.0 else replace(quintic, travel_s=ramps_s + cruise_s, cruise_s=cruise_s)


def shedding_s(vel: Array, accel_m_s2: float) -> float:
    """Return the time in which a first velocity (3,) is shed, near an acceleration: at 1.31 of that at its peak."""
    return max(0.5, 3.0 * math.sqrt(float(vel @ vel)) / accel_m_s2)


def brake_to_rest(pos: Array, vel: Array, accel_m_s2: float) -> QuinticTrajectory:
    """Return a `QuinticTrajectory` that stops straight ahead: at half of `accel_m_s2` on average, 3/4 at its peak."""
    speed = math.sqrt(float(vel @ vel))
    travel_s = max(0.5, 2.0 * speed / accel_m_s2)
    return QuinticTrajectory(from_ned_m=pos, vel_ned_m_s=vel, to_ned_m=pos + 0.5 * travel_s * vel, travel_s=travel_s)
