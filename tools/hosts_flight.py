"""Flies a swarm from several hosts, each in a network namespace of its own, and breaks something on the way. As root.

    python tools/hosts_flight.py --only nothing,cut,host-lost --runs 3 --out runs/hosts

Every host and the station are started by the commands of docs/hosts.md. Each flight is judged by the true states of all
hosts' simulators, which share the clock of this machine.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import heapq
import itertools
import json
import os
import random
import select
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from swarmctl.bus.network.hosts import HostParams, ip_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.config import Config, load
from swarmctl.core.recorded.records import TRUTH_COLUMNS, TRUTH_DTYPE
from swarmctl.telemetry.recording.file_names import PACKED_TRUTH, TRUTH
from swarmctl.telemetry.recording.run_files import read_parquet, read_rows

CONFIG = Path(__file__).parents[1] / "configs" / "three_hosts.toml"
INTO_MISSION_S = 2.0  # when something is broken
CUT_S = 5.0
STOP_S = 8.0
START_S = 120.0
FLIGHT_S = 240.0
_GRID_US = 20_000
_NO_HOST = "nobody"
_TAP = struct.Struct("16sH22x")  # struct ifreq: name and flags
_TUNSETIFF, _TAP_WITHOUT_HEADER = 0x400454CA, 0x1002
_LARGEST_FRAME = 65_536
_SWITCH_PRIORITY = 60


class LossySwitch:
    """A switch that passes frames on late, and not all of them: not every kernel has netem.

    Each of its ports is a TAP device, which is moved to a host's namespace.

    Args:
        ports: how many there are.
        late_s: delay of every frame.
        lost_01: share of the frames that are lost.
    """

    def __init__(self, ports: int, late_s: float, lost_01: float) -> None:
        self._late_s, self._lost_01 = late_s, lost_01
        self._taps, self.devices = list[int](), list[str]()
        for port in range(ports):
            tap, name = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK), f"sw{os.getpid()}t{port}"
            fcntl.ioctl(tap, _TUNSETIFF, _TAP.pack(name.encode(), _TAP_WITHOUT_HEADER))
            self._taps.append(tap)
            self.devices.append(name)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._pass_on)

    def start(self) -> None:
        """Pass frames on from now on."""
        self._thread.start()

    def close(self) -> None:
        """Pass on no more; the devices are gone."""
        self._ends.set()
        self._thread.join()
        for tap in self._taps:
            os.close(tap)

    def _pass_on(self) -> None:
        with contextlib.suppress(OSError):  # agents that are scheduled before it would add delays of their own
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_SWITCH_PRIORITY))  # of this thread alone
        on_the_way, places, chance = list[tuple[float, int, int, bytes]](), dict[bytes, int](), random.Random(1)
        numbers = itertools.count()
        poll = select.poll()
        for tap in self._taps:
            poll.register(tap, select.POLLIN)
        while not self._ends.is_set():
            due_ms = 1e3 * (on_the_way[0][0] - time.monotonic()) if on_the_way else 100.0
            for tap, _ in poll.poll(max(0.0, min(100.0, due_ms))):
                frame = os.read(tap, _LARGEST_FRAME)
                places[frame[6:12]] = tap
                known = places.get(frame[:6])
                for to in self._taps if known is None else [known]:
                    if to != tap and chance.random() >= self._lost_01:
                        heapq.heappush(on_the_way, (time.monotonic() + self._late_s, next(numbers), to, frame))
            while on_the_way and on_the_way[0][0] <= time.monotonic():
                *_, to, frame = heapq.heappop(on_the_way)
                with contextlib.suppress(OSError):  # the device is down
                    os.write(to, frame)


@dataclass(kw_only=True)
class Network:
    """The namespaces of one flight: a switch, and a host on each of its ports."""

    prefix: str
    ips: dict[str, str]
    lossy: LossySwitch | None = None

    def __enter__(self) -> Network:
        if self.lossy is None:
            switch = f"{self.prefix}switch"
            _ip("netns", "add", switch)
            _ip("-n", switch, "link", "add", "bridge", "type", "bridge")
            _ip("-n", switch, "link", "set", "bridge", "up")
        for port, (name, ip) in enumerate(self.ips.items()):
            space = self.space(name)
            _ip("netns", "add", space)
            if self.lossy is None:
                _ip("-n", space, "link", "add", "eth0", "type", "veth", "peer", "name", f"p{port}", "netns", switch)
                _ip("-n", switch, "link", "set", f"p{port}", "master", "bridge", "up")
            else:
                _ip("link", "set", self.lossy.devices[port], "netns", space, "name", "eth0")
            _ip("-n", space, "address", "add", f"{ip}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                _ip("-n", space, "link", "set", device, "up")
        if self.lossy is not None:
            self.lossy.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.lossy is not None:
            self.lossy.close()
        for name in (*self.ips, *(() if self.lossy is not None else ("switch",))):
            self.kill(name)
            with contextlib.suppress(subprocess.CalledProcessError):
                _ip("netns", "delete", self.space(name))

    def space(self, name: str) -> str:
        """Return the namespace of a host."""
        return f"{self.prefix}{name}"

    def pids(self, name: str) -> list[int]:
        """Return the processes of a host."""
        done = subprocess.run(["ip", "netns", "pids", self.space(name)], capture_output=True, text=True, check=False)
        return [int(pid) for pid in done.stdout.split()]

    def kill(self, name: str) -> None:
        """End every process of a host at once, as if its battery were pulled."""
        for pid in self.pids(name):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def cut(self, a: str, b: str, *, heal: bool = False) -> None:
        """Cut the link of two hosts, or heal it."""
        for here, there in ((a, b), (b, a)):
            _ip("-n", self.space(here), "route", "del" if heal else "add", "blackhole", f"{self.ips[there]}/32")


@dataclass(kw_only=True)
class Flight:
    """One flight of all hosts and the station."""

    config: Config
    network: Network
    folder: Path
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def start(self, name: str, *arguments: str) -> None:
        """Start a command of swarmctl on a host; its output goes to a file."""
        line = ["ip", "netns", "exec", self.network.space(name), sys.executable, "-m", "swarmctl", *arguments]
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                [*line, "--run-dir", str(self.folder / name)], stdout=log, stderr=subprocess.STDOUT
            )

    def has_shown(self, host: HostParams, word: str) -> bool:
        """Return whether a phase was printed for every agent of a host."""
        lines = (self.folder / f"{host.name}.log").read_text(encoding="utf-8", errors="replace").splitlines()
        return all(any(f"agent-{agent}  {word}" in line for line in lines) for agent in host.agents)

    def until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for a condition; return whether it came true."""
        deadline_s = time.monotonic() + timeout_s
        while not condition() and time.monotonic() < deadline_s:
            time.sleep(0.05)
        return condition()

    def agent_pid(self, host: str, agent: int) -> int:
        """Return the process of an agent."""
        return next(pid for pid in self.network.pids(host) if f"--id\0{agent}\0" in _command_line(pid))

    def router_pid(self, host: str) -> int:
        """Return the router's process of a host."""
        return next(pid for pid in self.network.pids(host) if "swarmctl.bus.network.router" in _command_line(pid))


