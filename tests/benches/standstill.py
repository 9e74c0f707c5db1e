"""Whether the machine stood still in a flight of several agents: none of them, each a process, ticked for a while.

A virtual machine that is given no processor takes that time from simulated vehicles, and not from our clock: they are
late by it from then on, as no real vehicle ever is.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from swarmctl.core.types import Phase

STILL_S = 0.04  # two ticks of everybody


def common_gap_s(ticks_us: Sequence[NDArray[np.int64]]) -> float:
    """Return the longest time in which none of the agents began a tick; each has its instants (T,) in order."""
    together = np.unique(np.concatenate(ticks_us))
    inside = (together >= max(t[0] for t in ticks_us)) & (together <= min(t[-1] for t in ticks_us))
    return float(np.diff(together[inside]).max(initial=0)) * 1e-6


def stood_still_s(run_dir: Path, agents: int) -> float:
    """Return the longest common gap in the mission of a recorded run."""
    ticks_us = []
    for agent in range(agents):
        table = pq.read_table(run_dir / f"agent-{agent}.parquet", columns=["t_us", "phase"])
        t_us, phase = (table.column(name).to_numpy() for name in ("t_us", "phase"))
        ticks_us.append(t_us[phase == Phase.TRACK])
    return common_gap_s(ticks_us)
