"""Finds what the files of a run lack because a disk was full or slow: nothing can be judged by it. Pure.

That a process was killed or stopped is no loss: a simulator sends no states meanwhile, and an agent does not count
ticks. So true states are missing only where agents have received states of the simulator, or have ticked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import Array
from swarmctl.telemetry.evaluation.tracks import located_states_us

_AFTER_US = 500_000  # true states that a killed simulator has not written, and errors of clocks
_BEFORE_US = 100_000
_TOLERATED_01 = 0.01  # of the ticks in flight, as many as may be late by default: the others judge the flight as well
_LOST_US = 20_000  # between the times that are filled in for ticks which were not recorded


def unrecorded(
    ticks: Mapping[int, NDArray[np.void]],
    truth: NDArray[np.void],
    *,
    here: Sequence[int],
    at_s: Callable[[float], float],
) -> Iterator[str]:
    """Yield a violation for each agent whose ticks are missing, and one for true states that are missing.

    Args:
        ticks: by agent, rows of `TICK_DTYPE` that this computer has recorded.
        truth: rows of `TRUTH_DTYPE`, empty without a simulator.
        here: agents that are judged.
        at_s: returns the mission time of an instant of the clock of `truth`, or of UTC without it.
    """
    clock = "t_us" if len(truth) else "utc_us"
    armed = bool(truth["armed"].any()) or any(rows["armed"].any() for rows in ticks.values())
    for agent in here:
        rows = ticks.get(agent)
        if rows is None or not len(rows):
            if armed and len(truth):
                yield f"agent {agent} has recorded no tick: how it was flown can't be judged"
            continue
        missing = _missing_in_flight(rows)
        count = int(missing.sum())
        if count > _TOLERATED_01 * np.count_nonzero(rows["armed"]):
            since_s = at_s(float(rows[clock][np.argmax(missing > 0)]))
            why = "which can't be judged"
            yield f"{count} ticks of agent {agent} could not be recorded, the first at {since_s:.1f} s, {why}"
    yield from _missing_truth(ticks, truth, at_s)


def _missing_in_flight(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the number of ticks (T - 1,) that an agent ran, of an armed vehicle, between those that were recorded."""
    steps = np.diff(rows["seq"].astype(np.int64))
    armed = rows["armed"] != 0
    missing: NDArray[np.int64] = np.where(armed[:-1] | armed[1:], np.maximum(steps - 1, 0), 0)
    return missing


def _missing_truth(
    ticks: Mapping[int, NDArray[np.void]], truth: NDArray[np.void], at_s: Callable[[float], float]
) -> Iterator[str]:
    if not len(truth):
        return
    known_us = np.unique(truth["t_us"]).astype(np.float64)
    flown_us = np.concatenate([np.zeros(0), *map(_flown_us, ticks.values())])
    before_us = np.concatenate([[-np.inf], known_us])[np.searchsorted(known_us, flown_us, "right")]
    after_us = np.concatenate([known_us, [np.inf]])[np.searchsorted(known_us, flown_us)]
    hidden = (flown_us - before_us > _AFTER_US) & (after_us - flown_us > _BEFORE_US)
    if not hidden.any():
        return
    begins_us, at = np.unique(before_us[hidden], return_index=True)  # each gap once
    ends_us = after_us[hidden][at]
    begins_us = np.where(np.isfinite(begins_us), begins_us, flown_us[hidden].min())
    ends_us = np.where(np.isfinite(ends_us), ends_us, flown_us[hidden].max())
    seconds, since_s = float((ends_us - begins_us).sum()) / 1e6, at_s(float(begins_us.min()))
    yield (
        f"the simulator's true states could not be recorded for {seconds:.1f} s, from {since_s:.1f} s on: "
        "separation and crashes can't be judged there"
    )


def _flown_us(rows: NDArray[np.void]) -> Array:
    """Return the times at which an armed vehicle was simulated: those of its states, and of ticks that are missing."""
    armed = rows["armed"] != 0
    of_missing = np.flatnonzero(_missing_in_flight(rows))
    spans_us = [(rows["t_us"][k], rows["t_us"][k + 1]) for k in of_missing]
    missing_us = [np.arange(begin, end, _LOST_US, dtype=np.float64) for begin, end in spans_us]
    return np.concatenate([located_states_us(rows[armed]), *missing_us])
