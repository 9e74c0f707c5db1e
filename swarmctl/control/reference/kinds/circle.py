"""The thesis' climbing circle."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import Place, SharedReference, mission_kind
from swarmctl.core.params import Vec3
from swarmctl.core.types import Array, Sampled


@mission_kind("circle")
class CircleParams(SharedReference):
    """Describes a climbing circle `center + (r cos wt, r sin wt, climb t)` (thesis 4.3; tracking sets have r 0.5)."""

    center_ned_m: Vec3 = (0.0, 0.0, -1.0)  # of the circle at mission start
    radius_m: float = Field(5.0, ge=0, le=1000)  # of the circle
    omega_rad_s: float = Field(0.5, ge=-10, le=10)  # positive is clockwise seen from above
    climb_ned_m_s: float = Field(-0.1, ge=-20, le=20)  # negative is up

    def reference(self, place: Place) -> Sampled:
        return self._sample

    def _sample(self, t_s: Array) -> tuple[Array, Array]:
        angle, speed = self.omega_rad_s * t_s, self.radius_m * self.omega_rad_s
        cos, sin = np.cos(angle), np.sin(angle)
        pos, vel = np.empty((len(t_s), 3)), np.empty((len(t_s), 3))
        pos[:, 0], pos[:, 1], pos[:, 2] = self.radius_m * cos, self.radius_m * sin, self.climb_ned_m_s * t_s
        vel[:, 0], vel[:, 1], vel[:, 2] = -speed * sin, speed * cos, self.climb_ned_m_s
        pos += self.center_ned_m
        return pos, vel
