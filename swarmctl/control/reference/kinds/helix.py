"""A helix that rises and sinks between two heights, so that it stays in its volume however long it is flown."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import Place, SharedReference, mission_kind
from swarmctl.core.params import Vec3
from swarmctl.core.types import Array, Sampled


@mission_kind("helix")
class HelixParams(SharedReference):
    """Describes a circle that rises by `height_m` and sinks again, smoothly, once in `rise_s`."""

    center_ned_m: Vec3 = (0.0, 0.0, -1.0)  # of the lowest circle
    radius_m: float = Field(3.0, ge=0, le=1000)  # of the circle
    omega_rad_s: float = Field(0.5, ge=-10, le=10)  # positive is clockwise seen from above
    height_m: float = Field(2.0, ge=0, le=1000)  # from the lowest to the highest circle
    rise_s: float = Field(40.0, ge=1, le=3600)  # up and down once

    def reference(self, place: Place) -> Sampled:
        return self._sample

    def _sample(self, t_s: Array) -> tuple[Array, Array]:
        angle, rise, turn = self.omega_rad_s * t_s, 2.0 * math.pi / self.rise_s, self.radius_m * self.omega_rad_s
        up = 0.5 * self.height_m * (1.0 - np.cos(rise * t_s))
        pos = np.stack([self.radius_m * np.cos(angle), self.radius_m * np.sin(angle), -up], axis=1)
        climb = 0.5 * self.height_m * rise * np.sin(rise * t_s)
        vel = np.stack([-turn * np.sin(angle), turn * np.cos(angle), -climb], axis=1)
        return pos + np.array(self.center_ned_m), vel
