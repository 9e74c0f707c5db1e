"""Mission references: position and velocity at a given mission time, shared by all agents unless each has its own.

A kind of mission is the class of its parameters, which also says what is flown: one class with the decorator
`mission_kind`, nothing else. References are pure functions of time; the flight before and after (to the start, to the
landing place) is a `QuinticTrajectory`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import numpy as np
from pydantic import Field

from swarmctl.control.reference.goal_assignment import assigned_goals_ned_m
from swarmctl.core.params import Params, Vec3, with_sections
from swarmctl.core.types import Array

_STEP_DIRECTIONS = np.array(
    [(1, 0, 0), (0, 0, 0), (-1, 0, 0), (0, 0, 0), (0, 1, 0), (0, 0, 0), (0, -1, 0), (0, 0, 0), (0, 0, -1), (0, 0, 0)]
)
MOVING_ROOM = 1.04  # places round a moving reference are farther apart than plans keep: tracking errors differ
OUTER_DELAY_S_M = 0.5  # delay of arrival per metre that a place is farther out
Waypoint = Annotated[tuple[float, float, float, float], Field(strict=False)]
Sampled = Callable[[Array], tuple[Array, Array]]  # positions and velocities (K, 3) NED at times (K,) >= 0 [s]


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

    @abstractmethod
    def reference(self, place: Place) -> Sampled:
        """Return the reference of one agent as a function of mission time."""

    def offset_ned_m(self, place: Place) -> Array:
        """Return what an agent adds to its reference (3,), because several share it."""
        return np.zeros(3)

    def problems(self, agents: int) -> Iterator[str]:
        """Yield problems that involve several keys, if this kind is flown."""
        yield from ()

    def excess(self, start_ned_m: Array, pos_ned_m: Array, vel_ned_m_s: Array) -> str:
        """Say why the flight must end, or ""."""
        return ""


M = TypeVar("M", bound=MissionKind)
MISSIONS: dict[str, type[MissionKind]] = {}  # by the value of `mission.kind`


def mission_kind(name: str) -> Callable[[type[M]], type[M]]:
    """Return a decorator that makes a kind of mission known as `name`, also the name of its section."""

    def registered(kind: type[M]) -> type[M]:
        assert name not in MISSIONS
        MISSIONS[name] = kind
        return kind

    return registered


class SharedReference(MissionKind):
    """Base of the parameters of a mission in which all agents have the same reference."""

    goal_assignment: bool = False  # each agent follows a place of its own around the reference

    def offset_ned_m(self, place: Place) -> Array:
        """Return the agent's place around the reference: as near as the distances that agents keep allow."""
        if not self.goal_assignment:
            return np.zeros(3)
        first = self.reference(place)(np.zeros(1))[0]
        shared = np.tile(first, (len(place.starts_ned_m), 1))
        offset: Array = (
            assigned_goals_ned_m(place.starts_ned_m, shared, place.apart_m, room=MOVING_ROOM)[0][place.agent] - first[0]
        )
        return offset


@mission_kind("hover")
class HoverParams(MissionKind):
    """Lets every agent stay at its start."""

    def reference(self, place: Place) -> Sampled:
        start = place.start_ned_m
        return lambda t_s: (np.tile(start, (len(t_s), 1)), np.zeros((len(t_s), 3)))


@mission_kind("circle")
class CircleParams(SharedReference):
    """Describes a climbing circle `center + (r cos wt, r sin wt, climb t)` (thesis 4.3; tracking sets have r 0.5)."""

    center_ned_m: Vec3 = (0.0, 0.0, -1.0)  # of the circle at mission start
    radius_m: float = Field(5.0, ge=0, le=1000)  # of the circle
    omega_rad_s: float = Field(0.5, ge=-10, le=10)  # positive is clockwise seen from above
    climb_ned_m_s: float = Field(-0.1, ge=-20, le=20)  # negative is up

    def reference(self, place: Place) -> Sampled:
        return self._sample

    def _sample(self, t_s: Array) -> tuple[Array, Array]:
        angle = self.omega_rad_s * t_s
        cos, sin = np.cos(angle), np.sin(angle)
        around = np.stack([self.radius_m * cos, self.radius_m * sin, self.climb_ned_m_s * t_s], axis=1)
        speed = self.radius_m * self.omega_rad_s
        vel = np.stack([-speed * sin, speed * cos, np.full(len(t_s), self.climb_ned_m_s)], axis=1)
        return around + np.array(self.center_ned_m), vel


@mission_kind("line")
class LineParams(SharedReference):
    """Describes a straight line at constant velocity (thesis 4.4)."""

    origin_ned_m: Vec3 = (2.0, 2.0, -2.0)  # position at mission start
    velocity_ned_m_s: Vec3 = (1.5, 0.7, -0.1)  # along the line

    def reference(self, place: Place) -> Sampled:
        origin, velocity = np.array(self.origin_ned_m), np.array(self.velocity_ned_m_s)
        return lambda t_s: (origin + t_s[:, None] * velocity, np.tile(velocity, (len(t_s), 1)))


