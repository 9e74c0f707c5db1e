"""Whether an agent is silent, or this computer does not hear it.

An agent whose process runs and whose status does not come may be frozen. Or the session of the bus is deaf, of which
nothing else tells: it sends, and is kept alive. So another session is opened before an agent is called silent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from swarmctl.bus.bus import Bus, agent_name

_DOUBT_01 = 0.6  # of the limit of silence, after which another session is opened
_ANEW_S = 1.0  # for which another session listens before an agent is called silent: five statuses
_OPENING_S = 5.0  # longest that is waited for another session, which takes milliseconds where the router runs


@dataclass(slots=True, kw_only=True)
class _Doubt:
    reopened: int  # sessions replaced before
    anew_s: float | None = None  # silence of the agent when another session took over


class Hearing:
    """Doubts the own session before it calls agents silent.

    Args:
        bus: by which agents are heard.
        announce: is told an event and its text.
    """

    def __init__(self, bus: Bus, announce: Callable[[str, str], None]) -> None:
        self._bus, self._announce = bus, announce
        self._doubts: dict[int, _Doubt] = {}  # by agent

    def hear(self, agent: int) -> None:
        """Note that an agent was heard."""
        doubt = self._doubts.pop(agent, None)
        if doubt is not None and self._bus.reopened() > doubt.reopened:
            text = f"{agent_name(agent)} is heard on another session of the bus: the one before was deaf"
            self._announce("bus_was_deaf", text)

    def is_silent(self, agent: int, silent_s: float, limit_s: float) -> bool:
        """Return whether an agent that was not heard for so long is silent, by this session and another one."""
        if silent_s <= _DOUBT_01 * limit_s:
            return False
        doubt = self._doubts.get(agent)
        if doubt is None:
            doubt = self._doubts[agent] = _Doubt(reopened=self._bus.reopened())
            if self._bus.reopen():
                text = f"{agent_name(agent)} is not heard, and its process runs: another session of the bus is opened"
                self._announce("bus_doubted", text)
        if doubt.anew_s is None and self._bus.reopened() > doubt.reopened:
            doubt.anew_s = silent_s
        if doubt.anew_s is not None:
            return silent_s > max(limit_s, doubt.anew_s + _ANEW_S)
        return silent_s > limit_s + _OPENING_S or (silent_s > limit_s and not self._bus.reopen())
