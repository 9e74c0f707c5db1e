"""When a participant of the bus takes its own session for deaf, and when another has taken over. Time is an argument.

Silence is no evidence against those who are silent: the session may have lost its ear. Where many speak several times a
second, a session on which nobody at all is heard for seconds is replaced by another one, which costs milliseconds. If
that one is as silent, silence is what it seems.
"""

from __future__ import annotations

from collections.abc import Callable

from swarmctl.bus.bus import Bus

REOPENED = "bus_reopened"  # event of agents, supervisors and stations
DEAF_S = 3.0  # supervisors repeat the obstacles each second, agents publish five statuses and fifty paths
_LONGEST_S = 48.0  # between two attempts while silence goes on
_MOST_STEP_S = 0.5  # counted of the time between two looks: a process that did not run has heard nothing


class SilenceWatch:
    """Measures silence in the time in which this process ran.

    Args:
        deaf_s: silence after which the session counts as deaf; twice as long after each replacement in vain.
    """

    def __init__(self, deaf_s: float = DEAF_S) -> None:
        self._deaf_s = self._limit_s = deaf_s
        self._silent_s = 0.0
        self._looked_s: float | None = None
        self._has_heard = False  # who has never heard anybody may be alone

    def hear(self) -> None:
        """Note that something has arrived."""
        self._silent_s, self._limit_s, self._has_heard = 0.0, self._deaf_s, True

    def is_deaf(self, now_s: float) -> bool:
        """Look at the clock; returns true once for each limit of silence that has passed."""
        if self._looked_s is not None:
            self._silent_s += min(now_s - self._looked_s, _MOST_STEP_S)
        self._looked_s = now_s
        if not self._has_heard or self._silent_s < self._limit_s:
            return False
        self._silent_s, self._limit_s = 0.0, min(2.0 * self._limit_s, _LONGEST_S)
        return True


class SessionWatch:
    """Records when another session has taken the place of a deaf one.

    Args:
        bus: whose sessions.
        note: takes the name and fields of an event.
    """

    def __init__(self, bus: Bus, note: Callable[..., None]) -> None:
        self._bus, self._note = bus, note
        self._reopened = self._excused = 0

    def step(self) -> bool:
        """Record what is new; return whether anything is."""
        reopened = self._bus.reopened() - self._excused
        if reopened <= self._reopened:
            return False
        self._reopened = reopened
        self._note(REOPENED, count=reopened)
        return True

    def excuse(self) -> None:
        """Leave out what is new: nobody was there to be heard."""
        self._excused = self._bus.reopened() - self._reopened
