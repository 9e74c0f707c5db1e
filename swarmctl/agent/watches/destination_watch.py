"""Tells when an obstacle has come to where an agent is to come to rest: it keeps clear of that, and never arrives."""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.agent.sensing.known_obstacles import KnownObstacles
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.core.obstacle import taken_by


class DestinationWatch:
    """Reports obstacles at rest that take the destination of an agent; one that moves goes by.

    Orders and missions that lead into one are refused. This is about what comes later.

    Args:
        mission: knows the destination.
        obstacles: of the operator's newest list.
        alerts: are told while it is taken.
        note: receives the event `destination_taken`, with `begins=True, by=...` and at its end with `begins=False`.
    """

    def __init__(
        self, mission: MissionState, obstacles: KnownObstacles, alerts: Alerts, note: Callable[..., None]
    ) -> None:
        self._mission, self._obstacles, self._alerts, self._note = mission, obstacles, alerts, note
        self._is_taken = False

    def update(self, now_us: int) -> None:
        """Take in the obstacles of a tick."""
        place_ned_m = self._mission.destination_ned_m
        taken = "" if place_ned_m is None else taken_by(place_ned_m, self._obstacles.resting)
        if taken and not self._is_taken:
            self._note("destination_taken", begins=True, by=taken)
        elif self._is_taken and not taken:
            self._note("destination_taken", begins=False)
            self._alerts.clear("destination")
        if taken:
            self._alerts.put("destination", f"it is to rest in {taken}, and stays outside", now_us)
        self._is_taken = bool(taken)
