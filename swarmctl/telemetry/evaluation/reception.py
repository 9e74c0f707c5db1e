"""Evaluates from events whether agents accepted each other's messages: refusals, and peers that went unresponsive."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from swarmctl.bus.refusals import BOOT, FORGED, FUTURE, IDENTITY, LATE, MALFORMED, SEQUENCE, UNKNOWN_PEER, UNSEALED
from swarmctl.bus.topics import OBSTACLES
from swarmctl.core.json_safe import finite

_ALLOWED = {  # refusals by one agent for each peer and topic; other reasons are normal for a network or a restart
    BOOT: 0,
    SEQUENCE: 0,
    IDENTITY: 0,
    UNSEALED: 0,
    FORGED: 0,
    UNKNOWN_PEER: 0,
    MALFORMED: 50,  # the paths of one second
    FUTURE: 50,
}
_ALLOWED_LISTS = {MALFORMED: 5, FUTURE: 5, LATE: 5}  # of obstacles, repeated once a second, valid for a minute


def refused_peers(events: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield violations: messages in the name of an agent or operator that were forged, or could not be used."""
    counts: dict[tuple[str, str, str], dict[str, int]] = defaultdict(dict)  # (name, topic, reason): last count by agent
    for event in events:
        if event.get("event") == "refused" and isinstance(event.get("count"), int):
            sender, topic, reason = (str(event.get(key)) for key in ("sender", "topic", "reason"))
            counts[sender, topic, reason][str(event.get("source"))] = event["count"]
    found: dict[str, list[tuple[str, str, int, list[str]]]] = defaultdict(list)
    for (sender, topic, reason), by in sorted(counts.items()):
        allowed = _ALLOWED | _ALLOWED_LISTS if topic == OBSTACLES.name else _ALLOWED
        if told := {agent: count for agent, count in by.items() if count > allowed.get(reason, count)}:
            found[sender].append((topic, reason, sum(told.values()), sorted(told)))
    for sender, rows in found.items():
        kinds = ", ".join(f"{topic} {reason} {count}" for topic, reason, count, _ in rows)
        agents = ", ".join(sorted({agent for *_, agents in rows for agent in agents}))
        yield f"messages in the name of {sender} were refused ({kinds}) by {agents}"


def unresponsive(events: Sequence[Mapping[str, Any]], time_field: str) -> dict[str, Any]:
    """Return how often no path of a peer on the bus was accepted, and the longest time with both agents involved.

    Args:
        events: of all sources.
        time_field: time of an event that all sources share, see `Tracks`.
    """
    count, since_us = 0, dict[tuple[str, int], int]()
    worst: tuple[float, int | None, str | None] = (0.0, None, None)
    for event in events:
        if event.get("event") != "unresponsive" or not isinstance(event.get("agent"), int):
            continue
        source, agent = str(event.get("source")), event["agent"]
        if event.get("begins"):
            count += 1
            since_us[source, agent] = _time_us(event, time_field)
        elif since_us.pop((source, agent), None) is not None:
            worst = max(worst, (finite(event.get("lasted_s")) or 0.0, agent, source), key=lambda item: item[0])
    last_us = max((_time_us(event, time_field) for event in events), default=0)
    for (source, agent), began_us in since_us.items():  # those that lasted to the end of the run
        worst = max(worst, ((last_us - began_us) * 1e-6, agent, source), key=lambda item: item[0])
    longest_s, agent_, by = worst
    return {"count": count, "longest_s": longest_s if count else None, "agent": agent_, "by": by}


def _time_us(event: Mapping[str, Any], time_field: str) -> int:
    return int(finite(event.get(time_field)) or 0)
