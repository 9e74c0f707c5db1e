"""What a kind of mission is, and the registry of kinds.

A kind is the class of its parameters, which also says what is flown: one module of `kinds/` with one class and the
decorator `mission_kind`, nothing else. References are pure functions of time in the shared NED frame; the flight before
and after (to the start, to the landing place) is a `QuinticTrajectory`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, TypeVar

import numpy as np

from swarmctl.control.reference.goal_assignment import assigned_goals_ned_m
from swarmctl.core.goal import Goal
from swarmctl.core.params import Params
from swarmctl.core.types import Array, Sampled

MOVING_ROOM = 1.04  # places round a moving reference are farther apart than plans keep: tracking errors differ
SampledYaw = Callable[[Array], Array]  # yaws (K,) [rad], clockwise from north, at mission times (K,) >= 0 [s]


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Holds what a mission is told about the agent that flies it."""

    starts_ned_m: Array  # (agents, 3)
    agent: int  # own index
    apart_m: float  # distance that agents keep, for goals that several share

    @property
    def start_ned_m(self) -> Array:
        """Return the own start position (3,)."""
        start: Array = self.starts_ned_m[self.agent]
        return start


class MissionKind(Params):
    """Base of the parameters of one kind of mission; a kind without any has no section in the configuration."""

    synonyms: ClassVar[tuple[str, ...]] = ()  # other words, which are no names of kinds
    has_own_verb: ClassVar[bool] = False  # which flies it, whatever kind the configuration names
    jumps: ClassVar[bool] = False  # positions are steps, which no vehicle follows: speed and acceleration don't count

    @property
    def fixed_in_time(self) -> bool:
        """Return whether every agent is meant to be where its reference is, so that references must stay apart."""
        return True

    @abstractmethod
    def reference(self, place: Place) -> Sampled:
        """Return the reference of one agent as a function of mission time."""

    def heading(self, place: Place) -> SampledYaw | None:
        """Return the yaw of one agent as a function of mission time; None for `mission.yaw_rad`."""
        return None

    def offset_ned_m(self, place: Place) -> Array:
        """Return what an agent adds to its reference (3,), because several share it."""
        return np.zeros(3)

    def goal(self, place: Place) -> Goal | None:
        """Return where one agent is meant to arrive; None for a kind that is flown for its way."""
        return None

    def ends_s(self, place: Place) -> float | None:
        """Return the mission time from which the reference of one agent rests; None for a kind that never does."""
        return None

    def problems(self, agents: int) -> Iterator[str]:
        """Yield problems that involve several keys, if this kind is flown."""
        yield from ()

    def excess(self, start_ned_m: Array, pos_ned_m: Array, vel_ned_m_s: Array) -> str:
        """Say why the flight must end, or ""."""
        return ""


class SharedReference(MissionKind):
    """Base of the parameters of a mission in which all agents have the same reference."""

    goal_assignment: bool = False  # each agent follows a place of its own around the reference

    @property
    def fixed_in_time(self) -> bool:
        """Return False: agents that share a reference stay apart by their controllers."""
        return False

    def offset_ned_m(self, place: Place) -> Array:
        """Return the agent's place around the reference: as near as the distances that agents keep allow."""
        if not self.goal_assignment:
            return np.zeros(3)
        first = self.reference(place)(np.zeros(1))[0]
        starts = tuple(map(tuple, place.starts_ned_m.tolist()))
        places = _places_around(starts, tuple(first[0].tolist()), place.apart_m)
        offset: Array = np.array(places[place.agent]) - first[0]
        return offset


@lru_cache(maxsize=8)  # the places of all agents are assigned at once, and each is asked for
def _places_around(
    starts: tuple[tuple[float, ...], ...], shared: tuple[float, ...], apart_m: float
) -> tuple[tuple[float, ...], ...]:
    """Return the place of every agent (3,) around a shared position (3,), NED [m]."""
    wanted = np.tile(shared, (len(starts), 1))
    places, _ = assigned_goals_ned_m(np.array(starts), wanted, apart_m, room=MOVING_ROOM)
    return tuple(map(tuple, places.tolist()))


M = TypeVar("M", bound=MissionKind)
MISSIONS: dict[str, type[MissionKind]] = {}  # by the value of `mission.kind`


def mission_kind(name: str) -> Callable[[type[M]], type[M]]:
    """Return a decorator that makes a kind of mission known as `name`, also the name of its section."""

    def registered(kind: type[M]) -> type[M]:
        assert name not in MISSIONS
        MISSIONS[name] = kind
        return kind

    return registered
