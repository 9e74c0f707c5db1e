"""Piecewise constant positions, and how steps of any mission are sampled."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import Place, SharedReference, mission_kind
from swarmctl.core.types import Array, Sampled

Waypoint = Annotated[tuple[float, float, float, float], Field(strict=False)]


@mission_kind("steps")
class StepsParams(SharedReference):
    """Describes piecewise constant positions: rows of `[from_s, x, y, z]` in order of time (thesis 2.4)."""

    jumps: ClassVar[bool] = True

    rows: tuple[Waypoint, ...] = Field(((0.0, 1.0, 1.0, -1.0),), strict=False)  # the first from 0 s on

    def reference(self, place: Place) -> Sampled:
        rows = np.array(self.rows)
        return lambda t_s: (held(rows, t_s), np.zeros((len(t_s), 3)))

    def problems(self, agents: int) -> Iterator[str]:
        times = [row[0] for row in self.rows]
        if not times or times != sorted(times):
            yield f"mission.steps.rows: times {times} must be given, in increasing order"


def held(rows: Array, t_s: Array) -> Array:
    """Return positions (K, 3) at times (K,) of steps (R, 4)."""
    index = np.maximum(np.searchsorted(rows[:, 0], t_s + 1e-9, side="right") - 1, 0)
    held: Array = rows[index, 1:]
    return held
