"""The agent's recorder: the tick queues bytes, and a background thread writes them.

It never blocks the tick and never raises into it. Rows that don't fit the queue, or that the disk refuses, are dropped
and counted. Files grow by whole rows only, so a killed agent leaves readable files that lack the last seconds at most.
"""

from __future__ import annotations

import bisect
import contextlib
import itertools
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.bus import agent_name
from swarmctl.core.json_safe import to_json
from swarmctl.core.recorded.received import RECEIVED_DTYPE
from swarmctl.core.recorded.records import PLAN_DTYPE, TICK_DTYPE, plan_rows
from swarmctl.core.types import Plan
from swarmctl.files import hold
from swarmctl.telemetry.recording.file_names import events_file, frames_file, plans_file, received_file, ticks_file

_FLUSH_TIMEOUT_S = 0.25
_QUEUE = 16384  # items; about 20 s of ticks and frames, 4 MB
_REOPEN_S = 1.0  # time between attempts to open a file
_TLOG_STAMP = struct.Struct(">Q")
_TICKS, _FRAMES, _EVENTS, _PLANS, _RECEIVED = range(5)  # places of the files


class Recorder:
    """Writes ticks, predicted paths, MAVLink frames, events and what ticks received to five files of a run folder.

    `agent-<i>.ticks` holds raw `TICK_DTYPE` rows, `agent-<i>.plans` raw `PLAN_DTYPE` rows, `agent-<i>.tlog` frames
    after their UTC [us] (as ground stations write them), `agent-<i>.events.jsonl` one JSON object on each line,
    `agent-<i>.received` raw `RECEIVED_DTYPE` rows.
    """

    def __init__(self, directory: Path, agent: int) -> None:
        self._source = agent_name(agent)
        self._files = (  # in the order of their places
            RowFile(directory / ticks_file(agent), TICK_DTYPE.itemsize),
            RowFile(directory / frames_file(agent)),
            RowFile(directory / events_file(self._source)),
            RowFile(directory / plans_file(agent), PLAN_DTYPE.itemsize),
            RowFile(directory / received_file(agent), RECEIVED_DTYPE.itemsize),
        )
        self._queue: deque[tuple[int, bytes]] = deque()  # place of the file, and the row
        self._refused = 0  # written by the tick's thread
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"recorder-{agent}", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Number of rows dropped so far; a predicted path counts as one."""
        return self._refused + sum(file.lost for file in self._files)

    def tick(self, row: NDArray[np.void], flown: Plan | None) -> None:
        """Record one tick, a (1,) array of `TICK_DTYPE`, and the plan that it flew."""
        self._put(_TICKS, row.tobytes())
        points = plan_rows(row, flown)
        if len(points):
            self._put(_PLANS, points.tobytes())

    def received(self, rows: bytes) -> None:
        """Record what one tick has received, rows of `RECEIVED_DTYPE`."""
        if rows:
            self._put(_RECEIVED, rows)

    def frame(self, utc_us: int, frame: bytes) -> None:
        """Record one MAVLink frame, sent or received at `utc_us`."""
        self._put(_FRAMES, _TLOG_STAMP.pack(utc_us) + frame)

    def event(self, name: str, t_us: int, utc_us: int, **fields: Any) -> None:
        """Record one event with its fields; events are rare, unlike ticks."""
        self.put_event(event_line(self._source, name, t_us, utc_us, fields))

    def put_event(self, line: bytes) -> None:
        """Record one event that is a JSON object already, without line breaks."""
        self._put(_EVENTS, line + b"\n")

    def close(self, timeout_s: float = 2.0) -> None:
        """Write what is queued; after `timeout_s` of a hanging disk the remaining rows count as lost."""
        self._stop.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._refused += len(self._queue)

    def _put(self, place: int, row: bytes) -> None:
        if len(self._queue) >= _QUEUE or self._stop.is_set():
            self._refused += 1
            return
        self._queue.append((place, row))

    def _run(self) -> None:
        while not self._stop.wait(_FLUSH_TIMEOUT_S):
            self._drain()
        self._drain()
        for file in self._files:
            file.close()

    def _drain(self) -> None:
        batches: tuple[list[bytes], ...] = tuple([] for _ in self._files)
        for _ in range(len(self._queue)):
            place, row = self._queue.popleft()
            batches[place].append(row)
        for file, rows in zip(self._files, batches, strict=True):
            if rows:
                file.append(rows)


def event_line(source: str, name: str, t_us: int, utc_us: int, fields: Mapping[str, Any]) -> bytes:
    """Return an event as the JSON object that is recorded of it."""
    return to_json({"utc_us": utc_us, "t_us": t_us, "source": source, "event": name, **fields}).encode()


class RowFile:
    """A file that grows by whole rows only and counts the rows that could not be written; it tries again later."""

    def __init__(self, path: Path, row_bytes: int = 1) -> None:
        self.lost = 0
        self._path = path
        self._row_bytes = row_bytes
        self._fd = -1
        self._good_size = 0
        self._next_try_s = 0.0

    def append(self, rows: list[bytes]) -> None:
        if not self._open():
            self.lost += len(rows)
            return
        data = memoryview(b"".join(rows))
        done = 0
        try:
            while done < len(data):
                done += os.write(self._fd, data[done:])
            self._good_size += done
        except OSError:
            self._keep_whole(rows, done)

    def _keep_whole(self, rows: list[bytes], done: int) -> None:
        """Truncate after a write that stopped `done` bytes into `rows`: a partial row would shift every later one."""
        ends = list(itertools.accumulate(map(len, rows)))
        kept = bisect.bisect_right(ends, done)
        self.lost += len(rows) - kept
        self._good_size += ends[kept - 1] if kept else 0
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, self._good_size)

    def close(self) -> None:
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                os.close(self._fd)
            self._fd = -1

    def _open(self) -> bool:
        now_s = time.monotonic()
        if self._fd < 0 and now_s >= self._next_try_s:
            self._next_try_s = now_s + _REOPEN_S
            try:
                self._fd = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
                hold(self._fd)  # a report must not pack and remove what is still written
                size = os.fstat(self._fd).st_size
                self._good_size = size - size % self._row_bytes
                if self._good_size < size:
                    os.ftruncate(self._fd, self._good_size)  # remove the partial row of a killed predecessor
            except OSError:
                self.close()
        return self._fd >= 0
