"""Operator client: finds a running launch and commands it over the bus.

A launch leaves a note in its run folder and in each registry, a private directory of the user: one in the runtime
directory and one beside other temporary files, so that sessions without a runtime directory find it too. A note holds
the process id and start time, so that a stale one is recognised; what is not private or not owned by the user is
ignored. Verbs repeat their message until answered, because the router of a fresh session may not know the subscribers.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import psutil

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import StatusMessage, decode_status
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.network.sealed_bus import FOR_OPERATORS_US
from swarmctl.bus.topics import ANSWER, OBSTACLES, OPERATOR, STATUS
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import read_file, replace_bytes

LAUNCH_FILE = "launch.json"
ANSWER_S = 5.0  # longest wait for what is asked over the bus
REPEAT_S = 0.2
_START_TOLERANCE_S = 1.0
_MAX_BYTES = 65_536  # size limit of a note


class RunningLaunch(msgspec.Struct, frozen=True):
    """Data with which an operator joins a launch."""

    run: str
    bus: str
    pid: int
    started_s: float  # start of the process, UTC; a reused pid has another
    agents: int
    run_dir: str
    view: str = ""  # address of the live view; "" without one
    identity: OwnIdentity | None = None  # as which operators speak here; None: a launch on one computer
    version: str = ""  # of the swarmctl that flies
    ending: bool = False  # nobody answers any more; its report is still written


def announce(launch: RunningLaunch) -> None:
    """Write the notes of a launch; on a full disk the operator's verbs are lost, but not the flight."""
    payload = msgspec.json.encode(launch)
    notes = [Path(launch.run_dir) / LAUNCH_FILE]
    notes += [place / f"{launch.pid}.json" for place in (_runtime_registry(), _temporary_registry()) if place]
    for note in notes:
        with contextlib.suppress(OSError):
            replace_bytes(note, payload)


def withdraw() -> None:
    """Remove this process's notes from the registries; one that is left is known to be stale."""
    with contextlib.suppress(OSError):  # without a descriptor left no folder can be listed
        for registry in _registries():
            with contextlib.suppress(OSError):
                (registry / f"{os.getpid()}.json").unlink(missing_ok=True)


def process_start_s() -> tuple[float, int]:
    """Return the start time of this process, UTC [s], and its id."""
    return psutil.Process().create_time(), os.getpid()


def find_launch(run: str | None) -> RunningLaunch:
    """Return the running launch that is chosen by its name or run folder, or the only one of this user.

    Raises:
        StartError: there is none, or it is ending.
        ConfigError: there are several, and none of them is chosen.
    """
    if run is not None and (Path(run) / LAUNCH_FILE).exists():
        launch = _read(Path(run) / LAUNCH_FILE)
        if launch is None or not _runs(launch):
            raise StartError(f"--run {run}: no launch runs there. See what does with: swarmctl status")
        return _flying(launch)
    running = running_launches()
    found = [launch for launch in running if run is None or launch.run.startswith(run)]
    found = [launch for launch in found if launch.run == run] or found
    found = [launch for launch in found if not launch.ending] or found
    if len(found) == 1:
        return _flying(found[0])
    if found:
        names = "\n".join(f"  {launch.run}  {launch.agents} agents  {launch.run_dir}" for launch in found)
        raise ConfigError("--run", [f"{len(found)} launches run, choose one by its name or folder:\n{names}"])
    if run is not None:
        known = ", ".join(launch.run for launch in running) or "none"
        raise StartError(f"--run {run}: no launch runs there or has that name; running: {known}")
    raise StartError("no launch runs. Start one with: swarmctl launch")


def running_launches() -> list[RunningLaunch]:
    """Return every running launch of this user, the newest first; notes of others are removed."""
    running: dict[tuple[int, float], RunningLaunch] = {}
    for path in (path for registry in _registries() for path in registry.glob("*.json")):
        launch = _read(path)
        if launch is not None and _runs(launch):
            running[launch.pid, launch.started_s] = launch
        else:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    return sorted(running.values(), key=lambda launch: launch.started_s, reverse=True)


def refuse_ending(launch: RunningLaunch) -> None:
    """Check that a launch which does not answer, or not fully, has not begun to end since it was found.

    Raises:
        StartError: it has.
    """
    _flying(_read(Path(launch.run_dir) / LAUNCH_FILE) or launch)


def _flying(launch: RunningLaunch) -> RunningLaunch:
    """Return a launch as it is.

    Raises:
        StartError: it is ending.
    """
    if launch.ending:
        raise StartError(f"{launch.run} is ending: nobody answers any more, it writes its report to {launch.run_dir}")
    return launch


@contextmanager
def joined(launch: RunningLaunch) -> Iterator[Bus]:
    """Join the bus of a launch as its operator; what is not answered because it is ending is told so.

    Raises:
        StartError: it does not answer, or is ending.
    """
    senders = [agent_name(agent) for agent in range(launch.agents)]
    try:
        bus = join_bus(
            launch.bus,
            launch.run,
            OPERATOR if launch.identity is None else launch.identity.name,
            {STATUS: senders, ANSWER: senders, OBSTACLES: list_keepers(launch.identity)},
            identity=launch.identity,
            max_age_us=FOR_OPERATORS_US,
            utc_us=utc_us,
            connect_timeout_ms=3000,
        )
        with contextlib.closing(bus):
            yield bus
    except StartError:
        refuse_ending(launch)
        raise


