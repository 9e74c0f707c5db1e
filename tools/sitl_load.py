"""Load of one simulator process: late physics steps, state-to-wire latency and CPU, with real UDP clients.

The simulator is pinned to one core and its clients to the others. Every client streams a heartbeat and 50 setpoints a
second to its vehicle, in OFFBOARD. Latency is the time from the deadline of the physics step a message is stamped with
to the kernel's arrival stamp of its datagram, over every ODOMETRY message (microsecond stamps, sent on the steps on
which most else is due, too). Linux only.

    python tools/sitl_load.py --vehicles 3,32 --seconds 20 --repeats 3 --json load.json
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from pymavlink.dialects.v20 import development as mav

from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.wall_clock import monotonic_us, utc_us

HOST = "127.0.0.1"
LOCAL_PORT = 24580
WARM_UP_S = 4.0
SO_TIMESTAMPNS = 35
TIMESPEC = struct.Struct("@qq")
BUFFER_BYTES = 1 << 22
SETPOINT_US = 20_000
HOVER_01 = 0.492
LIMITS = {32: {"missed_percent": 1.0, "latency_p99_ms": 5.0}, 3: {"cpu_percent": 15.0}}


@dataclass(kw_only=True)
class Measured:
    """Results of one run."""

    vehicles: int
    steps: int
    missed_percent: float  # of the physics steps, begun more than a step after their deadline
    stalls: int
    cpu_percent: float  # of one core
    latency_p50_ms: float
    latency_p99_ms: float
    latency_max_ms: float
    datagrams_s: float
    messages_s: float
    kilobytes_s: float
    offboard: int  # vehicles flown by their clients at the end


class Client:
    """The client of one vehicle: receives everything, streams setpoints."""

    def __init__(self, number: int, port: int) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        self.sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.sock.bind((HOST, 0))
        self.sock.setblocking(False)
        self._codec = Codec(255, 190)
        self._target = number + 1
        self._to = (HOST, port)
        self.datagrams = self.messages = self.octets = 0
        self.arrivals: list[tuple[int, int]] = []  # ODOMETRY: stamp since boot [us], arrival CLOCK_MONOTONIC [us]
        self.main_mode = 0

    def send(self, message: Any) -> None:
        """Send one message to the vehicle."""
        self.sock.sendto(self._codec.encode(message), self._to)

    def heartbeat(self) -> None:
        self.send(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))

    def setpoint(self) -> None:
        self.send(mav.MAVLink_set_attitude_target_message(0, self._target, 1, 7, [1, 0, 0, 0], 0, 0, 0, HOVER_01))

    def command(self, command: int, *params: float) -> None:
        filled = (*params, *(0.0,) * (7 - len(params)))
        self.send(mav.MAVLink_command_long_message(self._target, 1, command, 0, *filled))

    def drain(self, real_minus_monotonic_us: int) -> None:
        """Receive everything that has arrived."""
        while True:
            try:
                data, ancillary, _, _ = self.sock.recvmsg(2048, 64)
            except BlockingIOError:
                return
            self.datagrams += 1
            self.octets += len(data)
            for frame in frames(data):
                self.messages += 1
                kind = message_id(frame)
                if kind == mav.MAVLINK_MSG_ID_ODOMETRY:
                    seconds, nanoseconds = TIMESPEC.unpack(ancillary[0][2])
                    arrived_us = seconds * 1_000_000 + nanoseconds // 1000 - real_minus_monotonic_us
                    self.arrivals.append((int.from_bytes(frame[10:18], "little"), arrived_us))
                elif kind == mav.MAVLINK_MSG_ID_HEARTBEAT:
                    self.main_mode = frame[12]

    def forget(self) -> None:
        """Reset the counters."""
        self.datagrams = self.messages = self.octets = 0
        self.arrivals.clear()


def fly(clients: Sequence[Client], seconds: float) -> None:
    """Stream and receive for a while."""
    poller = select.epoll()
    by_fd = {client.sock.fileno(): client for client in clients}
    for fd in by_fd:
        poller.register(fd, select.EPOLLIN)
    now_us = monotonic_us()
    end_us = now_us + round(seconds * 1e6)
    spread_us = SETPOINT_US // len(clients)
    due = [now_us + i * spread_us for i in range(len(clients))]
    beat_us = [now_us + i * spread_us for i in range(len(clients))]
    while now_us < end_us:
        poller.poll(max(0.0, (min(due) - now_us) * 1e-6))
        now_us = monotonic_us()
        offset_us = utc_us() - now_us
        for i, client in enumerate(clients):
            client.drain(offset_us)
            if now_us >= due[i]:
                due[i] += SETPOINT_US * (1 + (now_us - due[i]) // SETPOINT_US)
                client.setpoint()
            if now_us >= beat_us[i]:
                beat_us[i] += 1_000_000
                client.heartbeat()
        time.sleep(0.0005)  # one wake-up for all messages of a step
    poller.close()


def measure(vehicles: int, seconds: float, core: int, arguments: Sequence[str]) -> Measured:
    """Run one simulator and return its results."""
    with tempfile.TemporaryDirectory(prefix="load-") as folder:
        stats = Path(folder) / "stats.json"
        command = [sys.executable, "-m", "sitl", "--vehicles", f"{vehicles}", "--local-port", f"{LOCAL_PORT}"]
        command += ["--preset", "x500", "--stats", f"{stats}", *arguments]
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
        )
        clients = [Client(i, port) for i, port in enumerate(_ports(process, vehicles))]
        try:
            _into_offboard(clients)
            watched = psutil.Process(process.pid)
            for client in clients:
                client.forget()
            before = watched.cpu_times()
            began_s = time.monotonic()
            fly(clients, seconds)
            wall_s = time.monotonic() - began_s
            after = watched.cpu_times()
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(10)
            for client in clients:
                client.sock.close()
        told = json.loads(stats.read_text(encoding="utf-8"))
    cpu_s = after.user + after.system - before.user - before.system
    return _summed(clients, told, cpu_s, wall_s)


def _ports(process: subprocess.Popen[str], vehicles: int) -> list[int]:
    """Return the ports that the simulator reports."""
    assert process.stdout is not None
    lines = (line for line in process.stdout if line.startswith("vehicle "))
    found = [int(line.partition("local=")[2].split()[0]) for _, line in zip(range(vehicles), lines, strict=False)]
    if len(found) < vehicles:
        raise SystemExit(f"sitl_load: the simulator ended with exit code {process.wait(10)}")
    return found


def _into_offboard(clients: Sequence[Client]) -> None:
    fly(clients, WARM_UP_S)
    for client in clients:
        client.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
    fly(clients, 0.2)
    for client in clients:
        client.command(mav.MAV_CMD_DO_SET_MODE, 1.0, 6.0)
    fly(clients, 1.5)


def _summed(clients: Sequence[Client], told: dict[str, Any], cpu_s: float, wall_s: float) -> Measured:
    arrivals = np.array([pair for client in clients for pair in client.arrivals])
    latency_ms = (arrivals[:, 1] - arrivals[:, 0] - told["boot_us"]) * 1e-3
    return Measured(
        vehicles=len(clients),
        steps=told["steps"],
        missed_percent=100.0 * told["late"] / told["steps"],
        stalls=told["stalls"],
        cpu_percent=100.0 * cpu_s / wall_s,
        latency_p50_ms=float(np.percentile(latency_ms, 50)),
        latency_p99_ms=float(np.percentile(latency_ms, 99)),
        latency_max_ms=float(latency_ms.max()),
        datagrams_s=sum(client.datagrams for client in clients) / wall_s,
        messages_s=sum(client.messages for client in clients) / wall_s,
        kilobytes_s=sum(client.octets for client in clients) / wall_s / 1e3,
        offboard=sum(client.main_mode == 6 for client in clients),
    )


def median(runs: Sequence[Measured]) -> dict[str, float]:
    """Return the median of every figure."""
    rows = [asdict(run) for run in runs]
    return {key: statistics.median(row[key] for row in rows) for key in rows[0]}


def misses(row: dict[str, float]) -> Iterator[str]:
    """Return the figures of a row that exceed their limit."""
    for key, limit in LIMITS.get(int(row["vehicles"]), {}).items():
        if row[key] > limit:
            yield f"{row['vehicles']:.0f} vehicles: {key} = {row[key]:.2f} > {limit}"


def _table(rows: Sequence[dict[str, float]]) -> Iterator[str]:
    columns = (
        ("vehicles", "vehicles", 0),
        ("late %", "missed_percent", 2),
        ("stalls", "stalls", 0),
        ("CPU %", "cpu_percent", 1),
        ("p50 ms", "latency_p50_ms", 2),
        ("p99 ms", "latency_p99_ms", 2),
        ("max ms", "latency_max_ms", 1),
        ("msg/s", "messages_s", 0),
        ("datagrams/s", "datagrams_s", 0),
        ("kB/s", "kilobytes_s", 0),
        ("offboard", "offboard", 0),
    )
    yield "  ".join(f"{title:>11}" for title, _, _ in columns)
    for row in rows:
        yield "  ".join(f"{row[key]:>11.{digits}f}" for _, key, digits in columns)


def main() -> int:
    """Measure, print and write; return 1 when a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", default="3,32", metavar="N,N,..")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--core", type=int, default=0, help="of the simulator; clients get the others")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("rest", nargs="*", help="further arguments of the simulator, after --")
    options = parser.parse_args()
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores - {options.core} or cores)
    medians, runs = [], []
    for vehicles in (int(part) for part in options.vehicles.split(",")):
        repeated = [measure(vehicles, options.seconds, options.core, options.rest) for _ in range(options.repeats)]
        runs += [asdict(run) for run in repeated]
        medians.append(median(repeated))
    print("\n".join(_table(medians)))
    missed = [miss for row in medians for miss in misses(row)]
    for miss in missed:
        print(f"missed: {miss}")
    if options.json:
        options.json.write_text(json.dumps({"medians": medians, "runs": runs, "missed": missed}, indent=2) + "\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
