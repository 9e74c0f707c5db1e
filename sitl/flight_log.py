"""What one agent of a lockstep flight records, and the files of a run folder that it becomes."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.bus import agent_name
from swarmctl.core.clock import Clock
from swarmctl.core.recorded.records import TICK_DTYPE, plan_rows
from swarmctl.core.types import Plan
from swarmctl.telemetry.recording.file_names import events_file, frames_file, plans_file, received_file, ticks_file


@dataclass(kw_only=True)
class FlightLog:
    """Records of one agent, in memory and, if there is one, in a run folder."""

    directory: Path | None
    agent: int
    clock: Clock  # the agent's own
    rows: list[NDArray[np.void]] = field(default_factory=list)
    plans: list[bytes] = field(default_factory=list)  # predicted paths, only for a run folder
    received_rows: list[bytes] = field(default_factory=list)  # likewise
    events: list[dict[str, Any]] = field(default_factory=list)
    _tlog: BinaryIO | None = None

    def __post_init__(self) -> None:
        if self.directory is not None:
            self._tlog = (self.directory / frames_file(self.agent)).open("wb")

    def tick(self, row: NDArray[np.void], flown: Plan | None) -> None:
        self.rows.append(row)
        if self.directory is not None:
            self.plans.append(plan_rows(row, flown).tobytes())

    def received(self, rows: bytes) -> None:
        if self.directory is not None:
            self.received_rows.append(rows)

    def event(self, name: str, t_us: int, utc_us: int, **fields: Any) -> None:
        source = agent_name(self.agent)
        self.events.append({"utc_us": utc_us, "t_us": t_us, "source": source, "event": name, **fields})

    def frame(self, frame: bytes) -> None:
        if self._tlog is not None:
            with suppress(OSError):  # a full disk loses frames, never the flight
                self._tlog.write(struct.pack(">Q", self.clock.utc_us()) + frame)

    @property
    def ticks(self) -> NDArray[np.void]:
        """All ticks, (T,) of `TICK_DTYPE`."""
        return np.concatenate(self.rows) if self.rows else np.zeros(0, TICK_DTYPE)

    def close(self) -> None:
        """Write the files that a live agent writes.

        Raises:
            OSError: the disk refuses.
        """
        if self.directory is None or self._tlog is None:
            return
        with suppress(OSError):
            self._tlog.close()
        (self.directory / ticks_file(self.agent)).write_bytes(self.ticks.tobytes())
        (self.directory / plans_file(self.agent)).write_bytes(b"".join(self.plans))
        (self.directory / received_file(self.agent)).write_bytes(b"".join(self.received_rows))
        write_events(self.directory / events_file(agent_name(self.agent)), self.events)


def write_events(path: Path, events: Sequence[dict[str, Any]]) -> None:
    """Write one JSON object per line, as live processes log them."""
    path.write_bytes(b"".join(msgspec.json.encode(event) + b"\n" for event in events))
