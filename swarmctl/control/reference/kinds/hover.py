"""Every agent stays at its start."""

from __future__ import annotations

import numpy as np

from swarmctl.control.reference.kind import MissionKind, Place, mission_kind
from swarmctl.core.types import Sampled


@mission_kind("hover")
class HoverParams(MissionKind):
    """Lets every agent stay at its start."""

    def reference(self, place: Place) -> Sampled:
        start = place.start_ned_m
        return lambda t_s: (np.tile(start, (len(t_s), 1)), np.zeros((len(t_s), 3)))
