"""Pauses of a process that watches agents: what arrived in them is passed on later, so that nobody was silent."""

from __future__ import annotations

from collections.abc import Iterable

from swarmctl.ops.supervision.status_table import AgentView

_PAUSE_S = 0.5  # ten of its steps


class OwnPause:
    """Notices by the time between two steps that this process did not run.

    Args:
        now_s: monotonic time [s].
    """

    def __init__(self, now_s: float) -> None:
        self._stepped_s = now_s

    def excuse(self, now_s: float, views: Iterable[AgentView]) -> None:
        """Count no time since the last step, if that was a pause, as silence of an agent."""
        paused_s, self._stepped_s = now_s - self._stepped_s, now_s
        if paused_s > _PAUSE_S:
            for view in views:
                if view.received_s:  # else no arrival is noted, by which silence would be counted
                    view.received_s += paused_s
