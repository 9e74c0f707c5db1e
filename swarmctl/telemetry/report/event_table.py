"""The rows of the table of events: what was accepted as it should be is folded."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

_LONGEST = 300  # characters of the fields of an event
_SHOWN_ELSEWHERE = ("utc_us", "t_us", "source", "event")


class EventRow(NamedTuple):
    """A line of the table."""

    seconds: str
    source: str
    name: str
    fields: str


def event_rows(
    events: Sequence[Mapping[str, Any]], time_of: Callable[[Mapping[str, Any]], float | None]
) -> Iterator[EventRow]:
    """Yield the events of a run in order of time; accepted requests to autopilots that follow each other are one row.

    Args:
        events: of the run.
        time_of: returns the mission time [s] of an event; None: it does not say.
    """
    for is_accepted, group in itertools.groupby(events, _is_accepted):
        together = list(group)
        if is_accepted and len(together) > 1:
            yield _folded(together, time_of)
        else:
            yield from (_row(event, time_of) for event in together)


def _is_accepted(event: Mapping[str, Any]) -> bool:
    return event.get("event") == "command" and event.get("ok") is True


def _row(event: Mapping[str, Any], time_of: Callable[[Mapping[str, Any]], float | None]) -> EventRow:
    fields = ", ".join(f"{key}={value}" for key, value in event.items() if key not in _SHOWN_ELSEWHERE)
    return EventRow(_at(event, time_of), str(event.get("source", "")), str(event.get("event", "")), fields[:_LONGEST])


def _folded(events: Sequence[Mapping[str, Any]], time_of: Callable[[Mapping[str, Any]], float | None]) -> EventRow:
    sources = sorted({str(event.get("source", "")) for event in events})
    verbs = Counter(str(event.get("verb", "")).split(" ")[0] for event in events)
    counts = ", ".join(f"{verb} {count}" for verb, count in verbs.items())
    said = f"{len(events)} accepted: {counts}"
    return EventRow(_at(events[0], time_of), ", ".join(sources)[:_LONGEST], "command", said[:_LONGEST])


def _at(event: Mapping[str, Any], time_of: Callable[[Mapping[str, Any]], float | None]) -> str:
    seconds = time_of(event)
    return "" if seconds is None else f"{seconds:.2f}"
