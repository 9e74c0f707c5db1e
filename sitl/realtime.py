"""Flies a `SitlWorld` against the wall clock: absolute deadlines, bounded catch-up, a truth file, a clean end.

Short of CPU, the loop first catches up step by step. After a stall longer than `STALL_US` it gives the missed steps up:
vehicles stand still for that time while their clocks go on, so that clients keep a constant clock offset. Simulated
time may run faster than the wall clock; with a gate it waits for its clients.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sitl.fault_socket import ControlSocket
from sitl.world import SitlWorld
from swarmctl.core.recorded.records import TRUTH_DTYPE
from swarmctl.errors import ConfigError, StartError
from swarmctl.mavlink.transport import bind_udp
from swarmctl.process_lifetime import StopRequest
from swarmctl.telemetry.recording.recorder import RowFile
from swarmctl.wall_clock import monotonic_us

HOST = "127.0.0.1"
STALL_US = 200_000
TRUTH_US = 20_000
FLUSH_US = 100_000  # of true states that a killed simulator has not written
MAX_PORT = 65535
CONTROL_US = 100_000
GATE_US = 20_000
GATE_PATIENCE_US = 1_000_000
_GATE_POLL_S = 1e-4


@dataclass(kw_only=True)
class LoopStatistics:
    """Timing counters of the loop."""

    steps: int = 0
    late: int = 0  # steps that began more than one step after their deadline
    stalls: int = 0
    lost_us: int = 0  # simulated motion lost in stalls


class TruthFile:
    """Appends raw `TRUTH_DTYPE` rows at 50 Hz, on disk within a second.

    Attributes:
        lost: rows that the disk has not taken.
    """

    def __init__(self, path: Path) -> None:
        try:
            path.open("ab").close()
        except OSError as error:
            raise ConfigError("sitl", [f"truth = {path}: {error.strerror}; allowed: a writable file"]) from error
        self._file = RowFile(path, TRUTH_DTYPE.itemsize)
        self._rows: list[bytes] = []
        self._next_us = self._flush_us = 0

    @property
    def lost(self) -> int:
        return self._file.lost

    def record(self, world: SitlWorld, now_us: int) -> None:
        """Append one row per vehicle when due; a full disk costs rows until there is room again, never the flight."""
        if now_us < self._next_us:
            return
        self._next_us = now_us - now_us % TRUTH_US + TRUTH_US
        self._rows.extend(row.tobytes() for row in world.truth_rows())
        if now_us >= self._flush_us:
            self._flush_us = now_us + FLUSH_US
            self._flush()

    def close(self) -> str:
        """Flush and close; return a complaint, or ""."""
        self._flush()
        self._file.close()
        return f"truth file: {self.lost} rows could not be written" if self.lost else ""

    def _flush(self) -> None:
        rows, self._rows = self._rows, []
        if rows:
            self._file.append(rows)


class Gate:
    """Holds the physics every `GATE_US` until each vehicle in OFFBOARD has received a new setpoint.

    A vehicle whose client is silent for a second of wall time is not waited for until the client sends again, so that
    the autopilot can detect the loss.
    """

    def __init__(self, world: SitlWorld) -> None:
        self._world = world
        self._seen = world.setpoint_counts()
        self._given_up: set[int] = set()

    def wait(self, stop: StopRequest, now_us: int) -> None:
        """Wait until all clients have sent."""
        deadline_us = monotonic_us() + GATE_PATIENCE_US
        while not stop.is_set():
            counts = self._world.setpoint_counts()
            fresh = {i for i, count in enumerate(counts) if count > self._seen[i]}
            self._given_up -= fresh
            missing = self._world.offboard_vehicles() - fresh - self._given_up
            if missing and monotonic_us() >= deadline_us:
                self._given_up |= missing
                missing = set()
            if not missing:
                self._seen = counts
                return
            time.sleep(_GATE_POLL_S)
            self._world.receive(now_us)


def fly(
    world: SitlWorld,
    stop: StopRequest,
    truth: TruthFile | None,
    *,
    speed: float = 1.0,
    control: ControlSocket | None = None,
    gate: Gate | None = None,
) -> LoopStatistics:
    """Step the world at its physics rate until `stop`.

    Args:
        world: the simulation.
        stop: ends the flight.
        truth: file for true states, or None.
        speed: simulated over wall time; an upper limit with a gate.
        control: source of fault requests, polled ten times a second.
        gate: makes the physics wait for its clients; this time is lost on both clocks.
    """
    statistics = LoopStatistics()
    period_us = 1e6 / world.params.physics_hz
    gate_every, control_every = round(GATE_US / period_us), max(1, round(CONTROL_US * speed / period_us))
    start_us = sim_start_us = monotonic_us()
    count = 0
    while not stop.is_set():
        sim_us = sim_start_us + round(count * period_us)
        behind_us = monotonic_us() - (start_us + round(count * period_us / speed))
        if behind_us < 0:
            time.sleep(-behind_us * 1e-6)
            continue
        if behind_us > STALL_US:
            statistics.stalls += 1
            statistics.lost_us += round(behind_us * speed)
            start_us += behind_us
            sim_start_us += round(behind_us * speed)
            sim_us += round(behind_us * speed)
        elif behind_us * speed > period_us:
            statistics.late += 1
        if gate is not None and count % gate_every == 0:
            waited_us = -monotonic_us()
            gate.wait(stop, sim_us)
            start_us += waited_us + monotonic_us()
        if control is not None and count % control_every == 0:
            control.poll(world)
        world.step(sim_us)
        if truth is not None:
            truth.record(world, sim_us)
        count += 1
    statistics.steps = count
    return statistics


def bind_range(first: int, count: int) -> tuple[list[socket.socket], int]:
    """Bind `count` sockets on consecutive loopback ports, from `first` or the next free range; also return the shift.

    Raises:
        StartError: no range is free up to port 65535.
    """
    for shift in range(MAX_PORT - first - count + 2):
        sockets = _bind_all(first + shift, count)
        if sockets:
            return sockets, shift
    raise StartError(f"no {count} consecutive free UDP ports from {first} to {MAX_PORT}; choose a lower --local-port")


def _bind_all(first: int, count: int) -> list[socket.socket]:
    sockets: list[socket.socket] = []
    for port in range(first, first + count):
        try:
            sockets.append(bind_udp(HOST, port))
        except StartError:
            for sock in sockets:
                sock.close()
            return []
    return sockets


def remote_ports(first: int, shift: int, count: int, fixed: Sequence[int]) -> list[int]:
    """Return the port to which each vehicle sends before it has received anything."""
    return list(fixed) if fixed else [first + shift + i for i in range(count)]