def _nothing(flight: Flight) -> None:
    return


def _station_gone(flight: Flight) -> None:
    flight.processes[STATION].send_signal(signal.SIGINT)


def _router_killed(flight: Flight) -> None:
    os.kill(flight.router_pid("bravo"), signal.SIGKILL)


def _cut(flight: Flight) -> None:
    flight.network.cut("alpha", "bravo")
    time.sleep(CUT_S)
    flight.network.cut("alpha", "bravo", heal=True)


def _isolated(flight: Flight) -> None:
    others = ("alpha", "bravo", STATION)
    for other in others:
        flight.network.cut("charlie", other)
    time.sleep(CUT_S)
    for other in others:
        flight.network.cut("charlie", other, heal=True)


def _host_lost(flight: Flight) -> None:
    flight.network.kill("charlie")


def _agent_killed(flight: Flight) -> None:
    bravo = next(host for host in flight.config.hosts if host.name == "bravo")
    os.kill(flight.agent_pid(bravo.name, bravo.agents[0]), signal.SIGKILL)


def _supervisor_stopped(flight: Flight) -> None:
    process = flight.processes["bravo"]
    process.send_signal(signal.SIGSTOP)
    time.sleep(STOP_S)
    process.send_signal(signal.SIGCONT)


@dataclass(frozen=True, slots=True)
class Broken:
    """What is broken in a flight, and the host whose mission is not asked for then."""

    act: Callable[[Flight], None]
    excused: str = _NO_HOST
    has_slow_links: bool = False


SCENARIOS = {
    "nothing": Broken(_nothing),
    "slow-links": Broken(_nothing, has_slow_links=True),  # between any two, at all times
    "station-gone": Broken(_station_gone),
    "router-killed": Broken(_router_killed),
    "cut": Broken(_cut),  # of one link, 5 s
    "isolated": Broken(_isolated),  # one host from all others, 5 s
    "agent-killed": Broken(_agent_killed, "bravo"),
    "supervisor-stopped": Broken(_supervisor_stopped),  # of one host, 8 s, as if it got no processor
    "host-lost": Broken(_host_lost, "charlie"),
}


