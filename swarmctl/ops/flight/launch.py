"""The launcher: runs the preflight, starts the processes, supervises the flight, stops all processes, and sums up.

`swarmctl.ops.supervision` watches the flight, and `swarmctl.ops.preflight` decides whether it may start. In
every case all processes, sockets and ports that were started here end with this module.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from swarmctl import __version__
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.router_links import RouterLinks
from swarmctl.bus.network.sealed_bus import FOR_OPERATORS_US
from swarmctl.bus.topics import ENDED, EVENT, OBSTACLES, OPERATOR, STATUS, TICK, Topic
from swarmctl.bus.zenoh.client import NO_BUS, SCHEME, socket_file
from swarmctl.config import Config, dump
from swarmctl.configuration.config_warnings import launch_warning_lines
from swarmctl.core.json_safe import to_json
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.flight.summary import sum_up
from swarmctl.ops.orders.operator import ends_heard, list_keepers
from swarmctl.ops.preflight import LOOPBACK, ReservedPorts, inspect
from swarmctl.ops.processes import (
    ROUTER,
    VIEWER,
    Child,
    Command,
    RunContext,
    agent_commands,
    crowding_warning,
    end_all,
    router_command,
    run_name,
    sitl_command,
    viewer_command,
    wants_realtime,
)
from swarmctl.ops.running_launches import RunningLaunch, announce, process_start_s, withdraw
from swarmctl.ops.shared_children import start_agents
from swarmctl.ops.supervision.background_display import BackgroundDisplay
from swarmctl.ops.supervision.launch_result import LaunchResult
from swarmctl.ops.supervision.status_table import Display, open_display, tell
from swarmctl.ops.supervision.supervisor import FlightSupervisor, Services
from swarmctl.process_lifetime import StopRequest
from swarmctl.process_priority import is_realtime_permitted
from swarmctl.telemetry.recording.changed_parameters import read_originals
from swarmctl.telemetry.recording.event_log import EventLog
from swarmctl.telemetry.recording.file_names import CONFIG, events_file
from swarmctl.wall_clock import WallClock, utc_us

_BUS_S = 20.0  # timeout for the router to answer
_BUS_TRY_MS = 500
_CLOCK_TOLD_US = 100_000  # change of the clock that operators' commands are told
_STOP_S = 10.0  # time for viewer and simulator to write their files
_AGENTS_STOP_S = 30.0  # time to land for agents of a launch that did not come up, or broke off
_ROUTER_STOP_S = 3.0
_SHARED_STOP_S = 3.0  # time for a process to end after the last of its agents


@dataclass(frozen=True, slots=True)
class LaunchOptions:
    """Options of a launch that are not part of the configuration."""

    run_dir: Path | None = None
    view: bool = False  # open the viewer window
    web: bool = False  # serve the view to browsers of this computer


@dataclass(frozen=True, slots=True, kw_only=True)
class SwarmPart:
    """The part of a swarm that flies from one computer; all of it where no other one takes part.

    Attributes:
        run: name of the run on the bus, the same on every computer.
        agents: numbers of the agents here.
        links: links of the router to other computers, None without any.
    """

    run: str
    agents: tuple[int, ...]
    links: RouterLinks | None = None


def launch(config: Config, options: LaunchOptions) -> int:
    """Fly a configuration from this computer alone and return the exit code.

    Raises:
        ConfigError, StartError: it was refused, or did not come up; nothing is left running.
    """
    part = SwarmPart(run=run_name(config.name), agents=tuple(range(config.swarm.agents)))
    return launch_part(config, options, part)


def launch_part(config: Config, options: LaunchOptions, part: SwarmPart) -> int:
    """Fly the agents of this computer and return the exit code.

    Raises:
        ConfigError, StartError: it was refused, or did not come up; nothing is left running.
    """
    with StopRequest(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as stop:
        with started(config, options, part) as services:
            result = FlightSupervisor(config, services, services.display).fly(lambda: stop.count)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that closes now must not lose the result
    # From here on Ctrl-C acts as usual: nothing is left to land.
    return judged(config, services, result)


def judged(config: Config, services: Launcher, result: LaunchResult) -> int:
    """Judge the run folder of services that have stopped; return the exit code. Verbs find the launch until then."""
    try:
        directory, had_viewer = services.context.directory, VIEWER in services.children
        violated = sum_up(config, directory, result, services.display.print_line, had_viewer=had_viewer)
    finally:
        withdraw()
    return result.exit_code(violated)


@contextmanager
def started(config: Config, options: LaunchOptions, part: SwarmPart) -> Iterator[Launcher]:
    """Start the processes of this computer, and stop them at the end.

    Raises:
        ConfigError, StartError: it was refused, or did not come up; nothing is left running.
    """
    if options.web and not config.telemetry.enabled:
        raise ConfigError("--web", ["telemetry.enabled = false: there is no view"])
    with contextlib.ExitStack() as held:
        reserved = inspect(config, part.agents)
        held.callback(reserved.release)
        directory = held.enter_context(_run_folder(config, options))
        services = Launcher(config, options, reserved, directory, part=part)
        try:
            services.start()
            yield services
        except BaseException:
            services.stop(_AGENTS_STOP_S)
            withdraw()
            raise
        else:
            services.stop(0.0)  # every agent has ended
        finally:
            services.display.close()


@contextmanager
def _run_folder(config: Config, options: LaunchOptions) -> Iterator[Path]:
    """Yield the folder of a new run, with its configuration; no other run begins in it meanwhile."""
    from swarmctl.telemetry.recording.new_run_folder import create_run_folder, held_run, write_config  # heavy

    directory = create_run_folder(options.run_dir, config.name, utc_us()).resolve()
    with held_run(directory):
        try:
            write_config(directory, dump(config))
        except OSError as error:
            raise StartError(f"{directory}: can't be written: {error}. Choose another with --run-dir") from error
        yield directory


def _private_folder() -> Path:
    """Make the folder, of mode 0700, of sockets, and of what the run folder can't take any more.

    Raises:
        StartError: it can't be made.
    """
    try:
        return Path(tempfile.mkdtemp(prefix="swarm-"))
    except OSError as error:
        raise StartError(f"temporary files can't be written: {error}. Make room, or choose another TMPDIR") from error


class Launcher(Services):
    """Starts the processes of one launch, and ends them."""

    def __init__(
        self,
        config: Config,
        options: LaunchOptions,
        reserved: ReservedPorts,
        directory: Path,
        *,
        part: SwarmPart,
    ) -> None:
        self._private_dir = _private_folder()
        self._config = config
        self._options = options
        self._reserved = reserved
        self.clock = WallClock()
        self.log = EventLog(directory / events_file("launch"), "launch", self.clock.utc_us)
        self.display: Display = BackgroundDisplay(
            open_display(run=part.run), lambda why: self.log.write("display_failed", text=why)
        )
        identity = None if part.links is None else part.links.identity
        self.context = RunContext(
            part.run,
            f"{SCHEME}{self._private_dir}/bus.sock",
            directory,
            part.agents,
            identity,
            realtime=wants_realtime(config, part.agents),
        )
        self._links = part.links
        self.children: dict[str, Child] = {}
        self._shared: list[Child] = []  # processes of several agents
        self._announced: RunningLaunch | None = None

    def start(self) -> None:
        """Start every process and join the bus; later failures are seen by the supervisor.

        Raises:
            StartError: a program can't be run or the router does not answer.
        """
        config, context, reserved = self._config, self.context, self._reserved
        socket_file(context.endpoint)
        self._spawn(router_command(context, self._links))
        self.bus = self._join_bus()
        if reserved.view_port:
            options = self._options
            self._spawn(viewer_command(config, context, reserved.view_port, view=options.view, web=options.web))
        if config.sitl.enabled and context.agents:
            self._spawn(sitl_command(config, context, reserved.ports, reserved.vehicle_sockets))
        for command in agent_commands(config, context, reserved.sockets, reserved.vehicle_sockets):
            self._spawn_agents(command)
        self.announce("")
        for line in _introduction(config, context, reserved):
            self.display.print_line(line)
        realtime = context.realtime and is_realtime_permitted()
        self.log.write(
            "started",
            run=context.run,
            version=__version__,
            agents=list(context.agents),
            ports=list(reserved.ports),
            realtime=realtime,
        )

    @property
    def joined_bus(self) -> Bus:
        """Return the bus that `start` has joined.

        Raises:
            StartError: it has not.
        """
        if self.bus is None:
            raise StartError("the bus is not up")
        return self.bus

    def restart_router(self) -> None:
        """Start the router again where the ended one was; everybody's session finds it by itself."""
        self._spawn(router_command(self.context, self._links))

    def stop(self, agents_grace_s: float) -> None:
        """End every process, agents first and the router last, and remove all temporary files. Safe at any point."""
        router = [child for name, child in self.children.items() if name == ROUTER]
        agents = [child for child in self.children.values() if child.agents]
        others = [child for child in self.children.values() if child not in router + agents]
        end_all(agents, agents_grace_s)
        end_all(self._shared, _SHARED_STOP_S)
        self._announce_end()
        end_all(others, _STOP_S)
        if self.bus is not None:
            self.bus.close()
        end_all(router, _ROUTER_STOP_S)
        self._reserved.release()
        shutil.rmtree(self._private_dir, ignore_errors=True)
        ended = [*self.children.values(), *self._shared]
        self.log.write("stopped", exit_codes={child.name: child.poll() for child in ended})

    def recover(self, agent: int) -> Child:
        """Start an agent on the vehicle of an ended one; it records separately and can fly without a router."""
        router = self.children[ROUTER]
        endpoint = self.context.endpoint if router.poll() is None else NO_BUS
        directory = self._recovery_folder()
        context = replace(self.context, endpoint=endpoint, directory=directory, agents=(agent,))
        place = self.context.agents.index(agent)
        own = slice(place, place + 1)
        ends = self._reserved.sockets[own], self._reserved.vehicle_sockets[own]
        config_path = self._recovery_config()
        (command,) = agent_commands(self._config, context, *ends, config_path=config_path)
        return Child(replace(command, argv=(*command.argv, "--only-land", *self._originals(agent))), directory)

    def _recovery_config(self) -> Path:
        """Return where the configuration is; it is written anew where the run folder is gone.

        Raises:
            OSError: it can't be.
        """
        path = self.context.directory / CONFIG
        if not path.is_file():
            path = self._private_dir / CONFIG
            path.write_text(dump(self._config), encoding="utf-8")
        return path

    def _recovery_folder(self) -> Path:
        """Return where what lands a vehicle records: not in the run folder where that takes nothing, or is gone."""
        directory = self.context.directory / "recovery"
        try:
            directory.mkdir(exist_ok=True)
        except OSError:
            return self._private_dir
        return directory

    def _originals(self, agent: int) -> tuple[str, ...]:
        """Return the arguments by which another agent knows the parameters to set back; say so where they are lost."""
        try:
            were = read_originals(self.context.directory, agent_name(agent))
        except (OSError, ValueError) as error:
            text = f"the vehicle of {agent_name(agent)} may keep the parameters of this flight: {error}"
            tell(self.log, self.display, "parameters_unknown", text)
            return ()
        return ("--originals", to_json(were))

    def announce(self, view: str) -> None:
        """Publish this launch to the operator's commands."""
        if self._announced is not None:  # nothing else has changed, and there may be no descriptor left to ask again
            self._announced = msgspec.structs.replace(self._announced, view=view)
            announce(self._announced)
            return
        context = self.context
        start_s, pid = process_start_s()
        self._announced = RunningLaunch(
            context.run,
            context.endpoint,
            pid,
            start_s,
            self._config.swarm.agents,
            str(context.directory),
            view,
            context.identity,
            __version__,
            utc_ahead_us=self.clock.utc_ahead_us(),
        )
        announce(self._announced)

    def announce_clock(self) -> None:
        """Publish the clock to the operator's commands again, where it was corrected."""
        ahead_us, told = self.clock.utc_ahead_us(), self._announced
        if told is not None and abs(ahead_us - (told.utc_ahead_us or 0)) > _CLOCK_TOLD_US:
            self._announced = msgspec.structs.replace(told, utc_ahead_us=ahead_us)
            announce(self._announced)

    def announce_down(self, agents: tuple[int, ...]) -> None:
        """Publish who has ended with its vehicle down, as nobody may be left who says so to operators' commands."""
        if self._announced is not None and agents != self._announced.down:
            self._announced = msgspec.structs.replace(self._announced, down=agents)
            announce(self._announced)

    def _announce_end(self) -> None:
        """Publish that nobody answers any more; that it can't be, without a descriptor left, stops no ending."""
        if self._announced is not None:
            with contextlib.suppress(OSError):
                announce(msgspec.structs.replace(self._announced, ending=True))

    def _spawn(self, command: Command) -> None:
        self.children[command.name] = Child(command, self.context.directory)

    def _spawn_agents(self, command: Command) -> None:
        if len(command.agents) == 1:
            self._spawn(command)
            return
        host, agents = start_agents(command, self.context.directory)
        self._shared.append(host)
        self.children.update({child.name: child for child in agents})

    def _join_bus(self) -> Bus:
        context = self.context
        senders = [agent_name(agent) for agent in range(self._config.swarm.agents)]
        listen: dict[Topic, Sequence[str]] = {STATUS: senders, OBSTACLES: list_keepers(context.identity)}
        listen[ENDED] = tuple(ends_heard(context.identity))
        if not context.agents:  # nobody records here, so the station does
            listen[TICK] = listen[EVENT] = senders
        router = self.children[ROUTER]
        deadline_s = time.monotonic() + _BUS_S
        while True:
            try:
                return join_bus(
                    context.endpoint,
                    context.run,
                    OPERATOR if context.identity is None else context.identity.name,
                    listen,
                    identity=context.identity,
                    max_age_us=FOR_OPERATORS_US,
                    utc_us=self.clock.utc_us,
                    lease_ms=self._config.bus.lease_ms,
                    connect_timeout_ms=_BUS_TRY_MS,
                )
            except StartError as error:
                if router.poll() is not None:
                    raise StartError(f"router {router.how_it_ended()}; see {router.log}") from error
                if time.monotonic() > deadline_s:
                    raise StartError(f"router does not answer within {_BUS_S:.0f} s; see {router.log}") from error


def _introduction(config: Config, context: RunContext, reserved: ReservedPorts) -> tuple[str, ...]:
    """Return three lines that say what runs, and what is doubtful about it."""
    agents = len(context.agents)
    of = f" of {config.swarm.agents}" if agents < config.swarm.agents else ""
    if config.sitl.enabled:
        vehicles = f"built-in SITL ({config.sitl.preset}) on {LOOPBACK}"
    else:
        vehicles = ", ".join(config.vehicles[agent].url for agent in context.agents)
    view = "the view's address follows" if reserved.view_port else "no view"
    return (
        f"{context.run}: {agents}{of} agent{'s' if config.swarm.agents > 1 else ''}, {vehicles}",
        f"bus {context.endpoint}; {view}",
        f"run folder {context.directory}",
        *launch_warning_lines(config),
        *crowding_warning(config, context.agents),
    )
