"""What the view is told of a flight: bounds, goals and obstacles. A launch hands it to the viewer as JSON."""

from __future__ import annotations

import math

from pydantic import Field

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import Params, Vec3


class AgentBounds(Params):
    """Bounds of one agent that the view draws its margins to, and where its reference comes to rest."""

    tilt_max_rad: float = 0.6
    thrust_min_01: float = 0.05
    thrust_max_01: float = 1.0
    goal_ned_m: Vec3 | None = None  # None: it does not come to rest


class ViewedFlight(Params):
    """The flight that a view shows."""

    agents: tuple[AgentBounds, ...] = Field(strict=False)
    separation_m: float = 0.9  # distance that agents keep; the spheres drawn have half of it as radius
    violation_m: float = 0.85  # distance below which the referee sees a violation
    tick_ms: float = 20.0  # until the next tick
    center_ned_m: Vec3 = (0.0, 0.0, -2.0)  # middle of the scene
    extent_m: float = 6.0  # from there to the edge
    obstacles: tuple[Obstacle, ...] = Field((), strict=False)  # until an operator replaces them

    @property
    def scale_m(self) -> float:
        """Length of the scale, about a third of the extent: 1, 2 or 5 times a power of ten; the grid's spacing too."""
        third_m = self.extent_m / 3.0
        power = 10.0 ** math.floor(math.log10(third_m))
        return max(step * power for step in (1, 2, 5) if step * power <= third_m)
