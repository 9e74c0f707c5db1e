"""The launcher: refuse what can be refused, start the table of processes, fly, stop all of it, sum up.

Who watches the flight is `swarmctl.ops.supervisor`; what may start at all is `swarmctl.ops.preflight`. Whatever
happens, nothing that was started here outlives this module: no process, no socket, no port.
"""

from __future__ import annotations

import shutil
import signal
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

from swarmctl.bus.peers import agent_name
from swarmctl.bus.topics import OBSTACLES, OPERATOR, STATUS
from swarmctl.bus.zenoh_bus import NO_BUS, SCHEME, ZenohBus, socket_file
from swarmctl.config import Config, dump
from swarmctl.errors import StartError
from swarmctl.files import replace_text
from swarmctl.ops.operator import RunningLaunch, announce, process_start_s, withdraw
from swarmctl.ops.preflight import LOOPBACK, Ground, inspect
from swarmctl.ops.processes import (
    ROUTER,
    Child,
    Command,
    Site,
    agent_commands,
    end_all,
    router_command,
    run_name,
    sitl_command,
    viewer_command,
)
from swarmctl.ops.status_table import Display, open_display
from swarmctl.ops.summary import sum_up
from swarmctl.ops.supervisor import Base, EventLog, Flight

_BUS_S = 20.0  # for the router to answer
_BUS_TRY_MS = 500
_LAND_S = 30.0
_STOP_S = 10.0  # viewer and simulator write their files out
_ROUTER_STOP_S = 3.0


@dataclass(frozen=True, slots=True)
class LaunchOptions:
    """What is not part of the flight's configuration."""

    run_dir: Path | None = None
    view: bool = False  # open the viewer's window


class Interrupts:
    """Counts SIGINT and SIGTERM instead of raising, and as the first of them SIGHUP.

    A terminal that is closed sends SIGHUP more than once, the kernel to its foreground and the shell to its jobs: that
    is nobody who asks again, and no reason to kill what is landing. Under `nohup` it is not heard at all, and never
    after the flight: it would cost the verdict.
    """

    _SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __init__(self) -> None:
        self.count = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        ignored = (signal.SIGHUP,) if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else ()
        heard = [signum for signum in self._SIGNALS if signum not in ignored]  # a stop is heeded in the background too
        self._before = {signum: signal.signal(signum, self._note) for signum in heard}
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._before.items():
            signal.signal(signum, signal.SIG_IGN if signum == signal.SIGHUP else handler)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self.count = max(self.count, 1) if signum == signal.SIGHUP else self.count + 1


def launch(config: Config, options: LaunchOptions) -> int:
    """Fly a configuration; returns the exit code.

    Raises:
        ConfigError, StartError: it was refused, or did not come up; nothing is left running.
    """
    with Interrupts() as interrupts:
        ground = inspect(config)
        try:
            directory = _run_folder(config, options)
        except BaseException:
            ground.release()
            raise
        display = open_display()
        base = Bringup(config, options, ground, directory, display)
        grace_s = _LAND_S  # should anything go wrong from here on, agents still get to land
        try:
            base.start()
            verdict = Flight(config, base, display).fly(lambda: interrupts.count)
            grace_s = 0.0  # who was waited for has ended
        finally:
            base.stop(grace_s)
            display.close()
    # from here on Ctrl-C acts as usual: nothing is left to land
    violated = sum_up(config, directory, verdict, display.say)
    return verdict.exit_code(violated)


