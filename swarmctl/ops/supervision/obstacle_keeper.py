"""The swarm's list of obstacles as a launch keeps it: repeated to all, and replaced by those of operators."""

from __future__ import annotations

import time
from collections.abc import Sequence

import msgspec

from swarmctl.bus.bus import Bus
from swarmctl.bus.messages.json_messages import ObstaclesMessage, decode_obstacles, encode_message, first_list
from swarmctl.bus.topics import OBSTACLES
from swarmctl.core.obstacle import Obstacle
from swarmctl.wall_clock import utc_us

_REPEAT_S = 1.0


class ObstacleKeeper:
    """Keeps the newest list of obstacles.

    Args:
        bus: brings the lists of operators, and carries the repetitions.
        configured: obstacles from the beginning.

    Attributes:
        newest: the list.
    """

    def __init__(self, bus: Bus, configured: Sequence[Obstacle]) -> None:
        self._bus = bus
        self.newest = first_list(configured, utc_us())
        self._said_s = 0.0

    def receive(self) -> list[ObstaclesMessage]:
        """Adopt the lists that have arrived: each is repeated from now on; returns those that were adopted."""
        adopted = []
        for _, payload in self._bus.receive(OBSTACLES):
            message = decode_obstacles(payload)
            if message is not None and message.replaces(self.newest.version):
                self.newest, self._said_s = message, 0.0
                adopted.append(message)
        return adopted

    def repeat(self) -> None:
        """Publish the list again if it is time."""
        now_s = time.monotonic()
        if now_s - self._said_s >= _REPEAT_S:
            self._said_s = now_s
            told = msgspec.structs.replace(self.newest, utc_us=utc_us())
            self._bus.publish(OBSTACLES, encode_message(told))
