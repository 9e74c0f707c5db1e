"""Several agents in one process, whose ticks take turns: for simulated swarms that outnumber the processors.

An interpreter that ticks one agent after another finds its code in the caches of the processor, which one that sleeps
between the ticks of a single agent does not. Each agent keeps its own link, recorder and deadlines; what they share is
the thread that ticks them, the session of the bus, by which what comes from other processes comes once for all of them,
and the process that they end with if it is killed.
"""

from __future__ import annotations

import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from swarmctl.agent.agent_end import AgentEnd, write_end
from swarmctl.agent.flight_priority import FlightPriority
from swarmctl.agent.runner import (
    AgentProcess,
    Ending,
    RealTimeAgent,
    flying_agent,
    keep_from_collections,
)
from swarmctl.bus.bus import agent_name
from swarmctl.bus.zenoh.session import SharedSession
from swarmctl.config import load
from swarmctl.core.text import printable_lines
from swarmctl.errors import ConfigError, SwarmError
from swarmctl.process_lifetime import StopRequest
from swarmctl.wall_clock import WallClock

_EXIT_UNEXPECTED = 1  # of an interpreter that ends with an exception
_Step = Callable[[], Ending | None]


def run_agents(processes: Sequence[AgentProcess], ends_fd: int | None = None) -> int:
    """Run agents until each has ended; returns the largest exit code. A signal lands all of them.

    An agent that fails ends alone: its own failure is told, and the others fly on.

    Args:
        processes: one for each agent; the first one says whether to ask for real-time priority.
        ends_fd: pipe that is told each end.

    Raises:
        ConfigError: the configuration is not valid, or of real vehicles.
    """
    agents = [process.agent for process in processes]
    if not load(processes[0].config_path, only_agents=agents).sitl.enabled:
        raise ConfigError(
            "--id", [f"{', '.join(map(str, agents))}: agents of real vehicles have processes of their own"]
        )
    stop = StopRequest(signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    clock = WallClock()
    turns = Turns(clock, (lambda end: None) if ends_fd is None else partial(write_end, ends_fd))
    for process in processes:
        turns.open(process, stop)
    turns.begin(realtime=processes[0].realtime)
    while turns.step():
        pass
    return turns.wait_for_ends()


class Turns:
    """Ticks each agent at its own deadlines, the one that has waited longest first.

    Args:
        clock: time of this host.
        tell: is told each end, from another thread, when everything of the agent is closed.
    """

    def __init__(self, clock: WallClock, tell: Callable[[AgentEnd], None]) -> None:
        self._clock, self._tell, self._session = clock, tell, SharedSession()
        self._flights: dict[int, RealTimeAgent] = {}  # by agent
        self._open: dict[int, ExitStack] = {}
        self._closing: list[threading.Thread] = []
        self._codes: list[int] = []
        self._priority = FlightPriority(clock, self._note)

    def open(self, process: AgentProcess, stop: StopRequest) -> None:
        """Open what an agent needs; its failure ends it before it has begun."""
        agent, stack = process.agent, ExitStack()
        self._open[agent] = stack

        def enter() -> None:
            self._flights[agent] = stack.enter_context(flying_agent(process, self._clock, stop, self._session))

        self._take_turn(agent, enter)

    def begin(self, *, realtime: bool) -> None:
        """Spread the first ticks of the agents over one period, after asking for priority if that is wanted."""
        keep_from_collections()
        if realtime:
            self._priority.ask()
        now_us = self._clock.now_us()
        for place, flight in enumerate(self._flights.values()):
            flight.begin_at(now_us + place * flight.period_us // len(self._flights))

    def step(self) -> bool:
        """Wait for the next deadline and tick its agent; returns False when no agent is left."""
        if not self._flights:
            return False
        agent = min(self._flights, key=lambda number: self._flights[number].due_us)
        flight = self._flights[agent]
        self._priority.sleep_until(flight.due_us)
        self._take_turn(agent, flight.step)
        return True

    def wait_for_ends(self) -> int:
        """Wait until everything is closed; returns the largest exit code."""
        for thread in self._closing:
            thread.join()
        self._session.close()
        return max(self._codes, default=0)

    def _note(self, name: str, **fields: Any) -> None:
        """Record an event of every agent."""
        for flight in self._flights.values():
            flight.note(name, **fields)

    def _take_turn(self, agent: int, step: _Step) -> None:
        """Let an agent act; if it has ended, or fails, it takes no more turns."""
        try:
            ending = step()
        except SwarmError as error:
            ending = Ending(error.exit_code, str(error))
        except (Exception, SystemExit) as error:  # what would end a process of its own ends this agent
            ending = _unexpected(error)
        if ending is not None:
            self._end(agent, ending)

    def _end(self, agent: int, ending: Ending) -> None:
        """Close what an agent has open, in the background: a bus or a disk that hangs delays no other agent."""
        self._flights.pop(agent, None)
        if ending.words:
            print(f"{agent_name(agent)}: {printable_lines(ending.words)}", file=sys.stderr)
        closing = threading.Thread(target=self._close, args=(agent, ending), name=f"end-{agent}")
        self._closing.append(closing)
        closing.start()

    def _close(self, agent: int, ending: Ending) -> None:
        try:
            self._open.pop(agent).close()
        except (Exception, SystemExit) as error:
            ending = _unexpected(error)
        self._codes.append(ending.exit_code)
        self._tell(AgentEnd(agent=agent, exit_code=ending.exit_code, words=ending.words))


def _unexpected(error: BaseException) -> Ending:
    """Print where an exception comes from, and return the end that it is."""
    traceback.print_exception(error)
    return Ending(_EXIT_UNEXPECTED, f"{type(error).__name__}: {error}")
