"""The launches that run on this computer: how they announce themselves, and how a verb finds one.

A launch leaves a note in its run folder and in each registry, a private directory of the user: one in the runtime
directory and one beside other temporary files, so that sessions without a runtime directory find it too. A note holds
the process id and start time, so that a stale one is recognised; what is not private or not owned by the user is
ignored.
"""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from pathlib import Path

import msgspec
import psutil

from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.core.text import counted
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import read_file, replace_bytes
from swarmctl.wall_clock import monotonic_us, utc_us

LAUNCH_FILE = "launch.json"
_START_TOLERANCE_S = 1.0
_MAX_BYTES = 65_536  # size limit of a note


class RunningLaunch(msgspec.Struct, frozen=True):
    """Data with which an operator joins a launch."""

    run: str
    bus: str
    pid: int
    started_s: float  # start of the process, since the computer's; a reused pid has another
    agents: int
    run_dir: str
    view: str = ""  # address of the live view; "" without one
    identity: OwnIdentity | None = None  # as which operators speak here; None: a launch on one computer
    version: str = ""  # of the swarmctl that flies
    ending: bool = False  # nobody answers any more; its report is still written
    utc_ahead_us: int | None = None  # of its clock over monotonic time, which is the same for all processes here
    down: tuple[int, ...] = ()  # agents that have ended with their vehicles down, as a station heard of their hosts

    def utc_us(self) -> int:
        """Return UTC by the launch's clock, which follows steps of the computer's slowly [us]."""
        return utc_us() if self.utc_ahead_us is None else monotonic_us() + self.utc_ahead_us


def announce(launch: RunningLaunch) -> None:
    """Write the notes of a launch; on a full disk the operator's verbs are lost, but not the flight."""
    payload = msgspec.json.encode(launch)
    notes = [Path(launch.run_dir) / LAUNCH_FILE]
    with contextlib.suppress(OSError):  # without a descriptor left no folder can be listed
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
    """Return the start time of this process, since the computer's start [s], and its id."""
    process = psutil.Process()
    return _start_s(process), process.pid


def _start_s(process: psutil.Process) -> float:
    """Return when a process has started, since the computer's start: a step of its UTC changes both times alike."""
    return float(process.create_time() - psutil.boot_time())


def find_launch(run: str | None) -> RunningLaunch:
    """Return the running launch that is chosen by its name or run folder, or the only one of this user.

    Raises:
        StartError: there is none, or it is ending.
        ConfigError: there are several, and none of them is chosen.
    """
    if run is not None and _has_note(Path(run)):
        launch = launch_in(Path(run))
        if launch is None:
            raise StartError(f"--run {run}: no launch runs there. See what does with: swarmctl status")
        return _flying(launch)
    running = running_launches()
    found = [launch for launch in running if run is None or launch.run.startswith(run)]
    found = [launch for launch in found if launch.run == run] or found
    found = [launch for launch in found if not launch.ending] or found
    if len(found) == 1:
        return _flying(found[0])
    if found:
        names = ", ".join(f"{launch.run} ({counted(launch.agents, 'agent')}, {launch.run_dir})" for launch in found)
        raise ConfigError("--run", [f"{len(found)} launches run, choose one by its name or folder: {names}"])
    if run is not None:
        known = ", ".join(f"{launch.run} ({launch.run_dir})" for launch in running) or "none"
        raise StartError(f"--run {run}: no launch runs there or has that name; running: {known}")
    raise StartError("no launch runs. Start one with: swarmctl launch")


def running_launches() -> list[RunningLaunch]:
    """Return every running launch of this user, the newest first; notes of others are removed."""
    running: dict[tuple[int, float], RunningLaunch] = {}
    for path in (path for registry in _registries() for path in registry.glob("*.json")):
        launch = _read(path)
        if launch is not None and runs(launch):
            running[launch.pid, launch.started_s] = launch
        else:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
    return sorted(running.values(), key=lambda launch: launch.started_s, reverse=True)


def launch_in(directory: Path) -> RunningLaunch | None:
    """Return the launch of a run folder if it still runs; also while it is ending."""
    launch = _read(directory / LAUNCH_FILE)
    return launch if launch is not None and runs(launch) else None


def refuse_running(directory: Path) -> None:
    """Check that no launch still flies into a run folder, or is ending.

    Raises:
        StartError: one is.
    """
    if launch_in(directory) is not None:
        raise StartError(f"{directory}: its launch still flies or is ending, see: swarmctl status")


def runs(launch: RunningLaunch) -> bool:
    """Return whether the process of a launch is still there."""
    try:
        process = psutil.Process(launch.pid)
        if process.status() == psutil.STATUS_ZOMBIE:  # it has ended, and its parent has not noticed yet
            return False
        return abs(_start_s(process) - launch.started_s) < _START_TOLERANCE_S
    except (psutil.Error, ValueError):
        return False


def refuse_ending(launch: RunningLaunch) -> None:
    """Check that a launch which does not answer, or not fully, has not begun to end since it was found.

    Raises:
        StartError: it has.
    """
    _flying(_read(Path(launch.run_dir) / LAUNCH_FILE) or launch)


def _has_note(directory: Path) -> bool:
    """Return whether this is the folder of a launch; not if it may not be looked into, or its name is too long."""
    try:
        return (directory / LAUNCH_FILE).exists()
    except OSError:
        return False


def _flying(launch: RunningLaunch) -> RunningLaunch:
    """Return a launch as it is.

    Raises:
        StartError: it is ending.
    """
    if launch.ending:
        raise StartError(f"{launch.run} is ending: nobody answers any more, it writes its report to {launch.run_dir}")
    return launch


def _registries() -> list[Path]:
    """Return the private directories of this user that may hold notes."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    places = [Path(runtime) / "swarmctl"] if runtime and _is_private(Path(runtime)) else []
    for folder in _temporary_folders():
        places += sorted(folder.glob(f"{_temporary_name()}*"))
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
    try:
        plain = Path(tempfile.gettempdir()) / _temporary_name()
    except OSError:  # no disk takes a file
        return None
    with contextlib.suppress(OSError):
        plain.mkdir(mode=0o700, exist_ok=True)
    for place in (plain, *sorted(plain.parent.glob(f"{plain.name}-*"))):
        if _is_private(place):
            return place
    with contextlib.suppress(OSError):
        return Path(tempfile.mkdtemp(prefix=f"{plain.name}-", dir=plain.parent))
    return None


def _temporary_folders() -> list[Path]:
    """Return where launches may have left notes: to find the one that flies, no disk has to take a file.

    Python takes the first of some folders that takes a file. One before it may have been that when a launch started,
    and be full by now.
    """
    named = (os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP"))
    folders = list(dict.fromkeys(Path(folder) for folder in (*named, "/tmp", "/var/tmp") if folder))
    try:
        now = Path(tempfile.gettempdir())
        before = folders[: folders.index(now)] if now in folders else folders if now == Path.cwd() else []
    except OSError:
        return folders
    return [*before, now]


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
