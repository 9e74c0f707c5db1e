"""Steps about the own start, by which a vehicle's model is identified."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import MissionKind, Place, mission_kind
from swarmctl.control.reference.kinds.steps import held
from swarmctl.core.types import Array, Sampled

_STEP_DIRECTIONS = np.array(
    [(1, 0, 0), (0, 0, 0), (-1, 0, 0), (0, 0, 0), (0, 1, 0), (0, 0, 0), (0, -1, 0), (0, 0, 0), (0, 0, -1), (0, 0, 0)]
)


@mission_kind("identify")
class IdentifyParams(MissionKind):
    """Describes steps about the own start, to and fro along each axis, as `swarmctl check --identify` flies them."""

    has_own_verb: ClassVar[bool] = True
    jumps: ClassVar[bool] = True

    step_m: float = Field(2.0, gt=0.1, le=20)  # north, south, east, west
    climb_m: float = Field(0.5, ge=0, le=20)  # step up and back
    hold_s: float = Field(2.5, ge=0.5, le=30)  # before the next step
    repeats: int = Field(2, ge=1, le=20)  # number of times all steps are flown
    distance_max_m: float = Field(5.0, gt=0.1, le=100)  # beyond it the vehicle stops and lands
    speed_max_m_s: float = Field(5.0, gt=0.1, le=30)  # likewise

    @property
    def duration_s(self) -> float:
        """Return the duration of all steps and a final hover [s]."""
        return self.hold_s * (self.repeats * len(_STEP_DIRECTIONS) + 1)

    def rows(self) -> Array:
        """Return steps (R, 4): start time [s], and position relative to the start [m]."""
        places = np.tile(_STEP_DIRECTIONS, (self.repeats, 1)) * (self.step_m, self.step_m, self.climb_m)
        return np.column_stack([self.hold_s * np.arange(1, len(places) + 1), places])

    def reference(self, place: Place) -> Sampled:
        start, rows = place.start_ned_m, np.concatenate([np.zeros((1, 4)), self.rows()])
        return lambda t_s: (start + held(rows, t_s), np.zeros((len(t_s), 3)))

    def problems(self, agents: int) -> Iterator[str]:
        if self.distance_max_m < 1.5 * self.step_m:
            yield (
                f"mission.identify.distance_max_m = {self.distance_max_m}: less than 1.5 times step_m = "
                f"{self.step_m}; an overshoot would end the flight. Raise it or lower step_m"
            )

    def excess(self, start_ned_m: Array, pos_ned_m: Array, vel_ned_m_s: Array) -> str:
        """Say why an identification flight must end, or "": its vehicle is flown with a model that may be wrong."""
        away_m, speed_m_s = math.dist(pos_ned_m, start_ned_m), math.hypot(*vel_ned_m_s)
        if away_m > self.distance_max_m:
            return f"{away_m:.1f} m from its start; mission.identify.distance_max_m is {self.distance_max_m:g}"
        if speed_m_s > self.speed_max_m_s:
            return f"{speed_m_s:.1f} m/s fast; mission.identify.speed_max_m_s is {self.speed_max_m_s:g}"
        return ""