@mission_kind("steps")
class StepsParams(SharedReference):
    """Describes piecewise constant positions: rows of `[from_s, x, y, z]` in order of time (thesis 2.4)."""

    rows: tuple[Waypoint, ...] = Field(((0.0, 1.0, 1.0, -1.0),), strict=False)  # the first from 0 s on

    def reference(self, place: Place) -> Sampled:
        rows = np.array(self.rows)
        return lambda t_s: (_held(rows, t_s), np.zeros((len(t_s), 3)))

    def problems(self, agents: int) -> Iterator[str]:
        times = [row[0] for row in self.rows]
        if not times or times != sorted(times):
            yield f"mission.steps.rows: times {times} must be given, in increasing order"


@mission_kind("swap")
class SwapParams(MissionKind):
    """Lets every agent fly smoothly to the point opposite its start, in `travel_s`."""

    travel_s: float = Field(8.0, gt=0, le=600)  # from one point to the other

    def reference(self, place: Place) -> Sampled:
        start = place.start_ned_m
        opposite = 2.0 * place.starts_ned_m.mean(axis=0) - start
        return QuinticTrajectory(
            from_ned_m=start, vel_ned_m_s=np.zeros(3), to_ned_m=opposite, travel_s=self.travel_s
        ).sample

    def problems(self, agents: int) -> Iterator[str]:
        if agents < 2:
            yield f"mission.kind = 'swap' with swarm.agents = {agents}: a swap needs at least 2"


@mission_kind("goto")
class GotoParams(MissionKind):
    """Lets every agent fly smoothly to its goal and stay there, or around a goal that several share."""

    goals_ned_m: tuple[Vec3, ...] = Field((), strict=False)  # one for each agent, or a single one for all
    speed_m_s: float = Field(2.0, gt=0, le=20)  # approximate peak
    accel_m_s2: float = Field(1.2, gt=0, le=20)  # approximate peak
    goal_assignment: bool = True  # replace goals that are too close by places around them

    def reference(self, place: Place) -> Sampled:
        return _goal_flights(self, place.starts_ned_m, place.apart_m)[place.agent].sample

    def problems(self, agents: int) -> Iterator[str]:
        goals = len(self.goals_ned_m)
        if goals not in (1, agents):
            yield f"mission.goto.goals_ned_m: {goals} goals for swarm.agents = {agents}; list one each, or one for all"


@mission_kind("identify")
class IdentifyParams(MissionKind):
    """Describes steps about the own start, to and fro along each axis, as `swarmctl check --identify` flies them."""

    step_m: float = Field(2.0, gt=0.1, le=20)  # north, south, east, west
    climb_m: float = Field(0.5, ge=0, le=20)  # step up and back
    hold_s: float = Field(2.5, ge=0.5, le=30)  # before the next step
    repeats: int = Field(2, ge=1, le=20)  # number of times all steps are flown
    distance_max_m: float = Field(5.0, gt=0.1, le=100)  # beyond it the vehicle stops and lands
    speed_max_m_s: float = Field(5.0, gt=0.1, le=30)  # likewise

    @property
    def duration_s(self) -> float:
        """Return the duration of all steps and a final hover [s]."""
        return self.hold_s * (self.repeats * len(_STEP_DIRECTIONS) + 1)

    def rows(self) -> Array:
        """Return steps (R, 4): start time [s], and position relative to the start [m]."""
        places = np.tile(_STEP_DIRECTIONS, (self.repeats, 1)) * (self.step_m, self.step_m, self.climb_m)
        return np.column_stack([self.hold_s * np.arange(1, len(places) + 1), places])

    def reference(self, place: Place) -> Sampled:
        start, rows = place.start_ned_m, np.concatenate([np.zeros((1, 4)), self.rows()])
        return lambda t_s: (start + _held(rows, t_s), np.zeros((len(t_s), 3)))

    def problems(self, agents: int) -> Iterator[str]:
        if self.distance_max_m < 1.5 * self.step_m:
            yield (
                f"mission.identify.distance_max_m = {self.distance_max_m}: less than 1.5 times step_m = "
                f"{self.step_m}; an overshoot would end the flight. Raise it or lower step_m"
            )

    def excess(self, start_ned_m: Array, pos_ned_m: Array, vel_ned_m_s: Array) -> str:
        """Say why an identification flight must end, or "": its vehicle is flown with a model that may be wrong."""
        away_m, speed_m_s = math.dist(pos_ned_m, start_ned_m), math.hypot(*vel_ned_m_s)
        if away_m > self.distance_max_m:
            return f"{away_m:.1f} m from its start; mission.identify.distance_max_m is {self.distance_max_m:g}"
        if speed_m_s > self.speed_max_m_s:
            return f"{speed_m_s:.1f} m/s fast; mission.identify.speed_max_m_s is {self.speed_max_m_s:g}"
        return ""


if TYPE_CHECKING:
    MissionName = str
else:
    MissionName = Literal[tuple(MISSIONS)]