def fly(scenario: str, config_path: Path, folder: Path, *, late_s: float, lost_01: float) -> dict[str, object]:
    """Fly once and return what came of it; `late_s` and `lost_01` are of slow links."""
    folder.mkdir(parents=True)
    path = folder / config_path.name
    shutil.copy(config_path, path)
    subprocess.run([sys.executable, "-m", "swarmctl", "keys", "init", str(path)], check=True, stdout=subprocess.DEVNULL)
    config = load(path)
    ips = {host.name: str(ip_of(host.address)) for host in config.hosts}
    ips[STATION] = str(max(map(ip_of, (host.address for host in config.hosts))) + 1)
    lossy = LossySwitch(len(ips), late_s, lost_01) if SCENARIOS[scenario].has_slow_links else None
    with Network(prefix=f"sw{os.getpid()}-", ips=ips, lossy=lossy) as network:
        flight = Flight(config=config, network=network, folder=folder)
        for host in config.hosts:
            agents = ",".join(map(str, host.agents))
            flight.start(host.name, "host", "--config", str(path), "--agents", agents)
        flight.start(STATION, "station", "--config", str(path), "--no-view")
        tracked = flight.until(lambda: all(flight.has_shown(host, "TRACK") for host in config.hosts), START_S)
        time.sleep(INTO_MISSION_S)
        broken_s = time.monotonic()
        if tracked:
            SCENARIOS[scenario].act(flight)
        hosts = [host.name for host in config.hosts]
        flight.until(lambda: all(flight.processes[name].poll() is not None for name in hosts), FLIGHT_S)
        ended_s = time.monotonic() - broken_s
        flight.until(lambda: flight.processes[STATION].poll() is not None, 15.0)
        codes = {name: process.poll() for name, process in flight.processes.items()}
    separation_m, touched = _least_separation_m(folder, hosts)
    asked = [name for name in hosts if name != SCENARIOS[scenario].excused]
    return {
        "scenario": scenario,
        "tracked": tracked,
        "exit_codes": codes,
        "completed": tracked and all(codes[name] == 0 for name in asked),
        "least_separation_m": separation_m,
        "pair": touched,
        "ended_after_s": round(ended_s, 1),
        "late_01": _late_01(folder, hosts),
    }


def _late_01(folder: Path, hosts: Sequence[str]) -> float:
    """Return the share of ticks that missed their deadline, on the hosts that have written a summary."""
    summaries = (folder / host / "summary.json" for host in hosts)
    timings = [json.loads(path.read_text(encoding="utf-8"))["timing"] for path in summaries if path.exists()]
    late, due = (sum(int(timing[key]) for timing in timings) for key in ("late_ticks", "due_ticks"))
    return round(late / max(1, due), 5)


def _least_separation_m(folder: Path, hosts: Sequence[str]) -> tuple[float, list[int]]:
    """Return the least distance of two armed vehicles by true states, and which they were."""
    tracks = {}
    for host in hosts:
        packed = folder / host / PACKED_TRUTH
        rows = read_parquet(packed, TRUTH_COLUMNS) if packed.exists() else read_rows(folder / host / TRUTH, TRUTH_DTYPE)
        for vehicle in np.unique(rows["vehicle"]):
            own = rows[(rows["vehicle"] == vehicle) & (rows["armed"] != 0)]
            if len(own):
                tracks[int(vehicle)] = own
    least_m, pair = np.inf, [-1, -1]
    for (i, a), (j, b) in itertools.combinations(tracks.items(), 2):
        t_us = np.arange(max(a["t_us"][0], b["t_us"][0]), min(a["t_us"][-1], b["t_us"][-1]), _GRID_US)
        apart_ned_m = np.array(
            [
                np.interp(t_us, a["t_us"], a["pos_ned_m"][:, k]) - np.interp(t_us, b["t_us"], b["pos_ned_m"][:, k])
                for k in range(3)
            ]
        )
        distance_m = float(np.linalg.norm(apart_ned_m, axis=0).min(initial=np.inf))
        if distance_m < least_m:
            least_m, pair = distance_m, [i, j]
    return round(least_m, 3), pair


def _command_line(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace")
    return ""


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    """Fly what is requested and print a line each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--config", type=Path, default=CONFIG, help="configuration with [[hosts]]")
    parser.add_argument("--only", default=",".join(SCENARIOS), help=f"of {', '.join(SCENARIOS)}")
    parser.add_argument("--runs", type=int, default=1, help="flights of each")
    parser.add_argument("--out", type=Path, required=True, help="new folder for runs and results.jsonl")
    parser.add_argument("--late-s", type=float, default=0.1, help="delay of slow links")
    parser.add_argument("--lost-01", type=float, default=0.1, help="share of frames that slow links lose")
    options = parser.parse_args()
    for run, scenario in itertools.product(range(options.runs), options.only.split(",")):
        folder = options.out.resolve() / f"{scenario}-{run}"
        result = fly(scenario, options.config, folder, late_s=options.late_s, lost_01=options.lost_01)
        line = json.dumps(result)
        print(line, flush=True)
        with (options.out / "results.jsonl").open("a", encoding="utf-8") as file:
            file.write(line + "\n")


if __name__ == "__main__":
    main()
