"""The viewer's ear on the bus: tick records of every agent and the operator's obstacles.

Rings drop the oldest sample when the viewer is slow, so neither the bus nor an agent ever waits for it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import zenoh
from numpy.typing import NDArray

from swarmctl.core.records import unpack_tick
from swarmctl.core.types import Array
from swarmctl.telemetry.obstacles import MovingObstacle, read_obstacles

_RING = 256  # 5 s of ticks
_CONNECT_MS = 10_000


class Batch(NamedTuple):
    """New ticks of one agent."""

    agent: int
    t_us: NDArray[np.int64]  # (T,) since the first sample of the swarm, increasing
    rows: NDArray[np.void]  # (T,) TICK_DTYPE
    plan_ned_m: Array  # (M, 3) of the newest row, empty when it had none


def open_session(endpoint: str) -> Any:
    """A client session on the launcher's router; gives up after 10 s.

    Raises:
        zenoh.ZError: no router answers there.
    """
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": _CONNECT_MS,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": 2000,
        "transport/unicast/open_timeout": 2000,
        "transport/link/rx/max_message_size": 1 << 20,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Feed:
    """Subscriptions of one run."""

    def __init__(self, session: Any, run: str, agents: int) -> None:
        def subscribe(sender: object, topic: str, ring: int) -> Any:
            return session.declare_subscriber(f"swarm/{run}/{sender}/{topic}", zenoh.handlers.RingChannel(ring))

        self._ticks = [subscribe(agent, "tick", _RING) for agent in range(agents)]
        self._obstacles = subscribe("operator", "obstacles", 1)
        self._version = -1
        self._clocks = [AgentClock() for _ in range(agents)]
        self._epoch_us: int | None = None
        self.received = 0
        self.malformed = 0

    @property
    def lost(self) -> int:
        """Ticks that agents published and this process never saw."""
        return sum(clock.lost for clock in self._clocks)

    def take(self) -> list[Batch]:
        """Everything that has arrived since the last call."""
        arrived = {}
        for agent, subscriber in enumerate(self._ticks):
            samples = self._drain(subscriber)
            if samples:
                arrived[agent] = samples
        if self._epoch_us is None and arrived:
            self._epoch_us = min(int(samples[0][0]["utc_us"][0]) for samples in arrived.values())
        return [batch for agent, samples in arrived.items() for batch in self._batch(agent, samples)]

    def take_obstacles(self) -> list[MovingObstacle] | None:
        """The operator's newest list of obstacles; None when there is no newer one."""
        sample = self._obstacles.try_recv()
        if sample is None:
            return None
        message = _json(sample.payload.to_bytes())
        obstacles = read_obstacles(message.get("obstacles"))
        version = message.get("version")
        if obstacles is None or not isinstance(version, int) or version <= self._version:
            self.malformed += obstacles is None
            return None
        self._version = version
        return obstacles

    def _drain(self, subscriber: Any) -> list[tuple[NDArray[np.void], Array]]:
        samples = []
        for _ in range(2 * _RING):
            sample = subscriber.try_recv()
            if sample is None:
                break
            tick = unpack_tick(sample.payload.to_bytes())
            if tick is None:
                self.malformed += 1
            else:
                samples.append(tick)
        self.received += len(samples)
        return samples

    def _batch(self, agent: int, samples: list[tuple[NDArray[np.void], Array]]) -> list[Batch]:
        rows = np.concatenate([row for row, _ in samples])
        t_us, kept = self._clocks[agent].place(rows, self._epoch_us or 0)
        return [Batch(agent, t_us[kept], rows[kept], samples[-1][1])] if kept.any() else []


class AgentClock:
    """Puts one agent's ticks on the shared timeline: its monotonic clock, tied to UTC once.

    Agents may run on several hosts, so only UTC compares; within an agent the monotonic clock has no steps.
    """

    def __init__(self) -> None:
        self.lost = 0
        self._offset_us: int | None = None
        self._last_us = -(1 << 62)
        self._last_seq = -1

    def place(self, rows: NDArray[np.void], epoch_us: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Time of each row since `epoch_us` (T,), and which rows are newer than all before (T,)."""
        t_us = np.zeros(len(rows), np.int64)
        newer = np.zeros(len(rows), bool)
        for k, row in enumerate(rows):
            seq = int(row["seq"])
            if self._offset_us is None or seq < self._last_seq:  # first sample, or the agent was started again
                self._offset_us = int(row["utc_us"]) - int(row["t_us"])
            elif seq > self._last_seq + 1:
                self.lost += seq - self._last_seq - 1
            self._last_seq = seq
            t_us[k] = int(row["t_us"]) + self._offset_us - epoch_us
            newer[k] = t_us[k] > self._last_us
            self._last_us = max(self._last_us, int(t_us[k]))
        return t_us, newer


def _json(payload: bytes) -> Mapping[str, Any]:
    try:
        message = json.loads(payload)
    except (json.JSONDecodeError, UnicodeDecodeError):
        return {}
    return message if isinstance(message, dict) else {}
