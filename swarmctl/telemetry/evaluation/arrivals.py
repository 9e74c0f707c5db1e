"""Evaluates whether agents reached the goals of their newest mission, and when, and who has flown away from it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.bus import agent_name
from swarmctl.core.goal import REACHED_M
from swarmctl.core.json_safe import finite
from swarmctl.core.types import Array
from swarmctl.telemetry.evaluation.tracks import newest_mission, true_positions

_FAR_M = 3.0  # from the reference, beside the room that agents who share it need


def reached_goals(
    ticks: Mapping[int, NDArray[np.void]],
    truth: NDArray[np.void],
    events: Sequence[Mapping[str, Any]],
    goals_ned_m: Mapping[int, Sequence[float] | None],
) -> dict[str, Any] | None:
    """Return how many goals were reached and, of each agent that has one, when or how far from it it ended.

    Args:
        ticks: rows of TICK_DTYPE by agent.
        truth: rows of TRUTH_DTYPE, empty without a simulator.
        events: of all sources; missions that were set in flight have goals of their own.
        goals_ned_m: (3,) of the configured mission by agent; None where it has none.
    """
    set_in_flight = _set_in_flight(events, goals_ned_m)
    goals = {agent: goal for agent, goal in (dict(goals_ned_m) | set_in_flight).items() if goal}
    rows = []
    for agent, goal in goals.items():
        reached_at_s, left_m = (None, None)
        if agent in ticks:
            reached_at_s, left_m = _arrival(ticks[agent], truth, agent, np.array(goal))
        rows.append({"id": agent, "goal_ned_m": list(goal), "reached_at_s": reached_at_s, "left_m": left_m})
    if not rows:
        return None
    reached = sum(row["reached_at_s"] is not None for row in rows)
    return {"reached": reached, "of": len(rows), "within_m": REACHED_M, "agents": rows}


def _arrival(
    flown: NDArray[np.void], truth: NDArray[np.void], agent: int, goal_ned_m: Array
) -> tuple[float | None, float | None]:
    """Return the mission time from which on an agent stayed at its goal, and its last distance from it."""
    mission = newest_mission(flown)
    distance_m = np.linalg.norm(true_positions(mission, truth, agent) - goal_ned_m, axis=1)
    known = np.isfinite(distance_m)
    distance_m, times_s = distance_m[known], mission["mission_t_s"][known]
    if not len(distance_m):
        return None, None
    away = np.flatnonzero(distance_m > REACHED_M)
    first = int(away[-1]) + 1 if len(away) else 0
    reached_at_s = max(0.0, float(times_s[first])) if first < len(times_s) else None
    return reached_at_s, float(distance_m[-1])


def flown_away(
    ticks: Mapping[int, NDArray[np.void]],
    truth: NDArray[np.void],
    events: Sequence[Mapping[str, Any]],
    apart_m: float,
) -> Iterator[str]:
    """Yield which agents an own controller has left far from their references at the end of their missions.

    Without a flight volume nothing else says so: its commands are judged by what they come near to, and by nothing
    that they leave.

    Args:
        ticks: rows of TICK_DTYPE by agent.
        truth: rows of TRUTH_DTYPE, empty without a simulator.
        events: of all sources; `controller_summary` is of agents with own controllers.
        apart_m: distance of vehicles, which those that share a reference keep from each other.
    """
    most_m = _FAR_M + apart_m * math.sqrt(len(ticks))
    own = {event.get("source"): event for event in events if event.get("event") == "controller_summary"}
    for agent, rows in ticks.items():
        mission, summary = newest_mission(rows), own.get(agent_name(agent))
        if summary is None:
            continue
        error_m = np.linalg.norm(true_positions(mission, truth, agent) - mission["ref_pos_ned_m"], axis=1)
        known_m = error_m[np.isfinite(error_m)]
        if len(known_m) and known_m[-1] > most_m:
            yield f"controller {summary.get('controller')} left agent {agent} {known_m[-1]:.1f} m from its reference"


def _set_in_flight(
    events: Sequence[Mapping[str, Any]], agents: Mapping[int, Sequence[float] | None]
) -> dict[int, Sequence[float] | None]:
    """Return the goal of every agent whose mission an operator has set; None of a mission without."""
    found: dict[int, Sequence[float] | None] = {}
    for event in events:
        source = str(event.get("source"))
        for agent in agents if event.get("event") == "mission_changed" else ():
            if source == agent_name(agent):
                goal = event.get("goal_ned_m")
                numbers = [finite(part) for part in goal] if isinstance(goal, list) else []
                known = [number for number in numbers if number is not None]
                found[agent] = known if len(known) == 3 else None
    return found
