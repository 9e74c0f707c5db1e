"""Flies a configuration from a script: `simulate` in lockstep, `launch` in real time. Both end with a `Run`.

The flight is made by the verbs of the command line in processes of their own, because a flight needs signals, real-time
priority and a simulator that the bridge never imports. So a script flies exactly what the command line flies.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from types import TracebackType
from typing import Any

import msgspec

from swarmctl.api.flight_process import FlightProcess
from swarmctl.api.run import Run, load_run
from swarmctl.config import Config, dump
from swarmctl.core.operator_verbs import FAR, GOTO, MISSION, POINT, SPEED, YAW, Order, order_problem
from swarmctl.core.types import FlightMode, Mode, Phase
from swarmctl.errors import ConfigError, MissionError, StartError
from swarmctl.files import read_file
from swarmctl.ops.orders.mission_file import set_mission
from swarmctl.ops.orders.operator import read_agents, read_statuses
from swarmctl.ops.orders.order_delivery import Reply, deliver
from swarmctl.ops.running_launches import LAUNCH_FILE, RunningLaunch
from swarmctl.telemetry.recording.file_names import CONFIG
from swarmctl.telemetry.recording.new_run_folder import create_run_folder, write_config
from swarmctl.wall_clock import utc_us

_READY_S = 120.0  # for the launch to have started every process
_POLL_S = 0.1
_MAX_NOTE_BYTES = 65_536
Agents = int | Iterable[int] | None


def simulate(config: Config | None = None, folder: str | Path | None = None, *, jobs: int | None = None) -> Run:
    """Fly in lockstep, faster than real time, and return the recorded run. The same seed gives the same run.

    Args:
        config: what to fly; None for the defaults.
        folder: run folder to create; None for `runs/<UTC>-<name>`.
        jobs: processes that share the agents, which changes no result; None for one per processor.

    Raises:
        ConfigError, StartError: nothing was flown. A failed mission is no error: see `Run.outcome`.
    """
    flown = config or Config()
    directory = _new_folder(flown, folder)
    arguments = [str(directory / CONFIG), f"--run-dir={directory}", *([] if jobs is None else [f"--jobs={jobs}"])]
    process = FlightProcess("simulate", directory, "sitl.simulate", *arguments)
    process.wait()
    process.refuse_no_flight()
    return load_run(directory)


def launch(config: Config | None = None, folder: str | Path | None = None, *, view: bool = False) -> Swarm:
    """Start simulator, agents and bus, and fly in real time; with your own vehicles if the configuration says so.

    Use it as a context: what still flies at its end is landed, and waited for. Returns once every process has started.

    Args:
        config: what to fly; None for the defaults.
        folder: run folder to create; None for `runs/<UTC>-<name>`.
        view: open the viewer window.

    Raises:
        ConfigError, StartError: it was refused or did not come up; nothing is left running.
    """
    flown = config or Config()
    directory = _new_folder(flown, folder)
    shown = "--view" if view else "--no-view"
    arguments = ("swarmctl", "launch", str(directory / CONFIG), f"--run-dir={directory}", shown)
    swarm = Swarm(flown, directory, FlightProcess("launch", directory, *arguments))
    try:
        swarm.wait_for_start()
    except BaseException:  # Ctrl-C reaches the script alone, and nobody would have the swarm
        swarm.__exit__(None, None, None)
        raise
    return swarm


def _new_folder(config: Config, folder: str | Path | None) -> Path:
    """Return a new run folder that holds the configuration."""
    if not isinstance(config, Config):
        raise ConfigError("config", [f"{config!r}: give what swarmctl.load returns, as swarmctl.load({config!r})"])
    directory = create_run_folder(None if folder is None else Path(folder), config.name, utc_us())
    write_config(directory, dump(config))
    return directory.resolve()


class Swarm:
    """A launch that flies; its verbs are those of the command line.

    Attributes:
        config: what it flies.
        folder: its run folder.
    """

    def __init__(self, config: Config, folder: Path, process: FlightProcess) -> None:
        self.config = config
        self.folder = folder
        self._process = process

    def __enter__(self) -> Swarm:
        """Return the swarm itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Land what still flies, and wait for the end; a second Ctrl-C ends everything at once."""
        self._process.interrupt()
        self._process.wait()

    @property
    def is_flying(self) -> bool:
        """Whether the launch still runs."""
        return self._process.is_running

    def hold(self, agents: Agents = None) -> None:
        """Brake and hold position; see `order`."""
        self.order("hold", agents)

    def resume(self, agents: Agents = None) -> None:
        """Go on with the mission after `hold`; see `order`."""
        self.order("resume", agents)

    def land(self, agents: Agents = None) -> None:
        """Separate, then land; see `order`."""
        self.order("land", agents)

    def rtl(self, agents: Agents = None) -> None:
        """Fly back to the start, then land; see `order`."""
        self.order("rtl", agents)

    def goto(
        self,
        agent: int,
        point_ned_m: Sequence[float],
        *,
        yaw_deg: float | None = None,
        speed_m_s: float | None = None,
        far: bool = False,
    ) -> None:
        """Fly one agent to a point, and hold there until `resume`; see `order`, also for what is raised.

        Args:
            agent: its number.
            point_ned_m: (3,) in the shared frame.
            yaw_deg: heading there, clockwise from north; None for that of the mission.
            speed_m_s: peak speed; None for `agent.state_machine.speed_m_s`.
            far: fly there though it is more than 500 m away.

        Raises:
            ConfigError: it is no number of one agent, or the point is not three numbers.
        """
        if isinstance(agent, Iterable) or agent is None:
            raise ConfigError("goto", [f"agent = {agent!r}: expected the number of one agent, as 0"])
        if len(point_ned_m) != len(POINT):
            raise ConfigError("goto", [f"point_ned_m = {point_ned_m!r}: expected three numbers: {', '.join(POINT)}"])
        asked = dict(zip(POINT, point_ned_m, strict=True))
        chosen = {YAW: yaw_deg, SPEED: speed_m_s, FAR: 1.0 if far else None}
        self.order(GOTO, agent, **asked, **{name: value for name, value in chosen.items() if value is not None})

    def set_mission(self, file: str | Path, agents: Agents = None) -> None:
        """Fly the mission of a file from the same moment on, as `swarmctl mission set` does; see `order`.

        Args:
            file: TOML file that holds `[mission]` alone, as a configuration does.
            agents: number of an agent, several numbers, or None for all.

        Raises:
            ConfigError: there is no such agent, or this swarm can't fly the mission; lists all problems.
            StartError: the launch has ended.
            MissionError: an agent refuses it or is silent; says which and why.
        """
        self._refuse_ended(MISSION)
        _refuse_problems(set_mission(self._note(), Path(file), _numbers(agents)))

    def order(self, verb: str, agents: Agents = None, **arguments: float) -> None:
        """Give an order of the operator, and return once every agent asked has accepted it, and begun a stop.

        Args:
            verb: one of `swarmctl.core.operator_verbs.OPERATOR_VERBS`.
            agents: number of an agent, several numbers, or None for all.
            arguments: those of the verb, by name with the unit.

        Raises:
            ConfigError: there is no such verb or agent, its arguments are others, or one of them is no number.
            StartError: the launch has ended.
            MissionError: an agent refuses it or is silent; says which and why.
        """
        numbers = _as_floats(verb, arguments)
        if problem := order_problem(verb, numbers):
            raise ConfigError("order", [problem])
        self._refuse_ended(verb)
        _refuse_problems(deliver(self._note(), Order(verb, numbers), _numbers(agents)))

    def status(self) -> dict[int, dict[str, Any]]:
        """Return the newest status of every agent that answers, by agent; phase and modes are words.

        Raises:
            StartError: the launch has ended.
        """
        self._refuse_ended("status")
        found = {}
        for agent, status in read_statuses(self._note()).items():
            names = {"phase": Phase(status.phase), "mode": Mode(status.mode)}
            names["flight_mode"] = FlightMode(status.flight_mode)
            found[agent] = msgspec.to_builtins(status) | {key: value.name for key, value in names.items()}
        return found

    def wait_for(self, phase: str, timeout_s: float = 120.0) -> None:
        """Wait until every agent has reached a phase, for example "TRACK", or a later one, as who has landed and ended.

        Raises:
            ConfigError: there is no such phase.
            TimeoutError: not all of them have, after `timeout_s`.
            StartError: the launch has ended before.
        """
        if phase not in Phase.__members__:
            raise ConfigError("wait_for", [f"{phase!r} is no phase; those are {', '.join(Phase.__members__)}"])
        wanted, until_s = Phase[phase], time.monotonic() + timeout_s
        while True:
            self._refuse_ended("wait_for")
            statuses, gone = read_agents(self._note())
            phases = dict.fromkeys(gone, Phase.DONE.name)
            phases |= {agent: Phase(status.phase).name for agent, status in statuses.items()}
            if len(phases) == self.config.swarm.agents and all(Phase[name] >= wanted for name in phases.values()):
                return
            if time.monotonic() > until_s:
                raise TimeoutError(f"not all agents have reached {phase} after {timeout_s:g} s: {phases}")
            time.sleep(_POLL_S)

    def wait(self, timeout_s: float | None = None) -> Run:
        """Wait until the mission has ended and every vehicle is down, and return the recorded run.

        Raises:
            TimeoutError: it still flies after `timeout_s`.
            StartError: it did not come up.
        """
        self._process.wait(timeout_s)
        return self.run

    @property
    def run(self) -> Run:
        """The recorded run, once the launch has ended.

        Raises:
            StartError: it still flies, or did not come up.
        """
        if self.is_flying:
            raise StartError(f"{self.folder.name} still flies; wait() for its end, or land()")
        self._process.refuse_no_flight()
        return load_run(self.folder)

    def wait_for_start(self) -> None:
        """Wait until every process of the launch has started.

        Raises:
            ConfigError, StartError: it was refused or did not come up; nothing is left running.
        """
        until_s = time.monotonic() + _READY_S
        while not (self.folder / LAUNCH_FILE).exists():
            if not self.is_flying:
                self._process.refuse_no_flight()
                return
            if time.monotonic() > until_s:
                self.__exit__(None, None, None)
                raise StartError(f"{self.folder.name} did not start within {_READY_S:.0f} s; see its launch.log")
            time.sleep(_POLL_S)

    def _note(self) -> RunningLaunch:
        return msgspec.json.decode(read_file(self.folder / LAUNCH_FILE, _MAX_NOTE_BYTES), type=RunningLaunch)

    def _refuse_ended(self, verb: str) -> None:
        if not self.is_flying:
            raise StartError(f"{verb}: {self.folder.name} has ended")


def _numbers(agents: Agents) -> list[int]:
    """Return the numbers of the agents asked; none: all.

    Raises:
        ConfigError: no agent is named, or something that is no number of one.
    """
    if agents is None:
        return []
    named = list(agents) if isinstance(agents, Iterable) else [agents]
    numbers = [operator.index(one) for one in named if hasattr(one, "__index__") and not isinstance(one, bool)]
    if not named:
        raise ConfigError("agents", ["nobody is named; leave it out for all"])
    if len(numbers) < len(named):
        raise ConfigError("agents", [f"{agents!r}: expected numbers of agents, as 0 or [0, 2]"])
    return numbers


def _as_floats(verb: str, arguments: Mapping[str, object]) -> dict[str, float]:
    """Return the arguments of an order as the bus carries them; numbers of numpy are numbers, too.

    Raises:
        ConfigError: one is no number; text and truth values are none.
    """
    wrong = {name: value for name, value in arguments.items() if not isinstance(value, Real) or isinstance(value, bool)}
    if wrong:
        raise ConfigError(verb, [f"{name} = {value!r}: expected a number" for name, value in wrong.items()])
    return {name: float(value) for name, value in arguments.items() if isinstance(value, Real)}


def _refuse_problems(replies: Sequence[Reply]) -> None:
    """Check that every agent asked obeys.

    Raises:
        MissionError: one refuses, or is silent.
    """
    if problems := [reply.problem for reply in replies if reply.problem]:
        raise MissionError("\n".join(problems))
