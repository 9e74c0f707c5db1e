"""Keep-outs of what commitments say nothing about: obstacles, peers that take no part, and vehicles of silent ones."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np

from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts
from swarmctl.control.collision.separation import SeparationParams, keep_out_of_commitment
from swarmctl.core.trajectory_message import TrajectoryMessage
from swarmctl.core.types import Array, Phase


class NonParticipants:
    """Makes keep-outs on the grid of the planner of commitments.

    Args:
        world_model: paths and statuses of peers, and obstacles.
        separation: distances to keep.
        dt_us, steps: the grid.
    """

    def __init__(self, world_model: WorldModel, separation: SeparationParams, *, dt_us: int, steps: int) -> None:
        self._world_model, self._separation = world_model, separation
        self._dt_us, self._steps = dt_us, steps

    def keep_outs(
        self,
        t0_utc_us: int,
        here_ned_m: Array,
        begin_ned_m: Array,
        phase: Phase,
        *,
        without: Set[int],
        encounters: Encounters,
    ) -> KeepOuts:
        """Return keep-outs of obstacles and of peers but those in `without`, from `t0_utc_us` on.

        What a stale peer does is unknown, so its hard minimum distance includes all of the margin that grows with age.
        Those that are too close already say since which distance, so that plan by plan none comes closer.

        Args:
            t0_utc_us: UTC of the first point.
            here_ned_m: own position (3,) now.
            begin_ned_m: where the plan is at the first point, (3,).
            phase: own phase.
            without: peers to leave out.
            encounters: with plans that begin as late as this one.
        """
        found = self._world_model.keep_outs(
            here_ned_m, t0_utc_us, self._dt_us, self._steps, phase=phase, without=without
        )
        spent_m = self._separation.budget.planned_beyond_hard_min_m
        aged = (replace(k, hard_min_distance_m=max(k.hard_min_distance_m, k.radius_m - spent_m)) for k in found)
        return encounters.noted(KeepOuts(aged, found.pos_ned_m) if found else found, begin_ned_m)

    def without_setpoints(self, agents: Set[int], t0_utc_us: int) -> KeepOuts:
        """Return where vehicles of agents that fly by commitments are, from a time on, while no setpoint reaches them.

        An agent that freezes, or is lost with its host, tells nobody, and its autopilot flies elsewhere.
        """
        if not agents:
            return KeepOuts()
        separation, budget = self._separation, self._separation.budget
        ways = self._world_model.ways_without_setpoints(agents, t0_utc_us, self._dt_us, self._steps)
        return KeepOuts(keep_out_of_commitment(points, agent, separation, budget) for agent, points in ways.items())

    def ends(self, message: TrajectoryMessage) -> list[KeepOut]:
        """Return keep-outs where the trajectories end that a peer may follow."""
        ends = [np.tile(trajectory.pos_ned_m[-1], (2, 1)) for trajectory in message.followed]
        return [keep_out_of_commitment(end, message.agent, self._separation, self._separation.budget) for end in ends]


def most_are_heard(silent: Set[int], peers: Set[int]) -> bool:
    """Tell whether an agent and the peers that it hears are more than those that are silent.

    Otherwise its own link may be lost, or the bus, and others fly on as they have committed to.
    """
    return len(peers - silent) + 1 > len(silent)
