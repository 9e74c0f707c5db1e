"""What a trajectory is planned for: the desired motion, and what is known of peers and obstacles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import TrajectoryMessage
from swarmctl.core.types import Array, Sampled

_RUN_UP_M_S2 = 0.8  # acceleration along a path up to its own speed


@dataclass(frozen=True, slots=True)
class DesiredReference:
    """Describes the motion an agent would follow if it were alone."""

    reference: Sampled
    follows_path: bool = False  # starts here, clear of obstacles: linearise around it


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """Collects the inputs of one plan.

    Args:
        utc_us: now.
        begin_us: UTC at which the plan begins.
        desired: motion to approximate.
        peers: newest message of each peer that takes part, by agent number.
        others: keep-outs of obstacles and of peers that do not take part, on the planner's grid from `begin_us` on.
        disturbance_ned_m_s2: (3,) estimated acceleration by wind, which leaves plans less authority.
    """

    utc_us: int
    begin_us: int
    desired: DesiredReference
    peers: Mapping[int, TrajectoryMessage]
    others: Sequence[KeepOut]
    disturbance_ned_m_s2: Array

    @property
    def followed(self) -> list[Trajectory]:
        """Return all trajectories that peers may follow from now on."""
        return [trajectory for message in self.peers.values() for trajectory in message.followed]


def slowed(desired: DesiredReference, from_ned_m: Array, pace_01: float) -> DesiredReference:
    """Return a motion between standing at a place (3,), for a pace of 0, and the desired one, for a pace of 1."""

    def reference(offsets_s: Array) -> tuple[Array, Array]:
        pos, vel = desired.reference(offsets_s)
        return from_ned_m + pace_01 * (pos - from_ned_m), pace_01 * vel

    return DesiredReference(reference, desired.follows_path)


def with_run_up(desired: DesiredReference, speed_m_s: float) -> DesiredReference:
    """Return the same path, entered at the agent's own speed and accelerated along.

    Half-spaces are linearised where the path says the agent will be. On a path that begins faster than the agent moves,
    they are those of the next corner, and plans cut the present one.
    """
    path_m_s = float(np.linalg.norm(desired.reference(np.zeros(1))[1]))
    if path_m_s <= speed_m_s:
        return desired
    rate_1_s = _RUN_UP_M_S2 / path_m_s
    slow_01 = speed_m_s / path_m_s
    run_up_s = (1.0 - slow_01) / rate_1_s  # until the path's own speed is reached

    def reference(offsets_s: Array) -> tuple[Array, Array]:
        spent_s = np.minimum(offsets_s, run_up_s)
        at_s = (slow_01 + 0.5 * rate_1_s * spent_s) * spent_s + (offsets_s - spent_s)
        pos, vel = desired.reference(at_s)
        return pos, vel * (slow_01 + rate_1_s * spent_s)[:, None]

    return DesiredReference(reference, follows_path=True)
