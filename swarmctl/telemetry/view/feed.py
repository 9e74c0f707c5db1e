"""The viewer's subscriber: tick records of every agent and the operator's obstacles, received over the bus.

The bus drops the oldest samples when the viewer is slow, so neither the bus nor an agent waits for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import ObstaclesMessage, decode_obstacles
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import unpack_tick
from swarmctl.core.types import Array
from swarmctl.wall_clock import utc_us

_AS_LATE_US = 100_000  # what is late by less may be by the way, or have waited for the viewer
_SANE_US = 1 << 52  # times farther from 1970, in 2112, are no clock's; the timeline has nanoseconds
_STRANGE_US = 10_000_000  # later or sooner by so much than the ticks before: junk, or a clock was set
_BELIEVED = 3  # ticks in a row that are strange in this way are no junk
_SET_US = 1_000_000  # UTC and monotonic time differ by so much more or less: the clock was set, or is another one


class Batch(NamedTuple):
    """New tick records of one agent."""

    agent: int
    t_us: NDArray[np.int64]  # (T,) since the first sample of the swarm, increasing
    rows: NDArray[np.void]  # (T,) TICK_DTYPE
    plan_ned_m: Array  # (M, 3) of the newest row, empty when it had none
    ahead_us: int  # how far the UTC of its computer is ahead of ours, by its arrivals; 0 where that may be their delay
    is_anew: bool = False  # its times do not follow those of the batch before: its clock was set, or is another one


class Feed:
    """Collects the messages of a run.

    Args:
        bus: connection that receives the topics of `listens_to(agents)`.
        agents: size of the swarm.
        utc_us: clock of this computer.

    Attributes:
        received: tick records received so far.
        malformed: messages so far that could not be decoded, or with times of no clock.
    """

    def __init__(self, bus: Bus, agents: int, utc_us: Callable[[], int] = utc_us) -> None:
        self._bus, self._utc_us = bus, utc_us
        self._numbers = {agent_name(agent): agent for agent in range(agents)}
        self._listed: ObstaclesMessage | None = None
        self._clocks = [AgentClock() for _ in range(agents)]
        self._epoch_us: int | None = None
        self.received = 0
        self.malformed = 0

    @property
    def lost(self) -> int:
        """Number of ticks that agents published but this process did not receive."""
        return sum(clock.lost for clock in self._clocks)

    def take(self) -> list[Batch]:
        """Return the ticks that have arrived since the last call, one batch for each agent."""
        arrived: dict[int, list[tuple[NDArray[np.void], Array]]] = {}
        for sender, payload in self._bus.receive(topics.TICK):
            tick = unpack_tick(payload)
            if tick is None or not _is_sane(tick[0]):
                self.malformed += 1
            else:
                self.received += 1
                arrived.setdefault(self._numbers[sender], []).append(tick)
        if self._epoch_us is None and arrived:
            self._epoch_us = min(int(samples[0][0]["utc_us"][0]) for samples in arrived.values())
        return [batch for agent, samples in arrived.items() for batch in self._batch(agent, samples)]

    def take_obstacles(self) -> tuple[Obstacle, ...] | None:
        """Return the operator's newest list of obstacles, as they are now; None when there is no newer one."""
        newest: tuple[Obstacle, ...] | None = None
        for _, payload in self._bus.receive(topics.OBSTACLES):
            message = decode_obstacles(payload)
            if message is None:
                self.malformed += 1
            elif not message.proposed and message.replaces(self._listed):
                self._listed = message
                newest = tuple(item.at(message.utc_us) for item in message.obstacles)
        return newest

    def _batch(self, agent: int, samples: list[tuple[NDArray[np.void], Array]]) -> list[Batch]:
        rows = np.concatenate([row for row, _ in samples])
        clock = self._clocks[agent]
        strange, t_us, kept = clock.strange, *clock.place(rows, self._epoch_us or 0, self._utc_us())
        self.malformed += clock.strange - strange
        if not kept.any():
            return []
        return [Batch(agent, t_us[kept], rows[kept], samples[-1][1], clock.ahead_us, clock.is_anew)]


