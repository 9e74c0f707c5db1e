"""Which peers fly elsewhere than on the trajectories that they have committed to, by their paths. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import TrajectoryMessage
from swarmctl.core.types import PredictedPath

_RECENT_US = 300_000  # largest age of a path that is compared


class _Compared(NamedTuple):
    """How far a path is from trajectories."""

    path: PredictedPath
    followed: tuple[Trajectory, ...]
    deviation_m: float

    def is_of(self, path: PredictedPath, followed: tuple[Trajectory, ...]) -> bool:
        """Return whether these very ones have been compared: neither changes in every tick."""
        if self.path is not path or len(self.followed) != len(followed):
            return False
        return all(one is other for one, other in zip(self.followed, followed, strict=True))


class Deviations:
    """Compares the newest path of each peer with its trajectories, once."""

    def __init__(self) -> None:
        self._compared: dict[int, _Compared] = {}

    def deviating(
        self,
        paths: Iterable[PredictedPath],
        messages: Mapping[int, TrajectoryMessage],
        utc_us: int,
        allowed_m: float,
    ) -> set[int]:
        """Return the peers whose recent path begins farther than `allowed_m` from all that they have committed to.

        Args:
            paths: newest ones.
            messages: newest ones, by agent.
            utc_us: now.
            allowed_m: by which a path may be off.
        """
        found = set()
        for path in paths:
            message = messages.get(path.agent)
            if message is None or not message.is_committed or path.t0_utc_us < utc_us - _RECENT_US:
                continue
            if self._deviation_m(path, message.followed) > allowed_m:
                found.add(path.agent)
        return found

    def _deviation_m(self, path: PredictedPath, followed: tuple[Trajectory, ...]) -> float:
        """Return how far the first point of a path is from where the nearest trajectory is at its time."""
        compared = self._compared.get(path.agent)
        if compared is None or not compared.is_of(path, followed):
            here = path.pos_ned_m[0].tolist()
            deviation_m = min((math.dist(here, each.at(path.t0_utc_us)[0]) for each in followed), default=math.inf)
            compared = self._compared[path.agent] = _Compared(path, followed, deviation_m)
        return compared.deviation_m
