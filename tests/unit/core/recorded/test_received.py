"""Rows of what a tick has received."""

from __future__ import annotations

import numpy as np

from swarmctl.core.recorded.received import RECEIVED_DTYPE, ReceivedKind, frame_rows, path_row, status_row
from swarmctl.core.types import PredictedPath


def test_rows_tell_what_was_received() -> None:
    path = PredictedPath(
        agent=2, boot_id=9, seq=41, t0_utc_us=1_000, dt_us=100_000, margin_m=0.25, pos_ned_m=np.zeros((3, 3))
    )
    rows = b"".join(
        [
            *frame_rows(20_000, 1, [15_000, 15_000, 19_000]),
            path_row(20_000, path),
            status_row(20_000, 2, 42, 900, keeps_up=True),
        ]
    )
    found = np.frombuffer(rows, RECEIVED_DTYPE)
    kinds = [ReceivedKind.FRAMES, ReceivedKind.FRAMES, ReceivedKind.PATH, ReceivedKind.STATUS]
    assert found["kind"].tolist() == kinds
    assert found["sender"].tolist() == [1, 1, 2, 2]
    assert found["seq"].tolist() == [2, 1, 41, 42]
    assert found["stamp_us"].tolist() == [15_000, 19_000, 1_000, 900]
    assert np.nan_to_num(found["margin_m"], nan=-1.0).tolist() == [-1.0, -1.0, 0.25, -1.0]
    assert found["keeps_up"].tolist() == [0, 0, 0, 1]


def test_a_peer_that_numbers_statuses_as_it_likes_ends_no_tick() -> None:
    (row,) = np.frombuffer(status_row(0, 255, 2**62, 2**62, keeps_up=False), RECEIVED_DTYPE)
    assert row["stamp_us"] == 2**62
