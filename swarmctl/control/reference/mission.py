"""Mission references: position, velocity, acceleration and yaw at a given mission time.

The kinds that a configuration can choose from are the modules of `kinds/`, each found by being there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from swarmctl.control.reference import kinds
from swarmctl.control.reference.kind import MISSIONS, MissionKind, Place, SampledYaw
from swarmctl.control.reference.polynomial import through
from swarmctl.core.discovery.declared import modules_of
from swarmctl.core.discovery.own import BuiltInOrOwn, OwnError, in_words, own_class
from swarmctl.core.params import Params, with_sections
from swarmctl.core.text import printable
from swarmctl.core.types import Array, Sampled

GROUP = "swarmctl.missions"  # of entry points
_ROW_S, _MAX_ROWS = 0.02, 100_000  # of the table that an own mission becomes
_MAX_SHOWN = 120  # characters of what an own mission says
_DIFFERENCE_S = 1e-3  # half the step of the difference of velocities that acceleration is

_MODULES = tuple(modules_of(kinds))  # importing a module makes its kinds known
_KINDS = dict(sorted(MISSIONS.items()))
if TYPE_CHECKING:
    MissionName = str
else:
    _SYNONYMS = tuple((word, name) for name, kind in _KINDS.items() for word in kind.synonyms)
    MissionName = Annotated[str, BuiltInOrOwn(tuple(_KINDS), GROUP, _SYNONYMS)]


@with_sections({name: kind for name, kind in _KINDS.items() if kind.model_fields})
class MissionParams(Params):
    """Sets what is flown between start and landing."""

    kind: MissionName = "circle"  # its parameters are in the section of that name
    duration_s: float = Field(37.7, gt=0, le=36000)  # tracked time, without transits; overridden by --duration
    yaw_rad: float = Field(0.0, ge=-3.1416, le=3.1416)  # heading of every vehicle, clockwise from north
    own: dict[str, Any] = Field({})  # parameters of an own kind

    @property
    def is_own(self) -> bool:
        """Tell whether the kind is somebody else's."""
        return self.kind not in _KINDS

    def own_params(self) -> type[MissionKind]:
        """Return the class of an own mission, which is that of its parameters.

        Raises:
            OwnError: there is no such own kind.
        """
        found: type[MissionKind] = own_class(self.kind, GROUP, MissionKind)
        return found

    def flown(self) -> MissionKind:
        """Return the parameters of the kind that is flown.

        Raises:
            OwnError: there is no such own kind.
            ValidationError: its parameters are wrong.
        """
        if self.is_own:
            return self.own_params().model_validate(self.own)
        kind = _KINDS[self.kind]
        return self.section(kind) if kind.model_fields else kind()

    def unused_sections(self) -> list[str]:
        """Return the sections with values other than the default of kinds that are not flown."""
        others = {name: kind for name, kind in _KINDS.items() if name != self.kind and not kind.has_own_verb}
        found = [name for name, kind in others.items() if kind.model_fields and self.section(kind) != kind()]
        return [*found, *(["own"] if self.own and not self.is_own else [])]

    def kind_problems(self) -> Iterator[str]:
        """Yield that sections of a kind are set but no kind, so that the default one would be flown."""
        if "kind" not in self.model_fields_set and (unused := self.unused_sections()):
            (named, *others) = unused
            meant = "'module:Class'" if named == "own" else repr(named)
            also = f", as {' and '.join(f'mission.{name}' for name in others)}" if others else ""
            flown = f"{self.kind!r} would be flown, which is the default"
            yield f"mission.{named} is set{also}, mission.kind is not: {flown}. Set mission.kind = {meant}"

    def problems(self, agents: int) -> Iterator[str]:
        """Yield problems that involve several keys."""
        if not self.is_own:
            yield from self.flown().problems(agents)
            return
        try:
            yield from [str(problem) for problem in self.flown().problems(agents)]
        except (Exception, SystemExit) as error:  # whatever it does
            yield f"mission.kind = {self.kind!r}: its problems raised {in_words(error)}"

    def references(self, starts_ned_m: Array, apart_m: float) -> list[MissionReference]:
        """Return the reference of every agent; see `MissionReference`."""
        return [MissionReference(self, starts_ned_m, agent, apart_m) for agent in range(len(starts_ned_m))]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flown:
    """Holds what a mission asks of one agent."""

    sampled: Sampled
    heading: SampledYaw | None
    offset_ned_m: Array  # (3,)
    jumps: bool
    fixed_in_time: bool


def _flown(mission: MissionKind, place: Place) -> _Flown:
    return _Flown(
        sampled=mission.reference(place),
        heading=mission.heading(place),
        offset_ned_m=mission.offset_ned_m(place),
        jumps=mission.jumps,
        fixed_in_time=mission.fixed_in_time,
    )


