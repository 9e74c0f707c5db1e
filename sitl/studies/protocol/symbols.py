"""Symbols in place of trajectories: what a trajectory passes is a string of places, one letter each.

Two trajectories conflict when they pass the same place at the same time: a small letter is passed early, a capital one
late. One that has stopped on its way may be at each of its places at any time from then on. The planner offers any
trajectory it is told to, so the protocol is explored whatever a real planner would choose.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from swarmctl.control.commit.situation import DesiredReference, Situation
from swarmctl.core.trajectory import Trajectory, resting
from swarmctl.core.types import Array

_DT_US = 100_000
_TRAJECTORIES: dict[str, Trajectory] = {}  # one object each: the protocol compares them by identity
_PLACES: dict[int, str] = {}  # the other way round
ANYWHERE = DesiredReference(lambda offsets_s: (np.zeros((len(offsets_s), 3)), np.zeros((len(offsets_s), 3))))
NOWHERE = np.zeros(3)

WORLDS = {
    "pair": (("a", "x"), ("b", "x"), ("c",)),  # two meet, one only votes
    "crossing": (("a", "x"), ("b", "x"), ("c", "x")),  # one place that everybody wants
    "crossings": (("a", "x"), ("b", "xy"), ("c", "y")),  # two of the three do not meet
    "turns": (("a", "x"), ("b", "X"), ("c",)),  # two pass the same place one after the other, one only votes
    "follow": (("a", "b"), ("b", "x"), ("c", "x")),  # one wants where another stands, which wants to leave
}  # by agent, the trajectories it chooses from; it begins with the first


def trajectory_of(places: str) -> Trajectory:
    """Return the trajectory that passes these places."""
    if places not in _TRAJECTORIES:
        made = _TRAJECTORIES[places] = resting(NOWHERE, 0, _DT_US)
        _PLACES[id(made)] = places
    return _TRAJECTORIES[places]


def places_of(trajectory: Trajectory) -> str:
    """Return the places that a trajectory passes."""
    return _PLACES[id(trajectory)]


def in_conflict(one: str, other: str) -> bool:
    """Tell whether two trajectories pass the same place at the same time."""
    return not set(one).isdisjoint(other)


def at_any_time(places: str) -> str:
    """Return what is passed by a trajectory that has stopped somewhere among its places."""
    return "".join(sorted({*places.lower(), *places.upper()}))


class SymbolicPlanner:
    """Proposes the trajectory it is told to, where that is clear of what is known.

    Args:
        here: places that the vehicle passes when it stops at once.
        wanted: places to propose.
        doubts: whether a vehicle is met that may not fly as its agent has committed to.
    """

    def __init__(self, here: str, wanted: str, doubts: bool = False) -> None:
        self._here, self._wanted, self._doubts = here, wanted, doubts
        self.dt_us = _DT_US

    def proposal(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """See `Planner`."""
        wanted = trajectory_of(self._wanted)
        return None if self.conflicts(wanted, now.utc_us, now.followed) else wanted

    def conflicts(self, trajectory: Trajectory, utc_us: int, known: Sequence[Trajectory]) -> bool:
        """See `Planner`."""
        return any(in_conflict(places_of(trajectory), places_of(other)) for other in known)

    def is_clear(self, trajectory: Trajectory, now: Situation) -> bool:
        """There are no keep-outs but those of doubted vehicles."""
        return not self._doubts

    def stopping_from(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> Trajectory:
        """Return the trajectory by which the vehicle stops where it is."""
        return trajectory_of(self._here)

    def stopping_candidate(self, committed: Trajectory, brake_us: int, utc_us: int) -> Trajectory:
        """Return what is committed: nobody evades without keep-outs."""
        return committed

    def evasive_trajectory(self, committed: Trajectory, now: Situation, *, apart: bool = False) -> Trajectory | None:
        """Find none but what is wanted, where that is apart from all places that others pass."""
        return self._apart(self._wanted, now) if apart and self._wanted else None

    def may_halt_later(self, committed: Trajectory, now: Situation) -> bool:
        """Do not wait."""
        return False

    def halting(self, committed: Trajectory, now: Situation) -> Trajectory | None:
        """See `Planner`."""
        return self._apart(places_of(committed), now)

    def _apart(self, places: str, now: Situation) -> Trajectory | None:
        found = trajectory_of(at_any_time(places))
        return None if self.conflicts(found, now.utc_us, now.followed) else found
