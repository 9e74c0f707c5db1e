"""Mission references: position, velocity, acceleration and yaw at a given mission time.

The kinds that a configuration can choose from are the modules of `kinds/`, each found by being there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from swarmctl.control.reference import kinds
from swarmctl.control.reference.kind import MISSIONS, Heading, MissionKind, Place
from swarmctl.control.reference.polynomial import through
from swarmctl.core.discovery.declared import modules_of
from swarmctl.core.discovery.own import BuiltInOrOwn, OwnError, in_words, own_class
from swarmctl.core.params import Params, with_sections
from swarmctl.core.types import Array, Sampled

GROUP = "swarmctl.missions"  # of entry points
_ROW_S, _MAX_ROWS = 0.02, 100_000  # of the table that an own mission becomes
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

    kind: MissionName = "circle"
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
        return self.flown().problems(agents)

    def references(self, starts_ned_m: Array, apart_m: float) -> list[MissionReference]:
        """Return the reference of every agent; see `MissionReference`."""
        return [MissionReference(self, starts_ned_m, agent, apart_m) for agent in range(len(starts_ned_m))]


def _tabulated(mission: MissionKind, place: Place, params: MissionParams) -> tuple[Sampled, Heading | None, Array]:
    """Return position and velocity, yaw and offset of an own mission, read off a table that is made now.

    What is checked before a flight is thereby what is flown, and code of somebody else never runs in a tick.

    Raises:
        OwnError: it raises, or returns something else than positions and velocities.
    """
    t_s = np.linspace(0.0, params.duration_s, min(_MAX_ROWS, max(3, round(params.duration_s / _ROW_S) + 1)))
    try:
        pos, vel = (np.asarray(values, dtype=np.float64) for values in mission.reference(place)(t_s.copy()))
        heading, offset = mission.heading(place), np.asarray(mission.offset_ned_m(place), dtype=np.float64)
        yaw = np.zeros(len(t_s)) if heading is None else np.asarray(heading(t_s.copy()), dtype=np.float64)
    except (Exception, SystemExit) as error:  # whatever it does
        raise OwnError(f"{params.kind} raised {in_words(error)}") from error
    if pos.shape != (len(t_s), 3) or vel.shape != pos.shape or yaw.shape != t_s.shape or offset.shape != (3,):
        shapes = f"{pos.shape} and {vel.shape}"
        raise OwnError(f"{params.kind} returned positions and velocities of shape {shapes} for {len(t_s)} times")
    turning = None if heading is None else lambda at_s: np.interp(at_s, t_s, np.unwrap(yaw))
    return through(t_s, pos, vel, None).sample, turning, offset


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
        goal: where the agent is meant to arrive; None of a mission that is flown for its way, or somebody else's.
    """

    def __init__(self, params: MissionParams, starts_ned_m: Array, agent: int, apart_m: float = 0.0) -> None:
        self._mission, self._start_ned_m, self._yaw_rad = params.flown(), starts_ned_m[agent], params.yaw_rad
        place = Place(starts_ned_m=starts_ned_m, agent=agent, apart_m=apart_m)
        self.goal = None if params.is_own else self._mission.goal(place)
        if params.is_own:
            self._sampled, self._heading, self.offset_ned_m = _tabulated(self._mission, place, params)
        else:
            self._sampled, self._heading = self._mission.reference(place), self._mission.heading(place)
            self.offset_ned_m = self._mission.offset_ned_m(place)

    @property
    def jumps(self) -> bool:
        """Return whether positions are steps, which no vehicle follows."""
        return self._mission.jumps

    @property
    def fixed_in_time(self) -> bool:
        """Return whether every agent is meant to be where its reference is."""
        return self._mission.fixed_in_time

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
        return self._mission.excess(self._start_ned_m, pos_ned_m, vel_ned_m_s)
