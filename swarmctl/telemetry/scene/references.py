"""References and goals in the scene: each agent its own, one for all agents that share it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmctl.core.types import Array, Phase
from swarmctl.telemetry.palette import NUMBER_RGB, REFERENCE_RGB, agent_rgb
from swarmctl.telemetry.scene.stream import Stream, Times, pieces
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight

_SAME_M = 0.2  # references that differ by less at the same mission time are drawn as one
_RECENT_S = 1.5  # a reference that is older than another by more is not compared with it
_AGAIN_S = 0.5  # mission time that falls by more begins again
_AT_REST_M_S = 0.01
_EVERY = 5  # ticks from one drawn reference to the next


class _Newest(NamedTuple):
    """Newest reference of an agent that tracks one."""

    mission_t_s: float
    pos_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)

    def at(self, mission_t_s: float) -> Array:
        """Return the position (3,) at another mission time near this one."""
        return self.pos_ned_m + self.vel_ned_m_s * (mission_t_s - self.mission_t_s)


class References:
    """Draws references while they are tracked, and the places where they come to rest."""

    def __init__(self, stream: Stream, flight: ViewedFlight) -> None:
        self._stream, self._flight = stream, flight
        self._newest: dict[int, _Newest] = {}
        self._shares: dict[int, int] = {}  # lowest agent with the same reference, by agent
        self._drawn: set[int] = set()
        bounds = enumerate(flight.agents)
        self._goals = {agent: np.array(own.goal_ned_m) for agent, own in bounds if own.goal_ned_m is not None}
        self._goals_drawn: set[int] = set()  # by the lowest agent of each
        self._changed: set[int] = set()  # agents whose mission an operator has changed

    def begin(self) -> None:
        """Send styles and goals."""
        for agent in range(len(self._flight.agents)):
            self._stream.static(f"world/reference/{agent}", rr.Points3D.from_fields(radii=[0.07]))
            trail = rr.LineStrips3D.from_fields(colors=[(*REFERENCE_RGB, 110)], radii=[0.012])
            self._stream.static(f"world/reference_trail/{agent}", trail)
        self._draw_goals()

    def take(self, agent: int, t_us: Times, rows: NDArray[np.void]) -> None:
        """Draw the references in rows (T,) of one agent at times `t_us` (T,), while it tracks them."""
        tracking = rows["phase"] == Phase.TRACK
        shown = False
        if tracking.any():
            before = self._newest.get(agent)
            self._newest[agent] = _newest(rows[tracking], before)
            self._note_goal(agent, before)
            shown = not self._note_sharing(agent)
        if shown:
            self._draw(agent, t_us[tracking], rows["ref_pos_ned_m"][tracking], before)
            self._drawn.add(agent)
        if agent in self._drawn and not (shown and tracking[-1]):
            self._drawn.discard(agent)
            self._stream.now(f"world/reference/{agent}", int(t_us[-1]), rr.Points3D.from_fields(positions=[]))

    def _draw(self, agent: int, t_us: Times, pos_ned_m: Array, before: _Newest | None) -> None:
        every = np.arange(len(t_us) - 1, -1, -_EVERY)[::-1]
        rgb = REFERENCE_RGB if agent in self._shares.values() else agent_rgb(agent)
        columns = rr.Points3D.columns(positions=pos_ned_m[every], colors=[rgb] * len(every))
        self._stream.columns(f"world/reference/{agent}", t_us[every], columns)
        ends, lines = pieces(pos_ned_m, None if before is None else before.pos_ned_m, _EVERY)
        self._stream.strips(f"world/reference_trail/{agent}", t_us[ends], lines)

    def _note_goal(self, agent: int, before: _Newest | None) -> None:
        """Replace the goal of an agent whose mission begins again, which is then another: where its reference rests."""
        own = self._newest[agent]
        if before is not None and own.mission_t_s < before.mission_t_s - _AGAIN_S:
            self._changed.add(agent)
        if agent not in self._changed:
            return
        rests = float(np.linalg.norm(own.vel_ned_m_s)) < _AT_REST_M_S
        known = self._goals.get(agent)
        if not rests and known is not None:
            del self._goals[agent]
            self._draw_goals()
        elif rests and (known is None or float(np.linalg.norm(known - own.pos_ned_m)) > _SAME_M):
            self._goals[agent] = own.pos_ned_m
            self._draw_goals()

    def _draw_goals(self) -> None:
        """Send all goals, for the whole time."""
        shared = sharing(self._goals)
        for first in self._goals_drawn - shared.keys():
            for path in (f"world/goal/{first}", f"world/goal/{first}/name"):
                self._stream.static(path, rr.Points3D.from_fields(positions=[]))
        for first, agents in shared.items():
            place = self._goals[first]
            label = "goal" if len(agents) == len(self._flight.agents) else f"goal {', '.join(map(str, agents))}"
            self._stream.static(f"world/goal/{first}", rr.Points3D([place], colors=[agent_rgb(first)], radii=[0.1]))
            name = rr.Points3D([place], colors=[NUMBER_RGB], radii=[0.001], labels=[label], show_labels=True)
            self._stream.static(f"world/goal/{first}/name", name)
        self._goals_drawn = set(shared)

    def _note_sharing(self, agent: int) -> bool:
        """Return whether an agent of a lower number has the same reference now, which is then noted."""
        own = self._newest[agent]
        apart_m = {
            other: float(np.linalg.norm(newest.at(own.mission_t_s) - own.pos_ned_m))
            for other, newest in self._newest.items()
            if other < agent and abs(newest.mission_t_s - own.mission_t_s) < _RECENT_S
        }
        self._shares.pop(agent, None)
        same = [other for other, distance_m in apart_m.items() if distance_m < _SAME_M]
        if same:
            self._shares[agent] = min(same)
        return bool(same)


def _newest(rows: NDArray[np.void], before: _Newest | None) -> _Newest:
    """Return the last reference of rows (T,), with the velocity since the first of them or since the one before."""
    last = rows[-1]
    if len(rows) > 1 or before is None:
        from_s, from_ned_m = float(rows["mission_t_s"][0]), rows["ref_pos_ned_m"][0]
    else:
        from_s, from_ned_m = before.mission_t_s, before.pos_ned_m
    elapsed_s = float(last["mission_t_s"]) - from_s
    moved_ned_m = np.array(last["ref_pos_ned_m"]) - from_ned_m
    return _Newest(float(last["mission_t_s"]), np.array(last["ref_pos_ned_m"]), moved_ned_m / max(elapsed_s, 1e-3))


def sharing(places_ned_m: Mapping[int, Array]) -> Mapping[int, Sequence[int]]:
    """Return the agents at each place, by the lowest number among them."""
    found: dict[int, list[int]] = {}
    for agent, place in sorted(places_ned_m.items()):
        same = (k for k in found if float(np.linalg.norm(places_ned_m[k] - place)) < _SAME_M)
        found.setdefault(next(same, agent), []).append(agent)
    return found
