"""Encounters: at which distance each keep-out that is violated now began to be, so that certified plans can't creep.

A path that starts inside a keep-out can't be refused for it, or nothing could be flown out. If each tick allowed it to
come a little closer than the vehicle is now, many ticks together would allow it to come as close as it wants. It is
therefore measured against the distance at which the encounter began.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from swarmctl.control.collision.separation import KeepOut
from swarmctl.core.types import Array


class Encounters:
    """Remembers the distance at which each keep-out has been entered, until it is left."""

    def __init__(self) -> None:
        self._entered_m: dict[int, float] = {}  # by `KeepOut.key`

    def noted(self, keep_outs: Sequence[KeepOut], pos_ned_m: Array) -> list[KeepOut]:
        """Return the keep-outs of this tick; those that the position (3,) violates say where they were entered."""
        entered_m: dict[int, float] = {}
        found = []
        for keep_out in keep_outs:
            apart_m = keep_out.apart_m(pos_ned_m)
            if keep_out.key is None or apart_m >= keep_out.hard_min_distance_m:
                found.append(keep_out)
                continue
            entered_m[keep_out.key] = self._entered_m.get(keep_out.key, apart_m)
            found.append(replace(keep_out, entered_m=entered_m[keep_out.key]))
        self._entered_m = entered_m
        return found
