"""What is counted over a run and not judged: solver, communication, deadlocks, commitments. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.silence import REOPENED
from swarmctl.bus.topics import FAR_PATH, PATH
from swarmctl.core.json_safe import finite
from swarmctl.core.types import Array, Mode, PlanStatus
from swarmctl.telemetry.evaluation.reception import unresponsive
from swarmctl.telemetry.evaluation.tracks import flight_rows

_CONTROLLED = (Mode.TRACKING, Mode.REPLAY, Mode.BRAKE)
_PATHS, _COUNTED = (PATH.name, FAR_PATH.name), ("messages", "bytes")
_SOLVER_FAILED = (PlanStatus.SOLVER_FAILED, PlanStatus.RESIDUAL)


def solver_counts(ticks: Mapping[int, NDArray[np.void]], name: str, retry: str) -> dict[str, Any]:
    """Count solver failures while the agent had control, and find the largest residual of a plan that was flown."""
    flights = [flight_rows(rows) for rows in ticks.values()]
    charged = [rows[np.isin(rows["mode"], _CONTROLLED)] for rows in flights]
    residuals = [
        rows["residual_m"][(rows["iterations"] > 0) & (rows["plan_status"] == PlanStatus.OK)] for rows in flights
    ]
    return {
        "name": name,
        "retry": retry,
        "failed": sum(int(np.isin(rows["plan_status"], _SOLVER_FAILED).sum()) for rows in charged),
        "not_certified": sum(int((rows["plan_status"] == PlanStatus.NOT_CERTIFIED).sum()) for rows in charged),
        "max_residual_m": percentiles(residuals)["max"],
        "safety_filter_ticks": sum(int(rows["safety_filter_acted"].sum()) for rows in flights),
    }


def communication(
    ticks: Mapping[int, NDArray[np.void]], events: Sequence[Mapping[str, Any]], time_field: str
) -> dict[str, Any]:
    """Summarise plan staleness, messages sent, messages and frames refused, unresponsive peers, sessions replaced."""
    ages = percentiles([flight_rows(rows)["plan_staleness_ms"] for rows in ticks.values()])
    return {
        "path_age_ms": {"p50": ages["p50"], "p99": ages["p99"]},
        "sent": _sent(events),
        "sent_by": _sent_by(events),
        "rejected": _refused(events, "bus_summary", "rejected"),
        "refused_frames": _refused(events, "link_summary", "refused"),
        "unresponsive": unresponsive(events, time_field),
        "reopened": sum(event.get("event") == REOPENED for event in events),
    }


def _last_of_each_source(events: Sequence[Mapping[str, Any]], name: str) -> Iterable[Mapping[str, Any]]:
    return {event.get("source"): event for event in events if event.get("event") == name}.values()


def _sent(events: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Add up messages and bytes by topic in the last summary of each agent."""
    total: dict[str, Counter[str]] = {}
    for summary in _last_of_each_source(events, "bus_summary"):
        for topic, found in _topics_of(summary):
            total.setdefault(topic, Counter()).update(found)
    return {topic: dict(counts) for topic, counts in sorted(total.items())}


def _sent_by(events: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Add up messages and bytes of all topics in the last summary of each agent, and the bytes of predicted paths."""
    found: dict[str, dict[str, int]] = {}
    for summary in _last_of_each_source(events, "bus_summary"):
        topics = dict(_topics_of(summary))
        paths = sum(topics[name].get("bytes", 0) for name in _PATHS if name in topics)
        total = {key: sum(counts.get(key, 0) for counts in topics.values()) for key in _COUNTED}
        found[str(summary.get("source"))] = total | {"path_bytes": paths}
    return dict(sorted(found.items()))


def _topics_of(summary: Mapping[str, Any]) -> Iterable[tuple[str, dict[str, int]]]:
    """Yield `messages` and `bytes` of each topic in a summary, as far as they are numbers."""
    topics = summary.get("sent")
    for topic, counts in topics.items() if isinstance(topics, dict) else ():
        if isinstance(counts, dict):
            yield str(topic), {key: int(counts[key]) for key in _COUNTED if finite(counts.get(key)) is not None}


def _refused(events: Sequence[Mapping[str, Any]], name: str, field: str) -> dict[str, int]:
    """Add up the counts by reason in the last event of a name from each source."""
    refused: Counter[str] = Counter()
    for event in _last_of_each_source(events, name):
        reasons = event.get(field)
        if isinstance(reasons, dict):
            refused.update({str(reason): int(n) for reason, n in reasons.items() if finite(n) is not None})
    return dict(sorted(refused.items()))


def deadlock_counts(events: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Count deadlocks, those that were not resolved, and the longest duration."""
    noticed = [event for event in events if event.get("event") == "deadlock"]
    lasted_s = [seconds for event in noticed if (seconds := finite(event.get("lasted_s"))) is not None]
    count, unresolved = 0, Counter[str]()
    for event in noticed:  # the begin of one may not be recorded: by a station that came later, or on a full disk
        source, begins = str(event.get("source")), event.get("begins") is True
        count += begins or not unresolved[source]
        unresolved[source] = max(0, unresolved[source] + (1 if begins else -1))
    return {"count": count, "longest_s": max(lasted_s, default=None), "unresolved": unresolved.total()}


def commitment_counts(events: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Sums over agents of what they counted by their last `commitments` event; None where nothing was guaranteed."""
    last = list(_last_of_each_source(events, "commitments"))
    if not last:
        return None
    names = ("proposed", "committed", "withdrawn", "expired", "unplanned", "evasive")
    worst_m = max(finite(event.get("worst_tracking_m")) or 0.0 for event in last)
    off = sum(event.get("event") == "tracking_violation" and event.get("begins") is True for event in events)
    return {name: sum(int(finite(event.get(name)) or 0) for event in last) for name in names} | {
        "worst_tracking_m": worst_m,
        "tracking_violation": off,
    }


def own_controllers(events: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Sum over agents, for each own controller, the ticks of missions, and those of them that it has flown."""
    ticks: dict[str, Counter[str]] = {}
    for event in _last_of_each_source(events, "controller_summary"):
        counts = {key: int(finite(event.get(key)) or 0) for key in ("flown_ticks", "mission_ticks")}
        ticks.setdefault(str(event.get("controller")), Counter()).update(counts)
    return [{"name": name, **counts} for name, counts in sorted(ticks.items())]


def percentiles(parts: Sequence[Array]) -> dict[str, float | None]:
    """Return median, 99th percentile and maximum of the finite values."""
    values = np.concatenate([np.asarray(part, np.float64) for part in parts]) if parts else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values):
        return {"p50": None, "p99": None, "max": None}
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "max": float(values.max())}
