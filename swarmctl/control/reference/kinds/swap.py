"""Every agent flies to the point opposite its start."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import MissionKind, Place, mission_kind
from swarmctl.control.reference.quintic import QuinticTrajectory
from swarmctl.core.goal import Goal
from swarmctl.core.types import Sampled


@mission_kind("swap")
class SwapParams(MissionKind):
    """Lets every agent fly smoothly to the point opposite its start, in `travel_s`."""

    travel_s: float = Field(8.0, gt=0, le=600)  # from one point to the other

    @property
    def fixed_in_time(self) -> bool:
        """Return False: agents find their ways past each other."""
        return False

    def reference(self, place: Place) -> Sampled:
        return self._flight(place).sample

    def goal(self, place: Place) -> Goal | None:
        return Goal(pos_ned_m=self._flight(place).to_ned_m)

    def ends_s(self, place: Place) -> float:
        return self.travel_s

    def problems(self, agents: int) -> Iterator[str]:
        if agents < 2:
            yield f"mission.kind = 'swap' with swarm.agents = {agents}: a swap needs at least 2"

    def _flight(self, place: Place) -> QuinticTrajectory:
        start = place.start_ned_m
        opposite = 2.0 * place.starts_ned_m.mean(axis=0) - start
        return QuinticTrajectory(from_ned_m=start, vel_ned_m_s=np.zeros(3), to_ned_m=opposite, travel_s=self.travel_s)
