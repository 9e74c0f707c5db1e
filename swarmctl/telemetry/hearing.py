"""Whether agents believed each other, from their events: whose messages were refused, and who went unheard."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from swarmctl.telemetry.json_safe import finite

_ALLOWED = {  # of one topic of one peer, by one agent; other reasons are what a network or a restart does by itself
    "boot": 0,
    "sequence": 0,
    "identity": 0,
    "unknown_peer": 0,
    "malformed": 50,  # a second of paths
    "future": 50,
}


def refused_peers(events: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Violations: messages in the name of a peer that its sender can't have said, or that nobody could take in."""
    counts: dict[tuple[str, str, str], dict[str, int]] = defaultdict(dict)  # (name, topic, reason): by agent, the last
    for event in events:
        if event.get("event") == "refused" and isinstance(event.get("count"), int):
            sender, topic, reason = (str(event.get(key)) for key in ("sender", "topic", "reason"))
            counts[sender, topic, reason][str(event.get("source"))] = event["count"]
    found: dict[str, list[tuple[str, str, int, list[str]]]] = defaultdict(list)
    for (sender, topic, reason), by in sorted(counts.items()):
        told = {agent: count for agent, count in by.items() if count > _ALLOWED.get(reason, count)}
        if sender.startswith("agent-") and told:
            found[sender].append((topic, reason, sum(told.values()), sorted(told)))
    for sender, rows in found.items():
        kinds = ", ".join(f"{topic} {reason} {count}" for topic, reason, count, _ in rows)
        agents = ", ".join(sorted({agent for *_, agents in rows for agent in agents}))
        yield f"messages in the name of {sender} were refused ({kinds}) by {agents}"


def unheard(events: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How often a peer that was on the bus said no path that was believed, and who it was for longest, to whom."""
    count, since_us = 0, dict[tuple[str, int], int]()
    worst: tuple[float, int | None, str | None] = (0.0, None, None)
    for event in events:
        if event.get("event") != "unheard" or not isinstance(event.get("agent"), int):
            continue
        source, agent = str(event.get("source")), event["agent"]
        if event.get("begins"):
            count += 1
            since_us[source, agent] = _utc_us(event)
        elif since_us.pop((source, agent), None) is not None:
            worst = max(worst, (finite(event.get("lasted_s")) or 0.0, agent, source), key=lambda item: item[0])
    last_us = max(map(_utc_us, events), default=0)
    for (source, agent), began_us in since_us.items():  # to the end
        worst = max(worst, ((last_us - began_us) * 1e-6, agent, source), key=lambda item: item[0])
    longest_s, agent_, by = worst
    return {"count": count, "longest_s": longest_s if count else None, "agent": agent_, "by": by}


def _utc_us(event: Mapping[str, Any]) -> int:
    return int(finite(event.get("utc_us")) or 0)
