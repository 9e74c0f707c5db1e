"""Events of agents on their way to a station, which records them as the agents themselves do.

They are the lines of `agent-<i>.events.jsonl`. A line that is too long for the bus goes without its longest fields, as
a judge needs the others: of a long mission that was set in flight, its duration and its goal.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.refusals import IDENTITY, MALFORMED
from swarmctl.bus.topics import EVENT
from swarmctl.core.json_safe import to_json
from swarmctl.core.types import Plan
from swarmctl.telemetry.evaluation.station_clock import SENDER_CLOCK
from swarmctl.telemetry.recording.recorder import Recorder, event_line

LEFT_OUT = "left_out"  # field: names of those that an event was too long for
_STAMPS = ("utc_us", "t_us", "source", "event")
_INT64 = range(-(2**63), 2**63)
# By these a station tells its judge what flew, among what, and by which clocks. An agent has no say in that
_OF_STATIONS = frozenset(("started", "obstacles", "flown_without", SENDER_CLOCK))


class SharedEvents:
    """Records what an agent tells of its flight, and publishes its events.

    Args:
        recorder: of the agent.
        bus: brings them to the station.
        agent: its number.
    """

    def __init__(self, recorder: Recorder, bus: Bus, agent: int) -> None:
        self._recorder, self._bus, self._source = recorder, bus, agent_name(agent)

    def tick(self, row: NDArray[np.void], flown: Plan | None) -> None:
        """Record one tick; that is published elsewhere."""
        self._recorder.tick(row, flown)

    def received(self, rows: bytes) -> None:
        """Record what a tick has received."""
        self._recorder.received(rows)

    def event(self, name: str, t_us: int, utc_us: int, **fields: Any) -> None:
        """Record one event and publish it."""
        line = event_line(self._source, name, t_us, utc_us, fields)
        self._recorder.put_event(line)
        sent = line if len(line) <= EVENT.max_bytes else _shortened(line)
        if len(sent) <= EVENT.max_bytes:
            self._bus.publish(EVENT, sent)


class TakenEvent(NamedTuple):
    """Holds the line to record of a message of the bus, or why there is none."""

    line: bytes
    refusal: str = ""


def taken_event(sender: str, payload: bytes) -> TakenEvent:
    """Return the event that a message holds, by who has sent it, whoever it names."""
    try:
        row = json.loads(payload)
        if not (isinstance(row, dict) and isinstance(row.get("event"), str) and _has_times(row)):
            return TakenEvent(b"", MALFORMED)
        if row["event"] in _OF_STATIONS:
            return TakenEvent(b"", IDENTITY)
        return TakenEvent(to_json({**row, "source": sender}).encode())
    except (ValueError, RecursionError):  # of what no text can hold, and of nesting
        return TakenEvent(b"", MALFORMED)


def _has_times(row: dict[str, Any]) -> bool:
    return all(type(row.get(key)) is int and row[key] in _INT64 for key in ("utc_us", "t_us"))


def _shortened(line: bytes) -> bytes:
    """Return an event without its longest fields, as many as it is too long for."""
    row, left_out = json.loads(line), list[str]()
    by_length = sorted(row.keys() - set(_STAMPS), key=lambda name: (-len(to_json(row[name])), name))
    for name in by_length:
        del row[name]
        left_out.append(name)
        line = to_json({**row, LEFT_OUT: left_out}).encode()
        if len(line) <= EVENT.max_bytes:
            break
    return line
