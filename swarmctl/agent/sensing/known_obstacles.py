"""Obstacles as an agent knows them: the operator's newest list, and which of them have been in sight."""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.bus.messages.json_messages import ListedObstacle, ObstaclesMessage, decode_obstacles
from swarmctl.bus.refusals import MALFORMED, SEQUENCE
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array


class KnownObstacles:
    """Keeps the newest list of obstacles that was received; those that have been visible stay known.

    Args:
        note: receives the event `obstacles_changed` with the list as it was received.
    """

    def __init__(self, note: Callable[..., None]) -> None:
        self._note = note
        self._newest: ObstaclesMessage | None = None
        self._seen: dict[int, Obstacle] = {}  # those that have been visible, by number

    @property
    def listed(self) -> tuple[ListedObstacle, ...]:
        """Return the newest list."""
        return () if self._newest is None else self._newest.obstacles

    def take(self, payload: bytes) -> str:
        """Take in a list that was received; returns why it is refused, or ""."""
        message, known = decode_obstacles(payload), self._newest
        if message is None:
            return MALFORMED
        if message.proposed:
            return ""  # whoever keeps the list on this computer repeats it when it is adopted
        if known is None or message.replaces(known) or message.corrects(known):
            if message.obstacles != self.listed:
                self._note("obstacles_changed", version=message.version, listed=payload.decode(errors="replace"))
            before, now = ({item.without_time for item in listed} for listed in (self.listed, message.obstacles))
            self._seen = {number: obstacle for number, obstacle in before & now if number in self._seen}
            self._newest = message
            return ""
        return SEQUENCE if message.is_too_far_from(known) else ""

    @property
    def resting(self) -> dict[int, Obstacle]:
        """Return the obstacles of the newest list that do not move, seen or not, by number."""
        return {item.number: item.obstacle for item in self.listed if not item.obstacle.moves}

    def visible(self, pos_ned_m: Array, utc_us: int) -> dict[int, Obstacle]:
        """Return the obstacles that are visible from a position (3,), as they are at a time, by number."""
        there = {item.number: item.at(utc_us) for item in self.listed}
        return {number: o for number, o in there.items() if o.distance_m(pos_ned_m) < o.visibility_m}

    def see(self, pos_ned_m: Array, utc_us: int) -> dict[int, Obstacle]:
        """Return the obstacles that are `visible`, and remember them."""
        seen = self.visible(pos_ned_m, utc_us)
        self._seen.update(seen)
        return seen

    def landmarks(self) -> list[Obstacle]:
        """Return obstacles at rest that have been visible so far."""
        return [o for o in self._seen.values() if not o.moves]

    def moving(self, utc_us: int) -> list[Obstacle]:
        """Return the obstacles of the newest list that move, seen or not, as they are at a time."""
        return [item.at(utc_us) for item in self.listed if item.obstacle.moves]

    def at_rest(self, pos_ned_m: Array) -> list[Obstacle]:
        """Return obstacles at rest that have been visible so far, or will be on the way straight down from (3,).

        The autopilot that lands a vehicle avoids none: what came into sight below it would be seen too late.
        """
        return [
            item.obstacle
            for item in self.listed
            if not item.obstacle.moves
            and (item.number in self._seen or item.obstacle.descent_distance_m(pos_ned_m) < item.obstacle.visibility_m)
        ]
