"""What each tick has received, as rows of fixed size: when frames of the vehicle came, and which messages of peers.

What they say is recorded elsewhere: frames in the `.tlog`, peers' paths and phases with the peers' own ticks. A row
tells which tick had it, which depends on the microsecond and follows from no stamp.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Iterable
from itertools import groupby

from swarmctl.core.recorded.stored_column import StoredColumn, dtype_of
from swarmctl.core.types import PredictedPath


class ReceivedKind(enum.IntEnum):
    """What a row stands for."""

    FRAMES = 0  # of the vehicle, that arrived at once
    PATH = 1  # a predicted path of a peer, accepted
    STATUS = 2  # a status of a peer, accepted


RECEIVED_COLUMNS = (
    StoredColumn(name="t_us", dtype="<i8", unit="us", text="monotonic time of the tick that received it"),
    StoredColumn(name="kind", dtype="u1", text="frames of the vehicle, or a peer's message", names=ReceivedKind),
    StoredColumn(name="sender", dtype="<u2", text="number of the peer; of the agent itself for frames"),
    StoredColumn(
        name="seq",
        dtype="<u4",
        text="number in the message: of a status that of the peer's tick, of a path one less; of frames how many",
    ),
    StoredColumn(
        name="stamp_us",
        dtype="<i8",
        unit="us",
        text="UTC of a path's first point, by the own clock, or of a status; for frames monotonic time of arrival",
    ),
    StoredColumn(name="margin_m", dtype="<f4", unit="m", text="margin of a path, by the own clock; NaN for the others"),
    StoredColumn(name="keeps_up", dtype="u1", text="1: a status of a peer that keeps up with its deadlines"),
)
RECEIVED_DTYPE = dtype_of(RECEIVED_COLUMNS)
_ROW = struct.Struct("<qBHIqfB")
_U4 = 0xFFFFFFFF
_FRAMES, _PATH, _STATUS = map(int, ReceivedKind)


def frame_rows(t_us: int, agent: int, arrived_us: Iterable[int]) -> list[bytes]:
    """Return the rows of frames that a tick at `t_us` has received of its own vehicle, given when each arrived."""
    together = ((at_us, len(list(same))) for at_us, same in groupby(arrived_us))
    return [_ROW.pack(t_us, _FRAMES, agent, count, at_us, math.nan, 0) for at_us, count in together]


def path_row(t_us: int, path: PredictedPath) -> bytes:
    """Return the row of a path that a tick at `t_us` has accepted."""
    return _ROW.pack(t_us, _PATH, path.agent, path.seq, path.t0_utc_us, path.margin_m, 0)


def status_row(t_us: int, sender: int, seq: int, stamp_us: int, *, keeps_up: bool) -> bytes:
    """Return the row of a status that a tick at `t_us` has accepted; a peer may number it as it likes."""
    return _ROW.pack(t_us, _STATUS, sender, seq & _U4, stamp_us, math.nan, keeps_up)