def _run_folder(config: Config, options: LaunchOptions) -> Path:
    from swarmctl.telemetry.run_folder import create_run_folder  # heavy

    directory = create_run_folder(options.run_dir, config.name, time.time_ns() // 1000).resolve()
    try:
        replace_text(directory / "config.toml", dump(config))
    except OSError as error:
        raise StartError(f"{directory}: can't be written: {error}. Choose another with --run-dir") from error
    return directory


class Bringup(Base):
    """Everything that was started for one launch, and how to end it."""

    def __init__(
        self, config: Config, options: LaunchOptions, ground: Ground, directory: Path, display: Display
    ) -> None:
        self._socket_dir = Path(tempfile.mkdtemp(prefix="swarm-"))  # mode 0700
        self._config = config
        self._options = options
        self._ground = ground
        self._display = display
        self.site = Site(run_name(config.name), f"{SCHEME}{self._socket_dir}/bus.sock", directory)
        self.log = EventLog(directory / "launch.events.jsonl")
        self.children: dict[str, Child] = {}

    def start(self) -> None:
        """Bring everything up as far as the bus; the rest shows itself in flight.

        Raises:
            StartError: a program can't be run or the router does not answer.
        """
        config, site, ground = self._config, self.site, self._ground
        socket_file(site.endpoint)
        self._spawn(router_command(site.endpoint))
        self.bus = self._join_bus()
        if ground.view_port:
            self._spawn(viewer_command(config, site, ground.view_port, self._options.view))
        if config.sitl.enabled:
            self._spawn(sitl_command(config, site, ground.ports, ground.vehicle_sockets))
        for command in agent_commands(config, site, ground.sockets, ground.vehicle_sockets):
            self._spawn(command)
        self.announce("")
        for line in _introduction(config, site, ground):
            self._display.say(line)
        self.log.write("started", run=site.run, ports=list(ground.ports))

    def stop(self, agents_grace_s: float) -> None:
        """End every process, agents first, the router last, and leave nothing behind. Safe at any point."""
        router = [child for name, child in self.children.items() if name == ROUTER]
        agents = [child for name, child in self.children.items() if name.startswith(agent_name(0)[:-1])]
        others = [child for child in self.children.values() if child not in router + agents]
        end_all(agents, agents_grace_s)
        end_all(others, _STOP_S)
        if self.bus is not None:
            self.bus.close()
        end_all(router, _ROUTER_STOP_S)
        self._ground.release()
        shutil.rmtree(self._socket_dir, ignore_errors=True)
        withdraw()
        self.log.write("stopped", exit_codes={name: child.poll() for name, child in self.children.items()})

    def recover(self, agent: int) -> Child:
        """Start an agent on the vehicle of one that ended; it records beside, and flies without a router if it must."""
        router = self.children[ROUTER]
        endpoint = self.site.endpoint if router.poll() is None else NO_BUS
        directory = self.site.directory / "recovery"
        directory.mkdir(exist_ok=True)
        site = Site(self.site.run, endpoint, directory)
        ends = self._ground.sockets, self._ground.vehicle_sockets
        command = agent_commands(self._config, site, *ends, self.site.directory / "config.toml")[agent]
        return Child(replace(command, argv=(*command.argv, "--only-land")), directory)

    def announce(self, view: str) -> None:
        """Let operators' commands find this launch."""
        site = self.site
        start_s, pid = process_start_s()
        announce(
            RunningLaunch(site.run, site.endpoint, pid, start_s, self._config.swarm.agents, str(site.directory), view)
        )

    def _spawn(self, command: Command) -> None:
        self.children[command.name] = Child(command, self.site.directory)

    def _join_bus(self) -> ZenohBus:
        senders = [agent_name(agent) for agent in range(self._config.swarm.agents)]
        listen = {STATUS: senders, OBSTACLES: [OPERATOR]}
        router = self.children[ROUTER]
        deadline_s = time.monotonic() + _BUS_S
        while True:
            try:
                return ZenohBus(
                    self.site.endpoint, self.site.run, OPERATOR, listen, self._config.bus.lease_ms, _BUS_TRY_MS
                )
            except StartError as error:
                if router.poll() is not None:
                    raise StartError(f"router {router.how_it_ended()}; see {router.log}") from error
                if time.monotonic() > deadline_s:
                    raise StartError(f"router does not answer within {_BUS_S:.0f} s; see {router.log}") from error


def _introduction(config: Config, site: Site, ground: Ground) -> tuple[str, ...]:
    """Three lines that say what runs."""
    agents = config.swarm.agents
    if config.sitl.enabled:
        vehicles = f"built-in SITL ({config.sitl.preset}) on {LOOPBACK}"
    else:
        vehicles = ", ".join(vehicle.url for vehicle in config.vehicles[:agents])
    view = f"view on port {ground.view_port}" if ground.view_port else "no view"
    return (
        f"{site.run}: {agents} agent{'s' if agents > 1 else ''}, {vehicles}",
        f"bus {site.endpoint}; {view}",
        f"run folder {site.directory}",
    )
