"""A figure-8 that all agents share."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import Place, SharedReference, mission_kind
from swarmctl.core.params import Vec3
from swarmctl.core.types import Array, Sampled


@mission_kind("lemniscate")
class LemniscateParams(SharedReference):
    """Describes a figure-8 `center + (length sin wt, width sin 2wt, 0)`: one loop north of its centre, one south."""

    synonyms: ClassVar[tuple[str, ...]] = ("figure8", "figure_8", "figure-8", "eight")

    center_ned_m: Vec3 = (0.0, 0.0, -1.5)  # where both loops meet, and where it begins
    length_m: float = Field(4.0, ge=0, le=1000)  # from the centre to the end of a loop, north
    width_m: float = Field(2.0, ge=0, le=1000)  # from the axis to the side of a loop, east
    omega_rad_s: float = Field(0.4, ge=-10, le=10)  # a whole figure takes 2 pi / omega

    def reference(self, place: Place) -> Sampled:
        return self._sample

    def _sample(self, t_s: Array) -> tuple[Array, Array]:
        w, angle = self.omega_rad_s, self.omega_rad_s * t_s
        zero = np.zeros(len(t_s))
        pos = np.stack([self.length_m * np.sin(angle), self.width_m * np.sin(2.0 * angle), zero], axis=1)
        rate = np.stack([self.length_m * w * np.cos(angle), 2.0 * self.width_m * w * np.cos(2.0 * angle), zero], axis=1)
        return pos + np.array(self.center_ned_m), rate
