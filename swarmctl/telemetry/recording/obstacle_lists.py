"""The obstacles of a run over time, from the lists that its launch has recorded as events."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from swarmctl.bus.messages.json_messages import ObstaclesMessage, decode_obstacles, encode_message
from swarmctl.telemetry.evaluation.referee import JudgedObstacle
from swarmctl.telemetry.recording.run_files import utc_us_of

_EVENT = "obstacles"


def recorded_list(message: ObstaclesMessage) -> dict[str, Any]:
    """Return the fields of the event by which a list is recorded: its version, and the list as JSON."""
    return {"version": message.version, "listed": encode_message(message).decode()}


def recorded_obstacles(
    configured: Sequence[JudgedObstacle], events: Sequence[Mapping[str, Any]]
) -> tuple[JudgedObstacle, ...]:
    """Return all obstacles there were, from the events of a run in order of time.

    Those that a list lacks were there until it was adopted, those that it adds are new. Where no list was recorded, as
    in simulations, the obstacles are those that were configured.
    """
    known: tuple[JudgedObstacle, ...] | None = None
    for event in events:
        listed = event.get("listed") if event.get("event") == _EVENT else None
        message = decode_obstacles(listed.encode(errors="replace")) if isinstance(listed, str) else None
        if message is not None:
            known = _judged(known or (), message, utc_us_of(event))
    return tuple(configured) if known is None else known


def _judged(known: tuple[JudgedObstacle, ...], message: ObstaclesMessage, utc_us: int) -> tuple[JudgedObstacle, ...]:
    """Return those known, of which a list ends the ones that it lacks, and those that it adds."""
    listed = [
        JudgedObstacle(number=item.number, obstacle=item.obstacle, since_utc_us=item.since_utc_us)
        for item in message.obstacles
    ]
    there = set(listed)
    kept = [j if j in there or j.until_utc_us is not None else replace(j, until_utc_us=utc_us) for j in known]
    return (*kept, *(judged for judged in listed if judged not in kept))
