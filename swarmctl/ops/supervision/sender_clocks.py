"""Notes how far the clocks of senders are behind the station's, by when their ticks arrive."""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.telemetry.evaluation.station_clock import SENDER_CLOCK

_NOTED_US = 1000  # an arrival is noted that is sooner by so much; the rest at the end


class SenderClocks:
    """Keeps the least difference of arrival and stamp of each agent, and notes it, so that a killed station leaves it.

    Args:
        note: writes the events `sender_clock`.
    """

    def __init__(self, note: Callable[..., None]) -> None:
        self._note = note
        self._least_us: dict[int, int] = {}
        self._noted_us: dict[int, int] = {}

    def received(self, agent: int, t_us: int, arrival_us: int) -> None:
        """Take in a tick.

        Args:
            agent: who has sent it.
            t_us: its time, by the monotonic clock of its computer.
            arrival_us: monotonic time here at which it was there at the latest.
        """
        behind_us = arrival_us - t_us
        least_us = self._least_us.setdefault(agent, behind_us)
        self._least_us[agent] = min(least_us, behind_us)
        if agent not in self._noted_us or behind_us <= self._noted_us[agent] - _NOTED_US:
            self._tell(agent)

    def close(self) -> None:
        """Note what has not been noted."""
        for agent, least_us in self._least_us.items():
            if least_us < self._noted_us[agent]:
                self._tell(agent)

    def _tell(self, agent: int) -> None:
        self._noted_us[agent] = self._least_us[agent]
        self._note(SENDER_CLOCK, agent=agent, behind_us=self._least_us[agent])