@with_sections({name: kind for name, kind in MISSIONS.items() if kind.model_fields})
class MissionParams(Params):
    """Sets what is flown between start and landing."""

    kind: MissionName = "circle"
    duration_s: float = Field(37.7, gt=0, le=36000)  # tracked time, without transits; overridden by --duration
    yaw_rad: float = Field(0.0, ge=-3.1416, le=3.1416)  # heading of every vehicle, clockwise from north

    def flown(self) -> MissionKind:
        """Return the parameters of the kind that is flown."""
        kind = MISSIONS[self.kind]
        return self.section(kind) if kind.model_fields else kind()

    def problems(self, agents: int) -> Iterator[str]:
        """Yield problems that involve several keys."""
        return self.flown().problems(agents)


class MissionReference:
    """Computes the reference of one agent.

    Args:
        params: the mission.
        starts_ned_m: (agents, 3) start positions.
        agent: own index.
        apart_m: distance that agents keep, for goals that several share.

    Attributes:
        offset_ned_m: own place (3,) around a reference that several share; the error of tracking is that to the latter.
    """

    def __init__(self, params: MissionParams, starts_ned_m: Array, agent: int, apart_m: float = 0.0) -> None:
        self._mission, self._start_ned_m = params.flown(), starts_ned_m[agent]
        place = Place(starts_ned_m=starts_ned_m, agent=agent, apart_m=apart_m)
        self._sampled, self.offset_ned_m = self._mission.reference(place), self._mission.offset_ned_m(place)

    def sample(self, t_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) NED each, at mission times `t_s` (K,); at rest before 0."""
        pos, vel = self._sampled(np.maximum(t_s, 0.0))
        vel[t_s < 0.0] = 0.0
        return pos + self.offset_ned_m, vel

    def excess(self, pos_ned_m: Array, vel_ned_m_s: Array) -> str:
        """Say why the flight must end at this position and velocity (3,) NED, or ""."""
        return self._mission.excess(self._start_ned_m, pos_ned_m, vel_ned_m_s)


def _held(rows: Array, t_s: Array) -> Array:
    """Return positions (K, 3) at times (K,) of steps (R, 4)."""
    index = np.maximum(np.searchsorted(rows[:, 0], t_s + 1e-9, side="right") - 1, 0)
    held: Array = rows[index, 1:]
    return held


def _goal_flights(params: GotoParams, starts_ned_m: Array, apart_m: float) -> list[QuinticTrajectory]:
    """Return the flight of every agent; agents that share a goal arrive together, outer ones a little later.

    A ring of agents that closes before the inner ones have arrived opens only after much pushing.
    """
    agents = len(starts_ned_m)
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
            flights[i] = replace(flights[i], travel_s=slowest_s + OUTER_DELAY_S_M * outward_m)
    return flights


@dataclass(frozen=True, slots=True, kw_only=True)
class QuinticTrajectory:
    """A quintic polynomial from a position and velocity to rest at a target, continuous in acceleration."""

    from_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    to_ned_m: Array  # (3,)
    travel_s: float

    def sample(self, t_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) each, at times `t_s` (K,) [s] since the start."""
        s = np.clip(t_s / self.travel_s, 0.0, 1.0)[:, None]
        delta, carry = self.to_ned_m - self.from_ned_m, self.vel_ned_m_s * self.travel_s
        s2, s3, s4 = s**2, s**3, s**4
        blend = s3 * (10.0 - 15.0 * s + 6.0 * s2)
        coast = s - 6.0 * s3 + 8.0 * s4 - 3.0 * s**5
        pos = self.from_ned_m + blend * delta + coast * carry
        slope = 30.0 * s2 * (1.0 - s) ** 2
        coast_slope = 1.0 - 18.0 * s2 + 32.0 * s3 - 15.0 * s4
        vel = (slope * delta + coast_slope * carry) / self.travel_s
        return pos, vel


def quintic_to(pos: Array, vel: Array, target: Array, speed_m_s: float, *, accel_m_s2: float) -> QuinticTrajectory:
    """Return the fastest `QuinticTrajectory` whose peak speed and acceleration stay near the given ones.

    A quintic from rest peaks at 1.875 of its mean speed and at 5.77 distance / T^2.
    """
    distance = math.dist(pos, target)
    initial = math.sqrt(float(vel @ vel))
    travel_s = max(1.875 * distance / speed_m_s, math.sqrt(5.77 * distance / accel_m_s2), 3.0 * initial / accel_m_s2)
    return QuinticTrajectory(from_ned_m=pos, vel_ned_m_s=vel, to_ned_m=target, travel_s=max(travel_s, 0.5))


def brake_to_rest(pos: Array, vel: Array, accel_m_s2: float) -> QuinticTrajectory:
    """Return a `QuinticTrajectory` that stops straight ahead, about as soon as `accel_m_s2` allows."""
    speed = math.sqrt(float(vel @ vel))
    travel_s = max(0.5, 2.0 * speed / accel_m_s2)
    return QuinticTrajectory(from_ned_m=pos, vel_ned_m_s=vel, to_ned_m=pos + 0.5 * travel_s * vel, travel_s=travel_s)
