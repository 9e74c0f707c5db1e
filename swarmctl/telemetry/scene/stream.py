"""Sends columns of values to one recording stream on the timeline of the flight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmctl.core.types import Array
from swarmctl.telemetry.scene.layout import TIMELINE

Times = NDArray[np.int64]  # (T,) [us] on the timeline, increasing


class Stream:
    """Wraps a recording stream; each call is one chunk, which costs 3 kB before a recording is packed."""

    def __init__(self, rec: Any) -> None:
        self._rec = rec

    def static(self, path: str, archetype: Any) -> None:
        """Log what does not change with time."""
        self._rec.log(path, archetype, static=True)

    def now(self, path: str, t_us: int, archetype: Any) -> None:
        """Log one archetype at one time."""
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_us, "us"))
        self._rec.log(path, archetype)
        self._rec.reset_time()

    def columns(self, path: str, t_us: Times, columns: Any) -> None:
        """Send one row of `columns` for each time; nothing without times."""
        if len(t_us):
            when = rr.TimeColumn(
                TIMELINE, duration=np.asarray(t_us).astype("timedelta64[us]").astype("timedelta64[ns]")
            )
            self._rec.send_columns(path, [when], columns)

    def scalars(self, path: str, t_us: Times, values: NDArray[Any]) -> None:
        """Send values (T,), or (T, k) of k curves; what is not finite interrupts a curve."""
        finite = np.asarray(values, np.float64)
        self.columns(path, t_us, rr.Scalars.columns(scalars=np.where(np.isfinite(finite), finite, np.nan)))

    def strips(self, path: str, t_us: Times, strips: Sequence[Array]) -> None:
        """Send one line (M, 3), NED, for each time."""
        self.columns(path, t_us, rr.LineStrips3D.columns(strips=list(strips)))

    def states(self, path: str, t_us: Times, names: Sequence[str]) -> None:
        """Send states that begin at these times."""
        self.columns(path, t_us, rr.StateChange.columns(state=list(names)))

    def lines(self, source: str, t_us: Times, lines: Sequence[tuple[str, str]]) -> None:
        """Send lines of the event view, each with its level."""
        texts, levels = [f"{source.replace('-', ' ')}: {text}" for _, text in lines], [level for level, _ in lines]
        self.columns(f"events/{source}", t_us, rr.TextLog.columns(text=texts, level=levels))


def pieces(points_ned_m: Array, before_ned_m: Array | None, ticks: int) -> tuple[list[int], list[Array]]:
    """Cut a line into pieces of some ticks, so that a recording that is played grows by them.

    Args:
        points_ned_m: the line (T, 3).
        before_ned_m: end (3,) of what was drawn before it, where the first piece begins; None if nothing was.
        ticks: points from one end of a piece to the next.

    Returns:
        the indices of the points at which pieces end, the last one among them, and the pieces, (M, 3) each.
    """
    ends = [*range((len(points_ned_m) - 1) % ticks, len(points_ned_m), ticks)]
    if before_ned_m is None:
        starts, line, shift = [0, *ends[:-1]], points_ned_m, 0
    else:
        starts, line, shift = [-1, *ends[:-1]], np.vstack([before_ned_m, points_ned_m]), 1
    cut = {end: line[start + shift : end + shift + 1] for start, end in zip(starts, ends, strict=True) if end > start}
    return list(cut), list(cut.values())
