"""Computes the smallest distance within a live swarm; reports are interpolated to one grid of instants.

A silent agent is left out after one second, so that the distance of the others is still computed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Array
from swarmctl.telemetry.evaluation.tracks import GAP_US, GRID_US, interpolate

_SILENT_US = 1_000_000
_MOST_US = 10_000_000  # that is computed at once; what is older is left out


class SeparationFeed:
    """Takes batches of positions and returns the smallest pairwise distance at 50 Hz."""

    def __init__(self, agents: int) -> None:
        self._t_us: list[NDArray[np.int64]] = [np.zeros(0, np.int64) for _ in range(agents)]
        self._pos_ned_m: list[Array] = [np.zeros((0, 3)) for _ in range(agents)]
        self._next_us: int | None = None

    def offer(self, agent: int, t_us: NDArray[np.int64], pos_ned_m: Array, *, is_anew: bool = False) -> None:
        """Add positions (T, 3), NED, of an agent at `t_us` (T,), increasing; older ones than before are dropped.

        With `is_anew` they are by another clock than those before, which are forgotten.
        """
        if is_anew:
            self._t_us[agent], self._pos_ned_m[agent] = np.zeros(0, np.int64), np.zeros((0, 3))
        if len(self._t_us[agent]):  # a clock is better known than before
            newer = t_us > self._t_us[agent][-1]
            t_us, pos_ned_m = t_us[newer], pos_ned_m[newer]
        self._t_us[agent] = np.concatenate([self._t_us[agent], t_us])
        self._pos_ned_m[agent] = np.vstack([self._pos_ned_m[agent], pos_ned_m])

    def take(self) -> tuple[NDArray[np.int64], Array]:
        """Return instants (G,) and smallest distances (G,) [m] since the last call, up to the last common report."""
        ends_us = {agent: int(t_us[-1]) for agent, t_us in enumerate(self._t_us) if len(t_us)}
        if not ends_us:
            return np.zeros(0, np.int64), np.zeros(0)
        live = [agent for agent, end_us in ends_us.items() if end_us >= max(ends_us.values()) - _SILENT_US]
        until_us = min(ends_us[agent] for agent in live)
        if self._next_us is None or abs(until_us - self._next_us) > _MOST_US:
            self._next_us = max(until_us - _MOST_US, *(int(self._t_us[agent][0]) for agent in live))
        grid_us = np.arange(self._next_us, until_us + 1, GRID_US)
        if len(live) < 2 or not len(grid_us):
            return np.zeros(0, np.int64), np.zeros(0)
        at = [interpolate(grid_us, self._t_us[agent], self._pos_ned_m[agent], GAP_US) for agent in live]
        least_m = closest_pair_m(np.stack(at, axis=1))
        self._next_us = int(grid_us[-1]) + GRID_US
        self._forget(self._next_us - GAP_US)
        known = np.isfinite(least_m)
        return grid_us[known], least_m[known]

    def _forget(self, before_us: int) -> None:
        for agent, t_us in enumerate(self._t_us):
            first = int(np.searchsorted(t_us, before_us))
            first = min(first, max(0, len(t_us) - 1))  # the newest sample stays, because it decides who is live
            self._t_us[agent], self._pos_ned_m[agent] = t_us[first:], self._pos_ned_m[agent][first:]
