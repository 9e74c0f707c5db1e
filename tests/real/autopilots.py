"""Real autopilots in their own simulators: N processes of a build of yours, on their usual ports.

A build is found by an environment variable; `docs/real_autopilots.md` says how.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from swarmctl.core.types import GeoOrigin
from swarmctl.process_lifetime import die_with_parent
from swarmctl.process_priority import request_realtime_for_this_thread
from tests.real.network import TMP, Network, with_tmp

SPACING_M = 2.0  # apart along north, about the origin
EARTH_RADIUS_M = 6_371_000.0
STOP_S = 5.0
BOOT_SPEED = 5.0  # of an ArduCopter's clock, whose filters take up to a minute to use GPS, until it is told otherwise
_PRIORITY = 11  # above launched agents, at 10: the autopilot of a real vehicle has a processor of its own
PARAMETER_FILES = ("copter.parm", "../../../Tools/autotest/default_params/copter.parm")  # beside it; of a source tree


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Place at which one vehicle is to be started."""

    index: int
    folder: Path
    lat_deg: float
    lon_deg: float
    alt_m: float
    parameters: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """One autopilot: default place, ports, and how a vehicle is started.

    Attributes:
        variable: environment variable with the path of its binary.
        origin: middle of the vehicles.
        ports: UDP ports of instance 0 that somebody listens on; the others follow.
        spread: instance i has port + spread * i.
        command: binary and start to command line.
        environment: what it is told by environment variables.
        lock_name: of a file in `TMP` by which it runs once on a machine, whatever the network; {} is the instance.
        programs: names of programs that its start needs beside its binary.
    """

    variable: str
    origin: GeoOrigin
    ports: tuple[int, ...]
    spread: int
    command: Callable[[Path, Start], list[str]]
    environment: Callable[[Start], dict[str, str]] = field(default=lambda start: {})
    lock_name: str = ""
    programs: tuple[str, ...] = ()

    @property
    def binary(self) -> Path | None:
        """Return the build to test with, or None."""
        given = os.environ.get(self.variable, "")
        return Path(given).expanduser().absolute() if given else None

    @property
    def unusable(self) -> list[str]:
        """Return what a named build lacks: files that don't exist, or are no programs (as copies of links are)."""
        assert self.binary is not None
        needed = (self.binary, *(self.binary.parent / name for name in self.programs))
        return [str(file) for file in needed if not (file.is_file() and os.access(file, os.X_OK))]

    def has_own_tmp(self, network: Network) -> bool:
        """Return whether its locks are its own: where that is permitted, and its build is still seen then."""
        return bool(self.lock_name) and network.is_own and self.binary is not None and TMP not in self.binary.parents

    def locks(self, network: Network, count: int) -> list[Path]:
        """Return the lock files that it shares with everybody on the machine."""
        if not self.lock_name or self.has_own_tmp(network):
            return []
        return [TMP / self.lock_name.format(i) for i in range(count)]

    def place(self, index: int, count: int, folder: Path, parameters: Mapping[str, float] | None = None) -> Start:
        """Return the place of the vehicle of that index among so many."""
        lat_deg = self.origin.lat_deg + math.degrees(north_m(index, count) / EARTH_RADIUS_M)
        return Start(
            index=index,
            folder=folder,
            lat_deg=lat_deg,
            lon_deg=self.origin.lon_deg,
            alt_m=self.origin.alt_m,
            parameters=parameters or {},
        )

    def shell_line(self, start: Start, network: Network) -> list[str]:
        """Return the shell line that starts it in that network, from any folder and any environment."""
        assert self.binary is not None
        folder, prefix = start.folder, network.prefix
        if self.has_own_tmp(network):
            folder, prefix = TMP / folder.name, (*prefix, *with_tmp(folder.parent))
        told = [f"{name}={value}" for name, value in self.environment(start).items()]
        return [*prefix, "env", "-C", str(folder), *told, *self.command(self.binary, start)]