def list_keepers(identity: OwnIdentity | None) -> tuple[str, ...]:
    """Return the senders whose list of obstacles an operator, or a supervisor, takes for that of the swarm.

    The station, which keeps none, takes that of any host.
    """
    if identity is None:
        return (OPERATOR,)
    return identity.roster.commanders(identity.name) if identity.speaker.agents else identity.roster.hosts


def utc_us() -> int:
    """Return the time of this computer, UTC [us]."""
    return time.time_ns() // 1000


def view_address(launch: RunningLaunch) -> str:
    """Return the address of the live view.

    Raises:
        StartError: this launch has none.
    """
    if not launch.view:
        raise StartError(f"view: {launch.run} serves none; it was started with telemetry.enabled = false, or just now")
    return launch.view


def read_statuses(launch: RunningLaunch) -> dict[int, StatusMessage]:
    """Return the newest status of every agent that publishes one in time, by agent.

    Raises:
        StartError: the launch is ending.
    """
    with joined(launch) as bus:
        statuses = _statuses(bus, range(launch.agents), ANSWER_S)
    if len(statuses) < launch.agents:
        refuse_ending(launch)
    return statuses


def watch_statuses(launch: RunningLaunch, every_s: float) -> Iterator[dict[int, StatusMessage]]:
    """Yield the statuses that have arrived since the last time, by agent, until the launch ends."""
    with joined(launch) as bus:
        while _runs(launch):
            yield _statuses(bus, range(launch.agents), 0.0)
            time.sleep(every_s)


def vector(key: str, text: str, problems: list[str]) -> tuple[float, float, float]:
    """Return the vector that `north,east,down` describes; what is wrong with it is added to `problems`."""
    try:
        north, east, down = (float(part) for part in text.split(","))
    except ValueError:
        problems.append(f"{key} {text!r}: write three numbers, north,east,down, for example 1.5,0,-2")
        return (0.0, 0.0, 0.0)
    return (north, east, down)


def _statuses(bus: Bus, agents: range, timeout_s: float) -> dict[int, StatusMessage]:
    """Return the newest status of each of `agents`, once all have published one or the time is up."""
    heard: dict[int, StatusMessage] = {}
    deadline_s = time.monotonic() + timeout_s
    while True:
        for sender, payload in bus.receive(STATUS):
            status = decode_status(payload)
            if status is not None and status.agent in agents and sender == agent_name(status.agent):
                heard[status.agent] = status
        if len(heard) == len(agents) or time.monotonic() >= deadline_s:
            break
        time.sleep(0.02)
    return dict(sorted(heard.items()))


def _registries() -> list[Path]:
    """Return the private directories of this user that may hold notes."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    places = [Path(runtime) / "swarmctl"] if runtime and _is_private(Path(runtime)) else []
    places += sorted(_temporary_folder().glob(f"{_temporary_name()}*"))
    return [place for place in places if _is_private(place)]


def _runtime_registry() -> Path | None:
    """Return the registry in the user's runtime directory, which no other user can write, or None without one."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if not runtime or not _is_private(Path(runtime)):
        return None
    registry = Path(runtime) / "swarmctl"
    with contextlib.suppress(OSError):
        registry.mkdir(mode=0o700, exist_ok=True)
    return registry if _is_private(registry) else None


def _temporary_registry() -> Path | None:
    """Return a private registry among temporary files; with a random name if another user has taken the usual one."""
    plain = _temporary_folder() / _temporary_name()
    with contextlib.suppress(OSError):
        plain.mkdir(mode=0o700, exist_ok=True)
    for place in (plain, *sorted(plain.parent.glob(f"{plain.name}-*"))):
        if _is_private(place):
            return place
    with contextlib.suppress(OSError):
        return Path(tempfile.mkdtemp(prefix=f"{plain.name}-", dir=plain.parent))
    return None


def _temporary_folder() -> Path:
    return Path(tempfile.gettempdir())


def _temporary_name() -> str:
    return f"swarmctl-{os.getuid()}"


def _is_private(place: Path) -> bool:
    """Return whether this is a directory (no link) of this user that is closed to all others."""
    try:
        status = place.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & 0o077


def _read(path: Path) -> RunningLaunch | None:
    try:
        return msgspec.json.decode(read_file(path, _MAX_BYTES), type=RunningLaunch)
    except (OSError, msgspec.DecodeError):
        return None


def _runs(launch: RunningLaunch) -> bool:
    try:
        process = psutil.Process(launch.pid)
        if process.status() == psutil.STATUS_ZOMBIE:  # it has ended, and its parent has not noticed yet
            return False
        return abs(process.create_time() - launch.started_s) < _START_TOLERANCE_S
    except (psutil.Error, ValueError):
        return False


def as_json(statuses: dict[int, StatusMessage], indent: int | None = 2) -> str:
    """Return statuses as a JSON list with one object per agent; without `indent` in one line."""
    return json.dumps(  # ASCII: an agent's text may contain anything
        msgspec.to_builtins(list(statuses.values())), indent=indent
    )
