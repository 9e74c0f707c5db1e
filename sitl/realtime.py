"""Flies a `SitlWorld` against the wall clock: absolute deadlines, bounded catch-up, a truth file, a clean end.

Short of CPU it first catches up step by step; after a stall longer than `STALL_US` the missed steps are given up, so
that vehicles stand still for that time while their clocks go on, and clients keep a constant clock offset.
"""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import BinaryIO

from sitl.world import SitlWorld
from swarmctl.errors import ConfigError, StartError
from swarmctl.links.transport import bind_udp

HOST = "127.0.0.1"
STALL_US = 200_000
TRUTH_US = 20_000
FLUSH_US = 500_000
MAX_PORT = 65535


@dataclass
class Tally:
    """What the loop has done so far."""

    steps: int = 0
    late: int = 0  # began more than one step after their deadline
    stalls: int = 0
    lost_us: int = 0  # of simulated motion, in stalls


class TruthFile:
    """Raw `TRUTH_DTYPE` rows appended at 50 Hz, on disk within a second."""

    def __init__(self, path: Path) -> None:
        try:
            self._file: BinaryIO = path.open("ab", buffering=1 << 16)
        except OSError as error:
            raise ConfigError("sitl", [f"truth = {path}: {error.strerror}; allowed: a writable file"]) from error
        self._next_us = self._flush_us = 0
        self._broken: OSError | None = None

    def record(self, world: SitlWorld, now_us: int) -> None:
        """Append one row a vehicle when due; a full disk ends the file, not the flight."""
        if now_us < self._next_us or self._broken is not None:
            return
        self._next_us = now_us - now_us % TRUTH_US + TRUTH_US
        try:
            self._file.write(world.truth_rows().tobytes())
            if now_us >= self._flush_us:
                self._flush_us = now_us + FLUSH_US
                self._file.flush()
        except OSError as error:
            self._broken = error

    def close(self) -> str:
        """Flush and close; a complaint, or an empty string."""
        try:
            self._file.close()
        except OSError as error:
            self._broken = self._broken or error
        return f"truth file: {self._broken}" if self._broken else ""


class StopRequest:
    """Set by SIGINT or SIGTERM."""

    def __init__(self) -> None:
        self.wanted = False

    def install(self) -> None:
        """Take both signals over for the rest of the process."""
        signal.signal(signal.SIGINT, self._on_signal)
        signal.signal(signal.SIGTERM, self._on_signal)

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self.wanted = True


def monotonic_us() -> int:
    """CLOCK_MONOTONIC [us], comparable between processes of this host."""
    return time.monotonic_ns() // 1000


def fly(world: SitlWorld, stop: StopRequest, truth: TruthFile | None) -> Tally:
    """Step the world at its physics rate until `stop`."""
    tally = Tally()
    period_us = 1e6 / world.params.physics_hz
    start_us, count = monotonic_us(), 0
    while not stop.wanted:
        due_us = start_us + round(count * period_us)
        behind_us = monotonic_us() - due_us
        if behind_us < 0:
            time.sleep(-behind_us * 1e-6)
            continue
        if behind_us > STALL_US:
            tally.stalls += 1
            tally.lost_us += behind_us
            start_us += behind_us
            due_us += behind_us
        elif behind_us > period_us:
            tally.late += 1
        world.step(due_us)
        if truth is not None:
            truth.record(world, due_us)
        count += 1
    tally.steps = count
    return tally


def bind_range(first: int, count: int) -> tuple[list[socket.socket], int]:
    """`count` sockets on consecutive loopback ports, from `first` or the next range that is free; and the shift.

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
    """Where each vehicle talks before anybody has talked to it."""
    return list(fixed) if fixed else [first + shift + i for i in range(count)]
