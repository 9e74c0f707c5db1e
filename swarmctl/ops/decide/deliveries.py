"""Which tick of an agent has received what: as recorded, or in older recordings by the stamps.

Frames are in the tick in which the `.tlog` has stamped them. Of messages no stamp tells: one that comes a millisecond
later is in the next tick.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice, repeat, starmap
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from swarmctl.config import Config
from swarmctl.core.recorded.received import ReceivedKind
from swarmctl.mavlink.transport import Datagram
from swarmctl.ops.decide.inputs import Heard, begins_utc_us, operator_messages, peer_messages, received_messages
from swarmctl.telemetry.evaluation.referee import RunData

T = TypeVar("T", bound=tuple[Any, ...])


class Delivery(NamedTuple):
    """What one tick has received, and the UTC [us] at which it has begun."""

    begin_utc_us: int
    datagrams: list[Datagram]
    messages: list[Heard]


class Recording(NamedTuple):
    """What is recorded of a run, as far as decisions follow from it."""

    run: RunData
    plans: Mapping[int, NDArray[np.void]]  # by agent
    received: Mapping[int, NDArray[np.void]]  # likewise; empty rows of older recordings


def deliveries(
    config: Config, agent: int, recording: Recording, frames: Sequence[tuple[int, bytes]]
) -> Iterator[Delivery]:
    """Yield what each tick of an agent has received; `frames` are those of its vehicle with their UTC [us]."""
    run, received = recording.run, recording.received[agent]
    rows, is_recorded = run.ticks[agent], len(received) > 0
    begins_us = (rows["utc_us"] if is_recorded else begins_utc_us(rows)).tolist()
    arrived_us = _arrivals_us(received)
    from_vehicle, from_operator = _InTime(frames), _InTime(operator_messages(config, agent, run.ticks, run.events))
    by_stamp = _InTime([] if is_recorded else peer_messages(config, agent, run.ticks, recording.plans))
    by_tick = received_messages(config, run.ticks, recording.plans, received)
    each = zip(rows["t_us"].tolist(), begins_us, [*begins_us[1:], np.inf], _likely_us(rows), strict=True)
    for t_us, begin_us, next_us, likely_us in each:
        read = [frame for _, frame in from_vehicle.before(next_us)]  # stamped when this tick read them
        at_us = list(islice(chain.from_iterable(starmap(repeat, arrived_us.get(t_us, ()))), len(read)))
        if len(at_us) != len(read):  # older, or the disk has refused rows
            at_us = [likely_us] * len(read)
        messages = [*by_stamp.before(begin_us), *by_tick.get(t_us, ()), *from_operator.before(next_us)]
        yield Delivery(begin_us, [Datagram(*pair) for pair in zip(at_us, read, strict=True)], messages)


def _arrivals_us(received: NDArray[np.void]) -> dict[int, list[tuple[int, int]]]:
    """Return when frames [us] that each tick has received arrived, and how many did, by the time of the tick."""
    arrived_us: dict[int, list[tuple[int, int]]] = {}
    for row in received[received["kind"] == ReceivedKind.FRAMES]:
        arrived_us.setdefault(int(row["t_us"]), []).append((int(row["stamp_us"]), int(row["seq"])))
    return arrived_us


def _likely_us(rows: NDArray[np.void]) -> list[int]:
    """Return when the frames [us] that each tick read are likely to have arrived: with its state, if it is new.

    Frames are stamped when they are read, but wait for a tick for up to 20 ms, by which a state is older.
    """
    t_us = rows["t_us"]
    age_us = np.nan_to_num(rows["state_age_ms"] * 1e3, nan=np.inf)
    is_new = age_us < np.diff(t_us, prepend=t_us[:1])
    found: list[int] = (t_us - np.where(is_new, age_us, 0.0).round().astype(np.int64)).tolist()
    return found


class _InTime(Generic[T]):
    """Hands out recorded items, whose first element is their UTC [us], as time goes on."""

    def __init__(self, items: Sequence[T]) -> None:
        self._items, self._next = items, 0

    def before(self, utc_us: float) -> list[T]:
        """Return the items before a time that have not been handed out."""
        first = self._next
        while self._next < len(self._items) and self._items[self._next][0] < utc_us:
            self._next += 1
        return list(self._items[first : self._next])
