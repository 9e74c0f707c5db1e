"""The processes of a launch: a table of command lines, and a child process that is started, watched and ended.

Every child has its own session, so that Ctrl-C in the terminal reaches the launcher alone. It writes to
`DIR/<name>.log`, and the kernel ends it with the launcher.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import psutil

from swarmctl.bus.bus import agent_name
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.network.router_links import RouterLinks
from swarmctl.bus.zenoh.client import socket_file
from swarmctl.config import Config
from swarmctl.configuration.view import viewed_flight
from swarmctl.core.text import printable
from swarmctl.errors import StartError
from swarmctl.process_lifetime import PARENT_ENV, module_command
from swarmctl.process_priority import bind_to_processor, usable_processors
from swarmctl.telemetry.recording.file_names import CONFIG, TRUTH, events_file

ROUTER = "router"
SITL = "sitl"
VIEWER = "viewer"
_TAIL_BYTES = 4096
_CROWDED = 3  # agents for each processor; of six on two 0.04 % of the ticks were late, of nine 10 %
_CROWDED_SHARED = 6  # of agents that share processes; of twelve on two up to 1.4 %, of twenty most
_AGENTS_PER_PROCESSOR = 2  # more at real-time priority could leave nothing for shells and the launcher itself


@dataclass(frozen=True, slots=True)
class Command:
    """One process to start: its name, its command line, the file descriptors it inherits, and its agents if any.

    One with a `processor` runs on that alone.
    """

    name: str
    argv: tuple[str, ...]
    fds: tuple[int, ...] = ()
    agents: tuple[int, ...] = ()
    processor: int | None = None


@dataclass(frozen=True, slots=True)
class RunContext:
    """Values that all command lines of a launch share: run name, bus endpoint, run folder, agents of this computer.

    On a bus of several computers also the identity as which all of them speak. `realtime` says whether what flies asks
    for real-time priority.
    """

    run: str
    endpoint: str
    directory: Path
    agents: tuple[int, ...]
    identity: OwnIdentity | None = None
    realtime: bool = False


def run_name(name: str) -> str:
    """Return a name for one run on the bus that is new every time."""
    return f"{name}-{secrets.token_hex(4)}"


def wants_realtime(config: Config, agents: Sequence[int]) -> bool:
    """Return whether these agents are to have real-time priority and leave the processors some time for others.

    A process of several may have a processor for itself: it gives the priority up where it would leave nothing.
    """
    if sys.platform != "linux":
        return False
    processes, processors = len(_shares(len(agents), config.swarm.agents_per_process)), len(usable_processors())
    is_little = len(agents) <= _AGENTS_PER_PROCESSOR * processors or processes <= processors
    return config.agent.realtime and is_little


def router_command(context: RunContext, links: RouterLinks | None) -> Command:
    """Return the command of the bus router, with its links to other computers if there are any."""
    argv = module_command("swarmctl.bus.network.router", context.endpoint, "--die-with-parent")
    argv += links.arguments() if links is not None else ()
    return Command(ROUTER, (*argv, _priority_flag(context)))


def agent_commands(
    config: Config,
    context: RunContext,
    sockets: Sequence[socket.socket],
    vehicles: Sequence[socket.socket] = (),
    *,
    config_path: Path | None = None,
) -> tuple[Command, ...]:
    """Return the commands of the agents of this computer, one for each unless they share processes.

    Args:
        config: the configuration of the launch.
        context: the run.
        sockets: these agents' ends of the vehicle links, which they inherit; empty for real vehicles.
        vehicles: the simulator's ends of these links, whose ports the agents are given.
        config_path: resolved configuration, when it is not in the run folder.
    """
    commands = []
    last_first = itertools.cycle(reversed(usable_processors()))  # interrupts are often served by the first ones
    for places in _shares(len(context.agents), config.swarm.agents_per_process):
        argv = module_command("swarmctl", "agent", "--config", f"{config_path or context.directory / CONFIG}")
        argv += ("--run", context.run, "--bus", context.endpoint, "--run-dir", f"{context.directory}")
        agents = tuple(context.agents[place] for place in places)
        fds = tuple(sockets[place].fileno() for place in places) if sockets else ()
        ports = [vehicles[place].getsockname()[1] for place in places] if vehicles else ()
        for option, values in (("--id", agents), ("--fd", fds), ("--vehicle-port", ports)):
            argv += tuple(word for value in values for word in (option, f"{value}"))
        argv += () if context.identity is None else ("--identity", context.identity.name)
        argv += (_priority_flag(context),)
        name = agent_name(agents[0]) if len(agents) == 1 else f"agents-{agents[0]}-{agents[-1]}"
        commands.append(Command(name, argv, fds, agents, next(last_first) if config.agent.pinned else None))
    return tuple(commands)


def _shares(agents: int, most: int) -> list[range]:
    """Return the places of the agents of each process: as few processes as do, with as many agents each as others."""
    return even_shares(agents, -(-agents // most))


def even_shares(agents: int, processes: int) -> list[range]:
    """Return the places of the agents of each of so many processes: as many as in the others, or one fewer."""
    return [range(agents * i // processes, agents * (i + 1) // processes) for i in range(processes)]


def crowding_warning(config: Config, agents: Sequence[int]) -> list[str]:
    """Return what to say where processes of agents have too few processors."""
    processors = len(usable_processors())
    processes = len(_shares(len(agents), config.swarm.agents_per_process))
    lines = []
    if config.agent.pinned and processes >= processors:
        lines = [
            f"warning: {processes} processes of agents are bound to all {processors} processors, and wait there for "
            "router, simulator and others: without agent.pinned fewer setpoints are late"
        ]
    if not config.sitl.enabled or (processes <= _CROWDED * processors and len(agents) <= _CROWDED_SHARED * processors):
        return lines
    share = -(-len(agents) // processors)
    text = f"{len(agents)} agents on {processors} processors: setpoints may be late, and nobody arms while they are"
    if len(agents) > _CROWDED_SHARED * processors:
        return [*lines, f"warning: {text}; `swarmctl simulate` flies them on a simulated clock"]
    return [*lines, f"warning: {text}; --set swarm.agents_per_process={share} costs half as much"]


def sitl_command(
    config: Config, context: RunContext, ports: Sequence[int], sockets: Sequence[socket.socket] = ()
) -> Command:
    """Return the command of the built-in simulator, which sends from `sockets`, or own ports, to loopback `ports`."""
    argv = module_command(
        "sitl", "--config-json", config.simulator(context.agents).model_dump_json(exclude_defaults=True)
    )
    argv += ("--remote-ports", ",".join(str(port) for port in ports))
    fds = tuple(sock.fileno() for sock in sockets)
    argv += ("--local-fds", ",".join(map(str, fds))) if fds else ()
    argv += ("--control", f"{control_socket(context.endpoint)}")
    argv += ("--events", f"{context.directory / events_file(SITL)}")
    argv += ("--truth", f"{context.directory / TRUTH}", "--die-with-parent", _priority_flag(context))
    return Command(SITL, argv, fds)


def control_socket(endpoint: str) -> Path:
    """Return the path of the socket on which the simulator of a launch takes faults: beside the bus."""
    return socket_file(endpoint).with_name("sitl.sock")


def viewer_command(config: Config, context: RunContext, port: int, *, view: bool, web: bool) -> Command:
    """Return the command of the viewer process, which owns rerun; it may open a window, and serve a page."""
    argv = module_command("swarmctl.telemetry.view.viewer", "--run", context.run, "--bus", context.endpoint)
    argv += ("--flight", viewed_flight(config).model_dump_json(), "--run-dir", f"{context.directory}")
    argv += ("--port", f"{port}", "--rate-hz", f"{config.telemetry.rate_hz!r}", "--die-with-parent")
    argv += ("--history-mb", f"{config.telemetry.history_mb}")
    argv += () if context.identity is None else ("--identity", context.identity.as_json())
    return Command(VIEWER, argv + (("--view",) if view else ()) + (("--web",) if web else ()))


def _priority_flag(context: RunContext) -> str:
    """Return the flag of a process that delays setpoints, predicted paths or vehicle states when it has to wait."""
    return "--realtime" if context.realtime else "--no-realtime"


class Child:
    """A started process. Start it from the main thread: the kernel ties its life to the thread that did."""

    def __init__(self, command: Command, directory: Path) -> None:
        self.name, self.argv, self.agents = command.name, command.argv, command.agents
        self.log = directory / f"{command.name}.log"
        self.ended_s: float | None = None
        try:
            with _opened_log(self.log) as log:
                self.process = subprocess.Popen(
                    command.argv,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=_environment(os.environ),
                    pass_fds=command.fds,
                    start_new_session=True,
                )
        except OSError as error:
            raise StartError(f"{command.name}: {command.argv[0]} can't be started: {error}") from error
        self.pid = self.process.pid
        if command.processor is not None:
            bind_to_processor(self.pid, command.processor)

    def poll(self) -> int | None:
        """Return the exit code as a shell does (128 + signal), or None while running."""
        code = self._returncode()
        if code is None:
            return None
        if self.ended_s is None:
            self.ended_s = time.monotonic()
        return code if code >= 0 else 128 - code

    def is_stopped(self) -> bool:
        """Return whether it is stopped by a signal or a debugger."""
        with contextlib.suppress(psutil.Error, OSError):  # no descriptor may be left
            return bool(psutil.Process(self.pid).status() in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP))
        return False

    def processor_s(self) -> float | None:
        """Return the processor time that its main thread has used, or None if it has ended or a debugger holds it.

        The main thread of an agent ticks; recorder and bus go on in others where it hangs.
        """
        with contextlib.suppress(psutil.Error, OSError):
            process = psutil.Process(self.pid)
            if process.status() == psutil.STATUS_TRACING_STOP:
                return None
            mains = [thread for thread in process.threads() if thread.id == self.pid]  # of Linux
            used = process.cpu_times()
            return mains[0].user_time + mains[0].system_time if mains else used.user + used.system
        return None

    def signal(self, signum: int) -> None:
        """Send a signal, unless the process has ended."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signum)

    def kill_all(self) -> None:
        """Send SIGKILL to every process of the child's session, also to orphans of it.

        As long as there are orphans nobody else gets the child's number. Who has it after its end has another session.
        """
        if self.ended_s is not None and psutil.pid_exists(self.pid):
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)

    def wait(self, timeout_s: float) -> bool:
        """Wait, and return whether it ended in time."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(max(0.0, timeout_s))
        return self.poll() is not None

    def how_it_ended(self) -> str:
        """Return how it ended, in words, with its last line of output."""
        code = self._returncode()
        if code is None:
            return "is running"
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        last = self.last_line()
        return f"ended with exit code {code}" + (f": {last}" if last else "")

    def last_line(self) -> str:
        """Return the last line of its log that is not empty."""
        lines = [line.strip() for line in self._tail().splitlines() if line.strip()]
        return printable(lines[-1]) if lines else ""

    def line_with(self, text: str) -> str:
        """Return the first line of its log that contains `text`, or ""."""
        with contextlib.suppress(OSError):
            for line in self.log.read_text(encoding="utf-8", errors="replace").splitlines():
                if text in line:
                    return printable(line.strip())
        return ""

    def _returncode(self) -> int | None:
        """Return the exit code, negative that of a signal, or None while running."""
        return self.process.poll()

    def _tail(self) -> str:
        with contextlib.suppress(OSError), self.log.open("rb") as log:
            log.seek(max(0, self.log.stat().st_size - _TAIL_BYTES))
            return log.read().decode("utf-8", errors="replace")
        return ""


def _opened_log(path: Path) -> BinaryIO:
    """Open the log of a process; nothing is kept of what it prints where the disk or its folder takes no file.

    Raises:
        OSError: no descriptor is left.
    """
    try:
        return path.open("ab")
    except OSError:
        return Path(os.devnull).open("ab")


def end_all(children: Sequence[Child], grace_s: float) -> None:
    """Send SIGTERM, wait for a common deadline, then SIGKILL the remaining sessions."""
    for child in children:
        if child.poll() is None:
            child.signal(signal.SIGTERM)
    deadline_s = time.monotonic() + grace_s
    for child in children:
        child.wait(deadline_s - time.monotonic())
    kill_all(children)


def kill_all(children: Sequence[Child]) -> None:
    """Kill every process now, and reap it."""
    for child in children:
        child.kill_all()
    for child in children:
        child.wait(2.0)


def _environment(base: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a child. Rayon (rerun) gets one thread, as linear algebra: agents share the cores."""
    return {**base, "RAYON_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", PARENT_ENV: str(os.getpid())}
