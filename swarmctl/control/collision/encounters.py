"""Encounters: at which distance each keep-out that is violated now began to be, so that certified plans can't creep.

A path that starts inside a keep-out can't be refused for it, or nothing could be flown out. If each tick allowed it to
come a little closer than the vehicle is now, many ticks together would allow it to come as close as it wants. It is
therefore measured against the distance at which the encounter began.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import replace

from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts, stacked
from swarmctl.core.types import Array


class Encounters:
    """Remembers the distance at which each keep-out has been entered, until it is left."""

    def __init__(self) -> None:
        self._entered_m: dict[Hashable, float] = {}  # by `KeepOut.key`

    def noted(self, keep_outs: Sequence[KeepOut], pos_ned_m: Array) -> KeepOuts:
        """Return the keep-outs of this tick; those that the position (3,) violates say where they were entered."""
        known, entered_m = stacked(keep_outs), dict[Hashable, float]()
        if known:
            ways_m = (pos_ned_m - known.pos_ned_m[:, 0]).tolist()
            for keep_out, (north_m, east_m, down_m) in zip(known, ways_m, strict=True):
                apart_m = math.hypot(north_m, east_m, down_m * keep_out.vertical_01)
                if keep_out.key is not None and apart_m < keep_out.hard_min_distance_m:
                    entered_m[keep_out.key] = self._entered_m.get(keep_out.key, apart_m)
        self._entered_m = entered_m
        if not entered_m:
            return known
        found = (replace(k, entered_m=entered_m[k.key]) if k.key in entered_m else k for k in known)
        return KeepOuts(found, known.pos_ned_m)
