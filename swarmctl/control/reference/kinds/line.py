"""A straight line at constant velocity."""

from __future__ import annotations

import numpy as np

from swarmctl.control.reference.kind import Place, SharedReference, mission_kind
from swarmctl.core.params import Vec3
from swarmctl.core.types import Sampled


@mission_kind("line")
class LineParams(SharedReference):
    """Describes a straight line at constant velocity (thesis 4.4)."""

    origin_ned_m: Vec3 = (2.0, 2.0, -2.0)  # position at mission start
    velocity_ned_m_s: Vec3 = (1.5, 0.7, -0.1)  # along the line

    def reference(self, place: Place) -> Sampled:
        origin, velocity = np.array(self.origin_ned_m), np.array(self.velocity_ned_m_s)
        return lambda t_s: (origin + t_s[:, None] * velocity, np.tile(velocity, (len(t_s), 1)))
