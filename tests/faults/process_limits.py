"""What a launch and its processes run out of: disk, descriptors, readers; and starts that can't work."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from tests.benches.launches import NEAR, TWO
from tests.faults.launched import Bounded, Start
from tests.faults.process_events import (
    ROUTER,
    SHORT,
    agent_pid,
    tracking,
)
from tests.faults.row import require


@contextmanager
def small_disk(folder: Path, megabytes: float = 6.0) -> Iterator[Path]:
    """Yield a run folder on a disk of its own, which is soon full. As root."""
    where = folder / "run"  # beside it is what the launch prints
    where.mkdir()
    size = f"size={round(megabytes * 1024)}k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "none", str(where)], check=True)
    try:
        yield where
    finally:
        subprocess.run(["umount", "-l", str(where)], check=True)


def fill(disk: Path) -> None:
    """Leave not a byte."""
    with (disk / "filler").open("wb", buffering=0) as file:
        for size in (65536, 4096, 512, 1):
            try:
                while True:
                    file.write(b"\0" * size)
            except OSError:
                continue


def disk_full(phase: str) -> Callable[[Start], None]:
    def script(start: Start) -> None:
        with tempfile.TemporaryDirectory(prefix="disk") as name, small_disk(Path(name)) as disk:
            launched = start(*TWO, *NEAR, "--duration", "4", run_dir=disk)
            launched.until_phase(phase, 2)
            launched.event()
            fill(disk)
            code = launched.end()
            require(code == 4, f"exit code {code}: {launched.text()[-600:]}")
            launched.verdict()  # "failed" where too little was recorded to be judged
            require(launched.said("agent-1  TRACK"), "the mission was not flown")
            require(not launched.said("sitl ended"), "the simulator ended")
            require("No space left" in launched.text(), "it does not say that the disk is full")

    return script


_NO_MORE = 3  # what is open stays so, and nothing else can be opened


@contextmanager
def fewest_descriptors(pid: int) -> Iterator[None]:
    """Leave a process not one more descriptor than it has."""
    process = psutil.Process(pid)
    before = process.rlimit(resource.RLIMIT_NOFILE)
    process.rlimit(resource.RLIMIT_NOFILE, (_NO_MORE, before[1]))
    try:
        yield
    finally:
        if process.is_running():
            process.rlimit(resource.RLIMIT_NOFILE, before)


def descriptors_of_an_agent(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    with fewest_descriptors(agent_pid(launched)):
        code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")


def descriptors_of_the_router(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    with fewest_descriptors(launched.pid_of(ROUTER)):
        launched.verb("status")
        code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")


def descriptors_of_the_launcher(start: Start) -> None:
    """Take them away for good: it watches the flight to its end, prints the verdict, and says what it can't write."""
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    launched.keeps_note = True
    with fewest_descriptors(launched.process.pid):
        code = launched.end()
    require(code == 4, f"exit code {code}: {launched.text()[-600:]}")
    require(launched.said("Too many open files"), "why nothing is written is not said")
    launched.verdict()


def descriptors_of_the_launcher_and_an_agent_dies(start: Start) -> None:
    """It can't start what lands the vehicle: the vehicle's autopilot does, and it is named."""
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    launched.keeps_note = True
    with fewest_descriptors(launched.process.pid):
        os.kill(agent_pid(launched), signal.SIGKILL)
        code = launched.end()
    require(code == 4, f"exit code {code}: {launched.text()[-600:]}")
    require(launched.said("agent-1 was killed by SIGKILL"), "the death is not said")
    require(launched.said("vehicle 2 "), "the vehicle is not named")
    launched.verdict()


def run_folder_renamed_and_an_agent_dies(start: Start) -> None:
    """What lands the vehicle reads its configuration, and records, where nobody has renamed anything."""
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    elsewhere = launched.run_dir.with_name("renamed")
    launched.run_dir.rename(elsewhere)
    os.kill(agent_pid(launched), signal.SIGKILL)
    code = launched.end()
    elsewhere.rename(launched.run_dir)
    require(code == 4, f"exit code {code}: {launched.text()[-600:]}")
    require(launched.said("the vehicle of agent-1 is on the ground"), f"it is not landed: {launched.text()[-600:]}")
    launched.verdict()


class Piped(Bounded):
    """A launch whose output is read by another program, which may end."""

    prefix: tuple[str, ...] = ("sh", "-c", 'exec 3>"$0"; "$@" | { head -n 4 >&3; }; exit 0')

    def __init__(self, run_dir: Path, temp: Path, *arguments: str) -> None:
        self.prefix = (*type(self).prefix, str(run_dir.with_suffix(".head")))
        super().__init__(run_dir, temp, *arguments)


def reader_ends(start: Start) -> None:
    """Its output goes to `head`, which has ended by then: the launch flies on and finishes its folder."""
    launched = start(*TWO, *NEAR, "--duration", "4", kind=Piped)
    launched.event()
    launched.reacts("the run folder is finished", lambda: (launched.run_dir / "summary.json").exists())
    launched.process.wait(30)
    require(launched.summary()["outcome"] == "completed", f"{launched.summary()['violations']}")


def configuration_wrong(start: Start) -> None:
    launched = start("--set", "swarm.agnets=3", "--set", "agent.rate_hz=-1", "--set", "mission.kind=nonsense")
    launched.event()
    code = launched.end()
    require(code == 2, f"exit code {code}: {launched.text()[-300:]}")
    for word in ("agnets", "did you mean 'agents'", "agent.rate_hz", "mission.kind"):
        require(launched.said(word), f"{word} is not named: all problems at once, with key, value and fix")
    require(not launched.run_dir.exists(), "a run folder was made")


def _vehicles(*urls: str) -> tuple[str, ...]:
    listed = ",".join(f'{{sysid={i + 1},url="{url}"}}' for i, url in enumerate(urls))
    sets = ("sitl.enabled=false", "telemetry.enabled=false", f"vehicles=[{listed}]", f"swarm.agents={len(urls)}")
    return tuple(word for one in sets for word in ("--set", one))


def ports_taken(start: Start) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        launched = start(*_vehicles(f"udpin://127.0.0.1:{port}", "serial:///dev/no-such-device:57600"))
        launched.event()
        code = launched.end()
    require(code == 3, f"exit code {code}: {launched.text()[-300:]}")
    for word in ("vehicles.0.url", str(port), "vehicles.1.url", "/dev/no-such-device does not exist"):
        require(launched.said(word), f"{word} is not named")
    require(not launched.run_dir.exists(), "a run folder was made")


def vehicle_missing(start: Start) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    launched = start(*_vehicles(f"udpin://127.0.0.1:{port}"), "--set", "agent.connect_timeout_s=3")
    launched.event()
    code = launched.end()
    require(code == 3, f"exit code {code}: {launched.text()[-300:]}")
    require(launched.said(f"vehicle at udpin://127.0.0.1:{port}"), "the vehicle is not named")
