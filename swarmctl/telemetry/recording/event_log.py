"""Events of one process as JSON lines in the run folder, stamped with both clocks."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swarmctl.wall_clock import monotonic_us, utc_us


class EventLog:
    """Appends events of one source to a file; a full disk loses events, never the flight."""

    def __init__(self, path: Path, source: str, utc_us: Callable[[], int] = utc_us) -> None:
        self._path, self._source, self._utc_us = path, source, utc_us

    def write(self, event: str, **fields: Any) -> None:
        """Append one row with both clocks."""
        stamp = {"utc_us": self._utc_us(), "t_us": monotonic_us(), "source": self._source, "event": event}
        line = json.dumps({**stamp, **fields}).encode() + b"\n"
        with contextlib.suppress(OSError), self._path.open("ab", buffering=0) as file:
            size = file.tell()
            if file.write(line) < len(line):  # the disk is full: the next event begins a line of its own
                file.truncate(size)
