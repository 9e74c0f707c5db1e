"""Quintic trajectories: transits, stops and the flights of missions to a place, smooth in acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.core.types import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class QuinticTrajectory:
    """A quintic polynomial from a position and velocity to rest at a target, continuous in acceleration.

    The first velocity may be shed sooner than the target is reached: what it carries along grows with that time.
    """

    from_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    to_ned_m: Array  # (3,)
    travel_s: float
    shed_s: float | None = None  # time in which the first velocity decays; None: travel_s

    def sample(self, t_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) each, at times `t_s` (K,) [s] since the start."""
        shed_s = self.travel_s if self.shed_s is None else self.shed_s
        blend, slope = to_target(t_s / self.travel_s)
        coast, coast_slope = out_and_back(t_s / shed_s)
        delta = self.to_ned_m - self.from_ned_m
        pos = self.from_ned_m + blend * delta + coast * (shed_s * self.vel_ned_m_s)
        vel = slope * delta / self.travel_s + coast_slope * self.vel_ned_m_s
        return pos, vel


def to_target(elapsed_01: Array) -> tuple[Array, Array]:
    """Return the polynomial from 0 to 1, at rest at both ends, and its slope, (K, 1) each."""
    s = np.clip(elapsed_01, 0.0, 1.0)[:, None]
    s2, s3 = s**2, s**3
    return s3 * (10.0 - 15.0 * s + 6.0 * s2), 30.0 * s2 * (1.0 - s) ** 2


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
    travel_s = max(1.875 * distance / speed_m_s, math.sqrt(5.77 * distance / accel_m_s2), shed_s)
    return QuinticTrajectory(from_ned_m=pos, vel_ned_m_s=vel, to_ned_m=target, travel_s=travel_s, shed_s=shed_s)


def shedding_s(vel: Array, accel_m_s2: float) -> float:
    """Return the time in which a first velocity (3,) is shed, near an acceleration: at 1.31 of that at its peak."""
    return max(0.5, 3.0 * math.sqrt(float(vel @ vel)) / accel_m_s2)


def brake_to_rest(pos: Array, vel: Array, accel_m_s2: float) -> QuinticTrajectory:
    """Return a `QuinticTrajectory` that stops straight ahead: at half of `accel_m_s2` on average, 3/4 at its peak."""
    speed = math.sqrt(float(vel @ vel))
    travel_s = max(0.5, 2.0 * speed / accel_m_s2)
    return QuinticTrajectory(from_ned_m=pos, vel_ned_m_s=vel, to_ned_m=pos + 0.5 * travel_s * vel, travel_s=travel_s)
