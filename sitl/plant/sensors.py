"""Data that the autopilot has of itself: the estimate, and its local frame on the Earth.

Every vehicle's local NED frame starts at its own spawn point, rounded to the grid MAVLink can carry (1e-7 deg, 1 mm),
as every real EKF has its own origin. The plant's true position in the shared frame is the offset of that rounded origin
plus the local position, so a client that converts the origin back gets the truth exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pymap3d

from swarmctl.core.types import Array, GeoOrigin

_SEMI_MAJOR_M = 6378137.0
_ECCENTRICITY2 = 6.69437999014e-3  # WGS-84


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalOrigin:
    """Origin of one vehicle's local frame."""

    lat_e7: int
    lon_e7: int
    alt_mm: int
    offset_ned_m: Array  # (3,) of this origin in the shared frame
    metres_per_e7_north: float
    metres_per_e7_east: float

    def to_geo_e7(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Return latitude and longitude [1e-7 deg] of a local position; flat over the few km of a flight."""
        return self.lat_e7 + round(x_m / self.metres_per_e7_north), self.lon_e7 + round(y_m / self.metres_per_e7_east)

    def to_xy_m(self, lat_e7: float, lon_e7: float) -> tuple[float, float]:
        """Return the local position of a place [1e-7 deg], the inverse of `to_geo_e7`."""
        return (lat_e7 - self.lat_e7) * self.metres_per_e7_north, (lon_e7 - self.lon_e7) * self.metres_per_e7_east


def local_origin(spawn_ned_m: Array, shared: GeoOrigin) -> LocalOrigin:
    """Return the rounded local origin of a vehicle that spawns at `spawn_ned_m` (3,) in the shared frame."""
    lat, lon, alt = pymap3d.ned2geodetic(*(float(c) for c in spawn_ned_m), shared.lat_deg, shared.lon_deg, shared.alt_m)
    lat_e7, lon_e7, alt_mm = round(float(lat) * 1e7), round(float(lon) * 1e7), round(float(alt) * 1e3)
    offset = pymap3d.geodetic2ned(
        lat_e7 / 1e7, lon_e7 / 1e7, alt_mm / 1e3, shared.lat_deg, shared.lon_deg, shared.alt_m
    )
    sine = math.sin(math.radians(lat_e7 / 1e7))
    prime_m = _SEMI_MAJOR_M / math.sqrt(1 - _ECCENTRICITY2 * sine * sine)
    meridian_m = prime_m * (1 - _ECCENTRICITY2) / (1 - _ECCENTRICITY2 * sine * sine)
    e7_rad = math.radians(1e-7)
    return LocalOrigin(
        lat_e7=lat_e7,
        lon_e7=lon_e7,
        alt_mm=alt_mm,
        offset_ned_m=np.array([float(c) for c in offset]),
        metres_per_e7_north=e7_rad * (meridian_m + alt_mm / 1e3),
        metres_per_e7_east=e7_rad * (prime_m + alt_mm / 1e3) * max(1e-6, math.sqrt(1 - sine * sine)),
    )


class Power(NamedTuple):
    """Measurements of the autopilot's power module."""

    charge_01: float
    volts: float
    amperes: float  # negative: not measured


FULL = Power(1.0, 16.2, -1.0)  # as PX4's SIH reports its simulated pack


class Estimate(NamedTuple):
    """State of one vehicle as its autopilot estimates it, local NED."""

    t_us: int  # since boot
    pos_ned_m: tuple[float, float, float]
    vel_ned_m_s: tuple[float, float, float]
    q_nb: tuple[float, float, float, float]
    euler_rad: tuple[float, float, float]
    rate_frd_rad_s: tuple[float, float, float]
    down_axis_ned: tuple[float, float, float]  # body down axis
    on_ground: bool
    pos_accuracy_m: tuple[float, float] = (0.01, 0.01)  # 1 sigma as the autopilot reports it: horizontal, vertical
    gps_ok: bool = True
    gps_accuracy_m: tuple[float, float] = (0.01, 0.01)  # the same of the receiver; without a fix the last one
    battery: Power = FULL

    @property
    def yaw_rad(self) -> float:
        return self.euler_rad[2]
