"""The place at which a mission leaves an agent, and when it counts as reached."""

from __future__ import annotations

from dataclasses import dataclass

from swarmctl.core.types import Array

REACHED_M = 0.3  # a vehicle nearer than this to its goal, and staying so, has reached it


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """Holds where a reference comes to rest for good."""

    pos_ned_m: Array  # (3,)
    needs_s: float = 0.0  # least mission time; 0 of a mission that may end on the way, which is warned of
