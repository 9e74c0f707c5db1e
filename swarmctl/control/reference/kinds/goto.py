"""Every agent flies to a goal of its own, or all to one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from pydantic import Field

from swarmctl.control.reference.goal_assignment import assigned_goals_ned_m
from swarmctl.control.reference.kind import MissionKind, Place, mission_kind
from swarmctl.control.reference.quintic import QuinticTrajectory, quintic_to
from swarmctl.core.goal import Goal
from swarmctl.core.params import FARTHEST_M, Vec3
from swarmctl.core.types import Sampled

OUTER_DELAY_S_M = 0.5  # delay of arrival per metre that a place is farther out


@mission_kind("goto")
class GotoParams(MissionKind):
    """Lets every agent fly smoothly to its goal and stay there, or around a goal that several share."""

    synonyms: ClassVar[tuple[str, ...]] = ("goal", "goals")

    goals_ned_m: tuple[Vec3, ...] = Field((), strict=False)  # one for each agent, or a single one for all
    speed_m_s: float = Field(2.0, gt=0, le=20)  # approximate peak
    accel_m_s2: float = Field(1.2, gt=0, le=20)  # approximate peak
    goal_assignment: bool = True  # replace goals that are too close by places around them

    @property
    def fixed_in_time(self) -> bool:
        """Return False: agents find their ways past each other."""
        return False

    def reference(self, place: Place) -> Sampled:
        return self._flight(place).sample

    def goal(self, place: Place) -> Goal | None:
        flight = self._flight(place)
        return Goal(pos_ned_m=flight.to_ned_m, needs_s=flight.travel_s)

    def problems(self, agents: int) -> Iterator[str]:
        goals = len(self.goals_ned_m)
        if goals not in (1, agents):
            yield f"mission.goto.goals_ned_m: {goals} goals for swarm.agents = {agents}; list one each, or one for all"
        far = [i for i, goal in enumerate(self.goals_ned_m) if max(map(abs, goal)) > FARTHEST_M]
        if far:
            yield f"mission.goto.goals_ned_m: goals {far} are more than {FARTHEST_M:g} m from the shared origin"

    def _flight(self, place: Place) -> QuinticTrajectory:
        starts = tuple(map(tuple, place.starts_ned_m.tolist()))
        return _goal_flights(self, starts, place.apart_m, OUTER_DELAY_S_M)[place.agent]


@lru_cache(maxsize=8)  # the goals of all agents are assigned at once, and each is asked for
def _goal_flights(
    params: GotoParams, starts: tuple[tuple[float, ...], ...], apart_m: float, outer_delay_s_m: float
) -> tuple[QuinticTrajectory, ...]:
    """Return the flight of every agent; agents that share a goal arrive together, outer ones a little later.

    A ring of agents that closes before the inner ones have arrived opens only after much pushing.
    """
    agents, starts_ned_m = len(starts), np.array(starts)
    goals = np.array(params.goals_ned_m) if params.goals_ned_m else starts_ned_m
    if len(goals) == 1:
        goals = np.tile(goals, (agents, 1))
    groups = [[i] for i in range(agents)]
    if params.goal_assignment:
        goals, groups = assigned_goals_ned_m(starts_ned_m, goals, apart_m)
    flights = [
        quintic_to(start, np.zeros(3), goal, params.speed_m_s, accel_m_s2=params.accel_m_s2)
        for start, goal in zip(starts_ned_m, goals, strict=True)
    ]
    for group in groups:
        slowest_s = max(flights[i].travel_s for i in group)
        from_center_m = np.linalg.norm(goals[group] - goals[group].mean(axis=0), axis=1)
        for i, outward_m in zip(group, from_center_m - from_center_m.min(), strict=True):
            flights[i] = replace(flights[i], travel_s=slowest_s + outer_delay_s_m * outward_m)
    return tuple(flights)
