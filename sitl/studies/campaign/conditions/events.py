"""Scenario events in the middle of a flight: agents die or stop, the bus fails or splits, an obstacle appears."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Protocol

import numpy as np

from sitl.lockstep import Lockstep
from swarmctl.bus.bus import agent_name
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array
from swarmctl.simulator_config import FaultParams

_TOLD_EVERY_S = 0.1  # of a moving obstacle: messages carry no time, so it is repeated


class ScenarioEvent(Protocol):
    """An event of one flight; it may keep state."""

    def step(self, lockstep: Lockstep, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        """Act when due; called every tick with the mission time and the true states (N, 3)."""

    def obstacles(self, t_s: float) -> Sequence[Obstacle]:
        """Return the obstacles of this event now, beside the configured obstacles."""


class Death:
    """An agent's process dies; its vehicle is left to its autopilot."""

    def __init__(self, agent: int, at_s: float) -> None:
        self._agent, self._at_s, self._done = agent, at_s, False

    def step(self, lockstep: Lockstep, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        if t_s >= self._at_s and not self._done:
            self._done = True
            lockstep.kill(self._agent)

    def obstacles(self, t_s: float) -> Sequence[Obstacle]:
        return ()


class _Episode:
    """An event that begins at `at_s` of mission time and ends after `for_s`, never if that is infinite."""

    def __init__(self, at_s: float, for_s: float) -> None:
        self._due = [(at_s, self._begin), (at_s + for_s, self._end)]

    def step(self, lockstep: Lockstep, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        if self._due and t_s >= self._due[0][0]:
            _, act = self._due.pop(0)
            act(lockstep)

    def obstacles(self, t_s: float) -> Sequence[Obstacle]:
        return ()

    def _begin(self, lockstep: Lockstep) -> None:
        raise NotImplementedError

    def _end(self, lockstep: Lockstep) -> None:
        raise NotImplementedError


class Partition(_Episode):
    """No agent receives any other one for a while."""

    def _begin(self, lockstep: Lockstep) -> None:
        lockstep.hub.fail()

    def _end(self, lockstep: Lockstep) -> None:
        lockstep.hub.recover()


class Split(_Episode):
    """Agents of different groups do not receive each other for a while; one in no group reaches everybody.

    Args:
        groups: agents of each.
        at_s, for_s: see `_Episode`.
    """

    def __init__(self, groups: Sequence[Collection[int]], at_s: float, for_s: float) -> None:
        super().__init__(at_s, for_s)
        self._groups = [frozenset(map(agent_name, agents)) for agents in groups]

    def _begin(self, lockstep: Lockstep) -> None:
        lockstep.hub.split(self._groups)

    def _end(self, lockstep: Lockstep) -> None:
        lockstep.hub.heal()


class OneWayCut(_Episode):
    """One agent no longer receives another one for a while, which still receives it."""

    def __init__(self, sender: int, receiver: int, at_s: float, for_s: float) -> None:
        super().__init__(at_s, for_s)
        self._ends = agent_name(sender), agent_name(receiver)

    def _begin(self, lockstep: Lockstep) -> None:
        lockstep.hub.cut(*self._ends)

    def _end(self, lockstep: Lockstep) -> None:
        lockstep.hub.mend(*self._ends)


class _AgentEpisode(_Episode):
    """An episode of one agent."""

    def __init__(self, agent: int, at_s: float, for_s: float) -> None:
        super().__init__(at_s, for_s)
        self._agent = agent


class Freeze(_AgentEpisode):
    """An agent's process stops for a while: its token stays, but it neither receives nor sends anything."""

    def _begin(self, lockstep: Lockstep) -> None:
        lockstep.frozen.add(self._agent)

    def _end(self, lockstep: Lockstep) -> None:
        lockstep.frozen.discard(self._agent)


class Restart(_AgentEpisode):
    """An agent's process dies, and another one is started for its vehicle after a while."""

    def _begin(self, lockstep: Lockstep) -> None:
        lockstep.kill(self._agent)

    def _end(self, lockstep: Lockstep) -> None:
        lockstep.start_again(self._agent)


class Recovery(_AgentEpisode):
    """The supervisor of an agent's host ends its process, and another one lands its vehicle."""

    def __init__(self, agent: int, at_s: float) -> None:
        super().__init__(agent, at_s, math.inf)

    def _begin(self, lockstep: Lockstep) -> None:
        lockstep.recover(self._agent)

    def _end(self, lockstep: Lockstep) -> None:
        return


class SimulatorFault(_Episode):
    """A fault of the simulator, of the kinds in `swarmctl.simulator_config.FAULTS`; its `at_s` is not used."""

    def __init__(self, fault: FaultParams, at_s: float) -> None:
        super().__init__(at_s, math.inf)
        self._fault = fault

    def _begin(self, lockstep: Lockstep) -> None:
        lockstep.world.faults.begin(self._fault, lockstep.world.since_boot_us)


class Appearance:
    """An obstacle appears in front of a vehicle and is published at once, as by `swarmctl obstacle`.

    It appears when there is room to avoid it: `ahead_m` along the victim's velocity, and no vehicle inside `clear_m`. A
    static one never blocks a goal. A moving one begins `ahead_m` to the victim's side, heads for the victim's future
    place and disappears at the end of its path.

    Args:
        victim: agent.
        at_s: earliest mission time.
        ahead_m: distance from the victim.
        clear_m: least distance from every vehicle.
        radius_m, keep_out_m: of the obstacle.
        speed_m_s: 0: static.
        side: -1 or 1, side from which a moving one comes.
        goals_ned_m: (N, 3), which stay free.
    """

    def __init__(
        self,
        victim: int,
        at_s: float,
        ahead_m: float,
        clear_m: float,
        *,
        radius_m: float,
        keep_out_m: float,
        speed_m_s: float,
        side: int,
        goals_ned_m: Array,
    ) -> None:
        self._goals_ned_m = goals_ned_m
        self._victim, self._at_s, self._ahead_m, self._clear_m = victim, at_s, ahead_m, clear_m
        self._radius_m, self._keep_out_m, self._speed_m_s, self._side = radius_m, keep_out_m, speed_m_s, side
        self._from: tuple[float, Array, Array] | None = None  # begin time, place (3,), velocity (3,)
        self._told_s = -math.inf
        self._removed = False

    def step(self, lockstep: Lockstep, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        if self._from is None and t_s >= self._at_s and not self._removed:
            self._appear(t_s, pos_ned_m, vel_ned_m_s)
        if self._from is None:
            return
        since_s = self._from[0]
        if self._speed_m_s and (t_s - since_s) * self._speed_m_s > 2.0 * self._ahead_m:
            self._from, self._removed = None, True
            lockstep.set_obstacles(())
        elif t_s - self._told_s >= (_TOLD_EVERY_S if self._speed_m_s else math.inf):
            self._told_s = t_s
            lockstep.set_obstacles(self.obstacles(t_s))

    def obstacles(self, t_s: float) -> Sequence[Obstacle]:
        if self._from is None:
            return ()
        since_s, where, vel = self._from
        center = (where + (t_s - since_s) * vel).tolist()
        appeared = Obstacle(
            center_ned_m=center,
            vel_ned_m_s=vel.tolist(),
            radius_m=self._radius_m,
            keep_out_m=self._keep_out_m,
            visibility_m=_SEEN_M,
        )
        return (appeared,)

    def _appear(self, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array) -> None:
        speed = float(np.linalg.norm(vel_ned_m_s[self._victim]))
        if speed < _FLYING_M_S:
            return
        ahead = vel_ned_m_s[self._victim] / speed
        if not self._speed_m_s:
            where, vel = pos_ned_m[self._victim] + self._ahead_m * ahead, np.zeros(3)
        else:
            meets_s = self._ahead_m / self._speed_m_s
            across = self._side * np.array([-ahead[1], ahead[0], 0.0])
            met = pos_ned_m[self._victim] + min(meets_s * speed, _MET_M) * ahead
            where, vel = met + self._ahead_m * across, -self._speed_m_s * across
        to_goals_m = np.linalg.norm(self._goals_ned_m - where, axis=1).min()
        if not self._speed_m_s and to_goals_m < self._keep_out_m + _ARRIVING_M:
            return
        if np.linalg.norm(pos_ned_m - where, axis=1).min() >= self._clear_m:
            self._from = (t_s, where, vel)


_SEEN_M = 100.0
_FLYING_M_S = 0.5
_MET_M = 3.0
_ARRIVING_M = 0.3  # added to the keep-out at a goal
