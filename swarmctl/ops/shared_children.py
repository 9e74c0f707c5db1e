"""Agents that share a process, each seen by the supervisor as the child that it would be on its own."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from swarmctl.agent.agent_end import EndReader
from swarmctl.bus.bus import agent_name
from swarmctl.errors import StartError
from swarmctl.ops.processes import Child, Command

_EXIT_UNTOLD = 1  # of an agent whose process ended well, without a word about it


class SharedAgent(Child):
    """One agent of a process of several; it ends when it says so, or with the process.

    A signal reaches all agents of the process, and is sent for one that has not ended: launches send signals to
    agents only to land all of them.

    Args:
        agent: its number.
        host: the process.
        ends: what the process tells about its agents.
    """

    def __init__(self, agent: int, host: Child, ends: EndReader) -> None:  # starts no process of its own
        self.name, self.argv, self.log, self.pid = agent_name(agent), host.argv, host.log, host.pid
        self.agents, self.ended_s = (agent,), None
        self.process = host.process
        self._agent, self._ends = agent, ends

    def signal(self, signum: int) -> None:
        """Send a signal to the process, unless this agent has ended."""
        if self.poll() is None:
            super().signal(signum)

    def kill_all(self) -> None:
        """Kill the process, unless this agent has ended; others may fly on in it."""
        if self.poll() is None:
            super().kill_all()

    def last_line(self) -> str:
        """Return why the agent has ended, or the last line of the process where it has not said so."""
        end = self._ends.end_of(self._agent)
        return super().last_line() if end is None else end.words

    def _returncode(self) -> int | None:
        code = self.process.poll()  # looked at first: what its agents have told is in the pipe when it has ended
        end = self._ends.end_of(self._agent)
        if end is not None:
            return end.exit_code
        return _EXIT_UNTOLD if code == 0 else code


def start_agents(command: Command, directory: Path) -> tuple[Child, list[SharedAgent]]:
    """Start a process of several agents; returns it, and its agents.

    Raises:
        StartError: the program can't be run.
    """
    try:
        read_fd, write_fd = os.pipe()
    except OSError as error:
        raise StartError(f"{command.name}: {error}") from error
    argv = (*command.argv, "--ends-fd", f"{write_fd}")
    try:
        host = Child(replace(command, argv=argv, fds=(*command.fds, write_fd)), directory)
    except BaseException:
        os.close(read_fd)
        raise
    finally:
        os.close(write_fd)
    ends = EndReader(read_fd)
    return host, [SharedAgent(agent, host, ends) for agent in command.agents]
