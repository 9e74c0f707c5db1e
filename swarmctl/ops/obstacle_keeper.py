"""The swarm's list of obstacles as a launch keeps it: repeated to all, changed by operators, judged by the referee."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import msgspec

from swarmctl.bus.json_messages import ObstaclesMessage, decode_obstacles, encode_message, first_list
from swarmctl.bus.peers import Bus
from swarmctl.bus.topics import OBSTACLES
from swarmctl.core.obstacle import Obstacle
from swarmctl.telemetry.evaluation.referee import JudgedObstacle

_REPEAT_S = 1.0


class ObstacleKeeper:
    """Keeps the newest list of obstacles, and when each obstacle of all lists was there.

    Args:
        bus: brings the lists of operators, and carries the repetitions.
        configured: obstacles from the beginning.
    """

    def __init__(self, bus: Bus, configured: Sequence[Obstacle]) -> None:
        self._bus = bus
        self._newest = first_list(configured, time.time_ns() // 1000)
        self._said_s = 0.0
        self.judged = _judged((), self._newest, 0)

    def receive(self) -> list[ObstaclesMessage]:
        """Adopt the lists that have arrived: each is repeated from now on; returns those that were adopted."""
        adopted = []
        for _, payload in self._bus.receive(OBSTACLES):
            message = decode_obstacles(payload)
            if message is not None and message.replaces(self._newest.version):
                self.judged = _judged(self.judged, message, time.time_ns() // 1000)
                self._newest, self._said_s = message, 0.0
                adopted.append(message)
        return adopted

    def repeat(self) -> None:
        """Publish the list again if it is time."""
        now_s = time.monotonic()
        if now_s - self._said_s >= _REPEAT_S:
            self._said_s = now_s
            told = msgspec.structs.replace(self._newest, utc_us=time.time_ns() // 1000)
            self._bus.publish(OBSTACLES, encode_message(told))


def _judged(known: tuple[JudgedObstacle, ...], message: ObstaclesMessage, utc_us: int) -> tuple[JudgedObstacle, ...]:
    """Return all obstacles there were: those known that a list lacks are there until now, those it adds are new."""
    listed = [
        JudgedObstacle(number=item.number, obstacle=item.obstacle, since_utc_us=item.since_utc_us)
        for item in message.obstacles
    ]
    there = set(listed)
    kept = [j if j in there or j.until_utc_us is not None else replace(j, until_utc_us=utc_us) for j in known]
    return (*kept, *(judged for judged in listed if judged not in kept))