def _tabulated(mission: MissionKind, place: Place, params: MissionParams) -> _Flown:
    """Return what an own mission asks of an agent, read off a table that is made now.

    What is checked before a flight is thereby what is flown, and code of somebody else never makes a reference in a
    tick.

    Raises:
        OwnError: it raises, or returns something else than positions and velocities.
    """
    t_s = np.linspace(0.0, params.duration_s, min(_MAX_ROWS, max(3, round(params.duration_s / _ROW_S) + 1)))
    try:
        asked = _flown(mission, place)
        pos, vel = (np.asarray(values, dtype=np.float64) for values in asked.sampled(t_s.copy()))
        offset = np.asarray(asked.offset_ned_m, dtype=np.float64)
        yaw = np.zeros(len(t_s)) if asked.heading is None else np.asarray(asked.heading(t_s.copy()), dtype=np.float64)
    except (Exception, SystemExit) as error:  # whatever it does
        raise OwnError(f"{params.kind} raised {in_words(error)}") from error
    for name, values, wanted in (
        ("positions", pos, (len(t_s), 3)),
        ("velocities", vel, (len(t_s), 3)),
        ("yaws", yaw, t_s.shape),
        ("an offset", offset, (3,)),
    ):
        if values.shape != wanted:
            times = f" for {len(t_s)} times" if len(t_s) in wanted else ""
            raise OwnError(f"{params.kind} returned {name} of shape {values.shape}{times}, not {wanted}")
    unwrapped = np.unwrap(yaw)
    turning = None if asked.heading is None else lambda at_s: np.interp(at_s, t_s, unwrapped)
    sampled = through(t_s, pos, vel, None).sample
    return replace(
        asked,
        sampled=sampled,
        heading=turning,
        offset_ned_m=offset,
        jumps=bool(asked.jumps),
        fixed_in_time=bool(asked.fixed_in_time),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Holds a reference at K times."""

    pos_ned_m: Array  # (K, 3)
    vel_ned_m_s: Array  # (K, 3)
    accel_ned_m_s2: Array  # (K, 3)
    yaw_rad: Array  # (K,) clockwise from north


class MissionReference:
    """Computes the reference of one agent.

    Args:
        params: the mission.
        starts_ned_m: (agents, 3) start positions.
        agent: own index.
        apart_m: distance that agents keep, for goals that several share.

    Attributes:
        offset_ned_m: own place (3,) around a reference that several share; the error of tracking is that to the latter.
        jumps: positions are steps, which no vehicle follows.
        fixed_in_time: every agent is meant to be where its reference is.
        goal: where the agent is meant to arrive; None of a mission that is flown for its way, or somebody else's.
        ends_s: mission time from which it rests; None of a mission that never does, or somebody else's.
    """

    def __init__(self, params: MissionParams, starts_ned_m: Array, agent: int, apart_m: float = 0.0) -> None:
        self._mission, self._start_ned_m, self._yaw_rad = params.flown(), starts_ned_m[agent], params.yaw_rad
        self._own_name = params.kind if params.is_own else ""
        place = Place(starts_ned_m=starts_ned_m, agent=agent, apart_m=apart_m)
        self.goal = None if params.is_own else self._mission.goal(place)
        self.ends_s = None if params.is_own else self._mission.ends_s(place)
        asked = _tabulated(self._mission, place, params) if params.is_own else _flown(self._mission, place)
        self._sampled, self._heading, self.offset_ned_m = asked.sampled, asked.heading, asked.offset_ned_m
        self.jumps, self.fixed_in_time = asked.jumps, asked.fixed_in_time

    def sample(self, t_s: Array) -> tuple[Array, Array]:
        """Return positions and velocities, (K, 3) NED each, at mission times `t_s` (K,); at rest before 0."""
        pos, vel = self._sampled(np.maximum(t_s, 0.0))
        if t_s.min() < 0.0:
            vel[t_s < 0.0] = 0.0
        return pos + self.offset_ned_m, vel

    def yaw_rad(self, t_s: Array) -> Array:
        """Return yaws (K,) at mission times `t_s` (K,)."""
        if self._heading is None:
            return np.full(len(t_s), self._yaw_rad)
        return self._heading(np.maximum(t_s, 0.0))

    def yaw_at_rad(self, t_s: float) -> float:
        """Return the yaw at one mission time."""
        return self._yaw_rad if self._heading is None else float(self.yaw_rad(np.array([t_s]))[0])

    def motion(self, t_s: Array) -> Motion:
        """Return the whole reference at mission times `t_s` (K,) >= 0; acceleration is the difference of velocities."""
        pos, vel = self.sample(t_s)
        before_s, after_s = np.maximum(t_s - _DIFFERENCE_S, 0.0), t_s + _DIFFERENCE_S
        accel = (self.sample(after_s)[1] - self.sample(before_s)[1]) / (after_s - before_s)[:, None]
        return Motion(pos_ned_m=pos, vel_ned_m_s=vel, accel_ned_m_s2=accel, yaw_rad=self.yaw_rad(t_s))

    def excess(self, pos_ned_m: Array, vel_ned_m_s: Array) -> str:
        """Say why the flight must end at this position and velocity (3,) NED, or ""."""
        if not self._own_name:
            return self._mission.excess(self._start_ned_m, pos_ned_m, vel_ned_m_s)
        try:
            told = self._mission.excess(self._start_ned_m.copy(), pos_ned_m.copy(), vel_ned_m_s.copy())
            return printable(str(told), _MAX_SHOWN) if told else ""
        except (Exception, SystemExit) as error:  # whatever it does: the vehicle is landed
            return printable(f"mission {self._own_name} raised {in_words(error)}", _MAX_SHOWN)