def _px4_command(binary: Path, start: Start) -> list[str]:
    return [str(binary), "-i", str(start.index), "-d", str(binary.parent.parent / "etc")]


def _px4_environment(start: Start) -> dict[str, str]:
    home = {"LAT": f"{start.lat_deg:.9f}", "LON": f"{start.lon_deg:.9f}", "ALT": f"{start.alt_m}"}
    return {
        "PX4_SYS_AUTOSTART": "10040",
        "PX4_SIM_MODEL": "sihsim_quadx",
        **{f"PX4_HOME_{name}": value for name, value in home.items()},
        **{f"PX4_PARAM_{name}": f"{value:g}" for name, value in start.parameters.items()},
    }


def _arducopter_command(binary: Path, start: Start) -> list[str]:
    own = start.folder / "own.parm"
    sysid = start.index + 1
    lines = {"SYSID_THISMAV": sysid, **start.parameters}
    own.write_text("".join(f"{name} {value:g}\n" for name, value in lines.items()))
    return [
        *(
            str(binary),
            "-S",
            f"-I{start.index}",
            "--model",
            "quad",
            "--speedup",
            f"{BOOT_SPEED:g}",
            "--sysid",
            str(sysid),
        ),
        *("--home", f"{start.lat_deg:.9f},{start.lon_deg:.9f},{start.alt_m:g},0"),
        *("--defaults", f"{_parameter_file(binary)},{own}"),
        *("--serial0", f"udpclient:127.0.0.1:{14550 + 10 * start.index}"),
    ]


def _parameter_file(binary: Path) -> Path:
    for name in PARAMETER_FILES:
        if (binary.parent / name).is_file():
            return (binary.parent / name).resolve()
    raise FileNotFoundError(f"{binary}: none of {', '.join(PARAMETER_FILES)} from its folder")


PX4 = Kind(
    variable="SWARMCTL_PX4",
    origin=GeoOrigin(47.397742, 8.545594, 489.4),
    ports=(14540, 14580, 18570, 14280, 13030, 19450, 19410),
    spread=1,
    command=_px4_command,
    environment=_px4_environment,
    lock_name="px4_lock-{}",
    programs=("px4-param",),
)
ARDUCOPTER = Kind(
    variable="SWARMCTL_ARDUCOPTER",
    origin=GeoOrigin(-35.363262, 149.165237, 584.0),
    ports=(14550,),
    spread=10,
    command=_arducopter_command,
)


def north_m(index: int, count: int) -> float:
    """Return the north coordinate of a vehicle's place."""
    return (index - (count - 1) / 2) * SPACING_M


class Fleet:
    """N vehicles that stand `SPACING_M` apart along north; each writes to a folder of its own."""

    def __init__(
        self,
        kind: Kind,
        count: int,
        network: Network,
        directory: Path,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        self.kind, self.count, self.network = kind, count, network
        self._directory = directory
        self._parameters = parameters
        self._running: dict[int, subprocess.Popen[bytes]] = {}
        for index in range(count):
            self.start(index)

    def start(self, index: int) -> None:
        """Start the autopilot; its stored data stays."""
        folder = self._directory / str(index)
        folder.mkdir(parents=True, exist_ok=True)
        start = self.kind.place(index, self.count, folder, self._parameters)
        with (folder / "out.log").open("ab") as out:
            self._running[index] = subprocess.Popen(
                self.kind.shell_line(start, self.network),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                preexec_fn=_as_an_autopilot,
            )

    def stop(self, index: int) -> None:
        """End the autopilot."""
        process = self._running.pop(index)
        process.kill()
        process.wait(STOP_S)

    def reboot(self, index: int) -> None:
        self.stop(index)
        self.start(index)

    def close(self) -> None:
        for index in list(self._running):
            self.stop(index)


def _as_an_autopilot() -> None:
    die_with_parent(signal.SIGKILL)
    request_realtime_for_this_thread(_PRIORITY)
