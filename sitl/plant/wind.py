"""Air at each vehicle: mean wind, Dryden turbulence and 1-cosine gusts, all of MIL-F-8785C, low altitude.

Turbulence is independent for each vehicle (seeded); vehicles metres apart would really share some of it. It is constant
over one update, and Taylor's hypothesis turns lengths into times with the airspeed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.core.types import Array
from swarmctl.simulator_config import WindParams

_FOOT_M = 0.3048
_LOWEST_FT, _HIGHEST_FT = 10.0, 1000.0  # validity of the low-altitude forms
_SLOWEST_M_S = 1.0  # below this airspeed the motion of the eddies themselves dominates
_BLOCK = 64
_PURPOSE = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Gust:
    """A gust with its peak (3, N) NED [m/s] at half its length."""

    peak_ned_m_s: Array
    from_s: float
    for_s: float

    def over(self, t_s: float) -> bool:
        """Return whether the gust has ended."""
        return t_s > self.from_s + self.for_s

    def at(self, t_s: float) -> Array | None:
        """Return the velocity (3, N) [m/s]; None before and after."""
        x = (t_s - self.from_s) / self.for_s
        if not 0.0 <= x <= 1.0:
            return None
        return 0.5 * (1.0 - math.cos(2.0 * math.pi * x)) * self.peak_ned_m_s


@dataclass(frozen=True, slots=True, eq=False)
class WindStep:
    """A wind (3, N) NED [m/s] that blows from one instant to the next, until it is removed."""

    velocity_ned_m_s: Array

    def over(self, t_s: float) -> bool:
        """Return False: only its removal ends it."""
        return False

    def at(self, t_s: float) -> Array:
        """Return the velocity (3, N) [m/s]."""
        return self.velocity_ned_m_s


class Air:
    """Wind at all vehicles.

    Args:
        params: parameters of wind and turbulence.
        vehicles: number of vehicles.
        dt_s: time between two updates.
        seed: seed of the run.
        first_vehicle: number of the first vehicle in the swarm, by which each draws its own.
    """

    def __init__(self, params: WindParams, vehicles: int, dt_s: float, seed: int, *, first_vehicle: int = 0) -> None:
        self.mean_ned_m_s = np.array(params.mean_ned_m_s).reshape(3, 1)
        self._intensity_m_s = params.turbulence_m_s
        self._dt_s = dt_s
        self._count = vehicles
        self.gusts: list[Gust | WindStep] = []
        if any(params.gust_ned_m_s):
            peak = np.tile(np.array(params.gust_ned_m_s).reshape(3, 1), vehicles)
            self.gusts.append(Gust(peak_ned_m_s=peak, from_s=params.gust_at_s, for_s=params.gust_for_s))
        self._rngs = [np.random.default_rng([seed, first_vehicle + i, _PURPOSE]) for i in range(vehicles)]
        self._block = np.zeros((0, 5, vehicles))
        self._drawn = 0
        self._eddies = np.zeros((5, vehicles))  # states of the filters of u (1), v (2), w (2), driven to unit variance
        self._fresh = True

    @property
    def still(self) -> bool:
        """Whether the air is at rest and stays so unless a gust is added."""
        return not (self._intensity_m_s or self.gusts or self.mean_ned_m_s.any())

    def velocity_ned_m_s(self, t_s: float, height_m: Array, vel_ned_m_s: Array) -> Array:
        """Return the air velocity (3, N) at `t_s`, for vehicles at `height_m` (N,) with velocity (3, N)."""
        total = np.repeat(self.mean_ned_m_s, self._count, axis=1)
        if self._intensity_m_s:
            relative = vel_ned_m_s - self.mean_ned_m_s
            speed = np.maximum(np.sqrt(np.sum(relative * relative, axis=0)), _SLOWEST_M_S)
            total += self._turbulence(height_m, speed)
        if self.gusts:
            self.gusts[:] = [gust for gust in self.gusts if not gust.over(t_s)]
            for gust in self.gusts:
                blown = gust.at(t_s)
                if blown is not None:
                    total += blown
        return total

    def _turbulence(self, height_m: Array, speed_m_s: Array) -> Array:
        """Return the turbulence (3, N) NED: u along the mean wind, v across, w down."""
        height_ft = np.clip(height_m / _FOOT_M, _LOWEST_FT, _HIGHEST_FT)
        shape = 0.177 + 0.000823 * height_ft
        along_m, up_m = height_ft / shape**1.2 * _FOOT_M, height_ft * _FOOT_M  # scale lengths L_u = L_v, L_w
        sigma_w = 0.1 * self._intensity_m_s
        sigma_u = sigma_w / shape**0.4
        self._stir(self._dt_s * speed_m_s / along_m, self._dt_s * speed_m_s / up_m)
        u, v = sigma_u * self._eddies[0], sigma_u * _shaped(self._eddies[1:3])
        w = sigma_w * _shaped(self._eddies[3:5])
        east, north = float(self.mean_ned_m_s[1, 0]), float(self.mean_ned_m_s[0, 0])
        heading = math.atan2(east, north) if east or north else 0.0
        c, s = math.cos(heading), math.sin(heading)
        return np.stack([c * u - s * v, s * u + c * v, w])

    def _stir(self, across: Array, upward: Array) -> None:
        """Update the unit-variance eddies; arguments are the step over each filter's time constant L/V."""
        white = self._noise()
        if self._fresh:
            self._fresh = False
            self._eddies[[0, 1, 3]] = white[[0, 1, 3]]
            self._eddies[[2, 4]] = 0.5 * (white[[1, 3]] + white[[2, 4]])
        for first, step in ((0, across), (1, across), (3, upward)):
            fade = np.exp(-step)
            if first:
                self._eddies[first + 1] = fade * (self._eddies[first + 1] + step * self._eddies[first])
            self._eddies[first] = fade * self._eddies[first] + np.sqrt(1.0 - fade * fade) * white[first]

    def _noise(self) -> Array:
        if self._drawn == len(self._block):
            self._block = np.stack([rng.standard_normal((_BLOCK, 5)) for rng in self._rngs], axis=2)
            self._drawn = 0
        draws: Array = self._block[self._drawn]
        self._drawn += 1
        return draws


def _shaped(states: Array) -> Array:
    """Return the output of Dryden's (1 + sqrt(3) T s) / (1 + T s)^2 from its two states (2, N), unit variance."""
    root3 = math.sqrt(3.0)
    output: Array = (root3 * states[0] + (1.0 - root3) * states[1]) / math.sqrt(2.0)
    return output
