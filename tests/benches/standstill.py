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
    """Return the longest time in which none of the agents began a tick; each has its instants (T,) in order.

    Where one has none at all there is no time that they have in common.
    """
    if not ticks_us or not all(len(t_us) for t_us in ticks_us):
        return 0.0
    together = np.unique(np.concatenate(ticks_us))
    inside = (together >= max(t[0] for t in ticks_us)) & (together <= min(t[-1] for t in ticks_us))
    return float(np.diff(together[inside]).max(initial=0)) * 1e-6


def stood_still_s(run_dir: Path, agents: int) -> float:
    """Return the longest common gap in the mission of a run; 0 where not all agents have recorded one."""
    ticks_us, paths = [], [run_dir / f"agent-{agent}.parquet" for agent in range(agents)]
    for path in paths if all(path.exists() for path in paths) else ():
        table = pq.read_table(path, columns=["t_us", "phase"])
        t_us, phase = (table.column(name).to_numpy() for name in ("t_us", "phase"))
        ticks_us.append(t_us[phase == Phase.TRACK])
    return common_gap_s(ticks_us)
