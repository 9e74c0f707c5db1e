"""An own mission: every agent winds outwards round its own start, flown by configs/examples/own_spiral.toml."""

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import MissionKind


class Spiral(MissionKind):
    grow_m_s: float = Field(0.1, ge=0, le=1)  # of the radius
    omega_rad_s: float = Field(0.8, ge=-3, le=3)

    def reference(self, place):
        """Return a function of mission times (K,) that returns positions and velocities, (K, 3) each, NED."""

        def sampled(t_s):
            cos, sin, zero = np.cos(self.omega_rad_s * t_s), np.sin(self.omega_rad_s * t_s), np.zeros(len(t_s))
            radius_m, turn_m_s = self.grow_m_s * t_s, self.grow_m_s * t_s * self.omega_rad_s
            pos = np.stack([radius_m * cos, radius_m * sin, zero], axis=1) + place.start_ned_m
            vel = np.stack([self.grow_m_s * cos - turn_m_s * sin, self.grow_m_s * sin + turn_m_s * cos, zero], axis=1)
            return pos, vel

        return sampled
