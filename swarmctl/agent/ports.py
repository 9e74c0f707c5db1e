"""What connects one agent to the world: its vehicle, its peers, time and a recorder.

Real time and lockstep differ only in what they pass here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.traffic import CountedBus
from swarmctl.core.clock import TickClock
from swarmctl.core.types import Plan
from swarmctl.mavlink.commands import CommandPort
from swarmctl.mavlink.vehicle.autopilot import Autopilot


class TickSink(Protocol):
    """Destination of ticks and events; its methods never block."""

    def tick(self, row: NDArray[np.void], flown: Plan | None) -> None:
        """Take the row of a tick, a (1,) array of `core.recorded.records.TICK_DTYPE`."""

    def received(self, rows: bytes) -> None:
        """Take what a tick has received, rows of `core.recorded.received.RECEIVED_DTYPE`."""

    def event(self, name: str, t_us: int, utc_us: int, **fields: Any) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Ports:
    """The connections of one agent."""

    autopilot: Autopilot  # the vehicle's hot path: states in, setpoints out
    commands: CommandPort  # executes the slow path: arming, modes, parameters
    bus: CountedBus  # to peers and operator
    clock: TickClock  # monotonic time and UTC [us]
    sink: TickSink  # records ticks and events
    stopwatch_ns: Callable[[], int]  # measures the tick and never influences it
    rehearses: bool = True  # plans on the ground as in the air; of use only where time passes while an agent computes

    def note(self, name: str, **fields: Any) -> None:
        """Record an event of this moment."""
        self.sink.event(name, self.clock.now_us(), self.clock.utc_us(), **fields)

    def utc_of_us(self, t_us: int) -> int:
        """Convert monotonic time of this process to UTC [us]."""
        return self.clock.utc_of_us(t_us)