def listens_to(agents: int, launchers: Sequence[str] = (topics.OPERATOR,)) -> dict[topics.Topic, Sequence[str]]:
    """Return the topics and senders that a viewer of `agents` agents subscribes to.

    Args:
        agents: number of agents.
        launchers: names of those who repeat the list of obstacles.
    """
    return {topics.TICK: [agent_name(agent) for agent in range(agents)], topics.OBSTACLES: launchers}


def _is_sane(rows: NDArray[np.void]) -> bool:
    """Return whether the times of a tick are those of a clock."""
    return all(-_SANE_US < int(rows[name][0]) < _SANE_US for name in ("t_us", "utc_us"))


class AgentClock:
    """Maps one agent's ticks to the shared timeline by its monotonic clock, aligned with UTC once.

    Agents may run on several hosts, so only UTC is comparable; within an agent the monotonic clock has no steps.

    Attributes:
        lost: ticks that were published and not received.
        strange: ticks that were left out, as their times do not fit those before by when they arrived.
        is_anew: whether the times placed last do not follow those before.
    """

    def __init__(self) -> None:
        self.lost = self.strange = 0
        self.is_anew = False
        self._in_a_row = 0  # strange ones
        self._offset_us: int | None = None
        self._least_us: int | None = None  # of arrival and stamp
        self._last_us = -(1 << 62)
        self._last_seq = -1

    @property
    def ahead_us(self) -> int:
        """How far these stamps are ahead of our UTC, at least; 0 for as little as messages may be late."""
        behind_us = self._least_us or 0
        return -behind_us if abs(behind_us) > _AS_LATE_US else 0

    def place(
        self, rows: NDArray[np.void], epoch_us: int, arrival_us: int
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the time (T,) of each row since `epoch_us` and a mask (T,) of rows newer than all before.

        Args:
            rows: (T,), of times that are sane.
            epoch_us: UTC.
            arrival_us: our UTC by which they were there.
        """
        t_us = np.zeros(len(rows), np.int64)
        newer = np.zeros(len(rows), bool)
        self.is_anew = False
        for k, row in enumerate(rows):
            placed_us = self._placed_us(row, arrival_us)
            if placed_us is not None:
                t_us[k] = placed_us - epoch_us
                newer[k] = placed_us > self._last_us
                self._last_us = max(self._last_us, placed_us)
        return t_us, newer

    def _placed_us(self, row: np.void, arrival_us: int) -> int | None:
        """Return the UTC of a row by the agent's clock; None where it is strange."""
        seq, offset_us = int(row["seq"]), int(row["utc_us"]) - int(row["t_us"])
        if self._offset_us is None or seq < self._last_seq:  # first sample, or the agent was started again
            self._begin(offset_us)
        placed_us = int(row["t_us"]) + (self._offset_us or 0)
        if self._least_us is not None and abs(arrival_us - placed_us - self._least_us) > _STRANGE_US:
            self._in_a_row += 1
            if self._in_a_row < _BELIEVED:
                self.strange += 1
                return None
            self._begin(offset_us)
            placed_us = int(row["utc_us"])
        elif seq > self._last_seq + 1 > 0:
            self.lost += seq - self._last_seq - 1
        self._in_a_row, self._last_seq = 0, seq
        behind_us = arrival_us - placed_us
        self._least_us = behind_us if self._least_us is None else min(self._least_us, behind_us)
        return placed_us

    def _begin(self, offset_us: int) -> None:
        """Align the clocks anew; where that makes a difference, what was known of the ticks before is no measure."""
        if self._offset_us is not None and abs(offset_us - self._offset_us) > _SET_US:
            self._last_us, self.is_anew = -(1 << 62), True
        self._offset_us, self._least_us, self._last_seq = offset_us, None, -1
