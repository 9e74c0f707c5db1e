"""Plans on the ground as in the air, so that a processor too slow for it is known before take-off.

A plan takes most of the time of a tick, and nobody needs one before the vehicle flies: without rehearsals a computer
that can't carry its agents misses its deadlines for the first time when all of them are in the air.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.control.collision.keep_outs import NO_KEEP_OUTS, KeepOuts
from swarmctl.control.commit.situation import DesiredReference, Situation
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.mpc.problem import Problem, Start
from swarmctl.core.trajectory import resting
from swarmctl.core.types import Array, Phase, Reference


class Rehearsal:
    """Plans to hover where the climb ends, among the peers as they are now, and drops every plan.

    Args:
        controller: kept for rehearsals, as flights must not depend on how long a vehicle has stood.
        trajectory_planner: likewise, with guaranteed separation; None: the controller itself keeps clear of peers.
        period_us: time between two proposals.
        world_model: what to keep clear of.
    """

    def __init__(
        self,
        controller: Controller,
        trajectory_planner: TrajectoryPlanner | None,
        period_us: int,
        world_model: WorldModel,
    ) -> None:
        self._controller, self._trajectory_planner, self._world_model = controller, trajectory_planner, world_model
        self._period_us, self._next_us = period_us, 0

    def plan(self, utc_us: int, start: Start, top_ned_m: Array, keep_outs: KeepOuts) -> None:
        """Plan one tick.

        Args:
            utc_us: now.
            start: where a plan of this tick would begin.
            top_ned_m: (3,) where the climb ends.
            keep_outs: of peers and obstacles.
        """
        at_top = replace(start, pos_ned_m=top_ned_m, vel_ned_m_s=np.zeros(3))
        points = self._controller.longest + 1
        hover = Reference(np.tile(top_ned_m, (points, 1)), np.zeros((points, 3)), 0.0)
        if self._trajectory_planner is not None:
            self._propose(self._trajectory_planner, utc_us, top_ned_m)
            keep_outs = NO_KEEP_OUTS
        guess_ned_m = np.tile(top_ned_m, (self._controller.steps + 1, 1))
        self._controller.plan(
            Problem(
                start=at_top,
                reference=hover,
                disturbance_ned_m_s2=np.zeros(3),
                keep_outs=keep_outs,
                guess_ned_m=guess_ned_m,
            )
        )

    def _propose(self, planner: TrajectoryPlanner, utc_us: int, top_ned_m: Array) -> None:
        """Plan a proposal, when one would be due."""
        if utc_us < self._next_us:
            return
        self._next_us = utc_us + self._period_us
        others = self._world_model.keep_outs(top_ned_m, utc_us, planner.dt_us, planner.steps, phase=Phase.TRACK)
        hovers = DesiredReference(lambda ahead_s: (np.tile(top_ned_m, (len(ahead_s), 1)), np.zeros((len(ahead_s), 3))))
        now = Situation(
            utc_us=utc_us,
            begin_us=utc_us,
            desired=hovers,
            peers={},
            others=others,
            disturbance_ned_m_s2=np.zeros(3),
        )
        planner.proposal(resting(top_ned_m, utc_us, planner.dt_us), now)
