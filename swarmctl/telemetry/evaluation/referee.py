"""Judges a finished run from its recording, independently of the agents. Pure numpy, no files.

Positions are the simulator's true ones if there are any, otherwise those reported by the agents. The result is the
content of `summary.json`; a figure that can't be known is None.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from swarmctl import __version__
from swarmctl.bus.bus import agent_name
from swarmctl.core.flight_volume import FlightVolume
from swarmctl.core.json_safe import finite, json_safe
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Phase
from swarmctl.telemetry.evaluation.arrivals import flown_away, reached_goals
from swarmctl.telemetry.evaluation.crashes import crashes
from swarmctl.telemetry.evaluation.punctuality import evaluate_timing
from swarmctl.telemetry.evaluation.reception import refused_peers
from swarmctl.telemetry.evaluation.run_counts import (
    commitment_counts,
    communication,
    deadlock_counts,
    own_controllers,
    solver_counts,
)
from swarmctl.telemetry.evaluation.station_clock import ClockedTicks, by_station_clock, seen_late, started
from swarmctl.telemetry.evaluation.tracks import (
    Tracks,
    flight_rows,
    merge_tracks,
    time_zero,
    track_error,
    unseen_spans,
    utc_offset_us,
)
from swarmctl.telemetry.evaluation.unrecorded import unrecorded

RunMode = Literal["realtime", "lockstep"]
SUMMED_ERROR = "distances of all agents to their reference, added up; mean over the mission"  # what `index_m` is
STEADY_AFTER_S = 10.0  # mission time from which `steady_rmse_m` and `index_after_10s_m` are computed
_MAX_LISTED = 10  # largest number of violations of one kind listed in full
_DURATION_SLACK_S = 1.0  # mission time that may be missing at the end of a completed run


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedObstacle:
    """Describes an obstacle and the time in which it was there."""

    number: int  # as operators know it
    obstacle: Obstacle
    since_utc_us: int | None = None  # when it was at its centre; None: at the beginning of what was recorded
    until_utc_us: int | None = None  # when it was removed or changed; None: it never was

    def required_m(self, margin_m: float) -> float:
        """Return the least distance from its centre, or axis, if vehicles may be `margin_m` within its keep-out."""
        return max(self.obstacle.keep_out_m - margin_m, self.obstacle.radius_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """Limits by which a run is judged."""

    agents: int
    required_separation_m: float
    obstacles: tuple[JudgedObstacle, ...] = ()
    obstacle_margin_m: float = 0.05  # allowed intrusion into keep_out_m, never into radius_m
    deadline_misses_01: float = 0.2  # largest fraction of due ticks, flown or skipped, that may be late, also of one
    solver_name: str = "osqp"
    solver_retry: str = "osqp"  # solves what that one does not finish
    mode: RunMode = "realtime"
    duration_s: float | None = None  # mission time that a completed run must have tracked
    volume: FlightVolume | None = None  # that nobody may leave
    ground_z_m: float | None = None  # down coordinate of the simulator's ground
    goals_ned_m: tuple[tuple[float, ...] | None, ...] = ()  # (3,) of every agent; None: its mission has none
    downwash: float = 1.0  # heights are divided by this in `scaled_min_m`, which is reported but not judged


@dataclass(frozen=True, slots=True)
class RunData:
    """The recorded data of a run."""

    ticks: dict[int, NDArray[np.void]]  # by agent, rows of TICK_DTYPE
    truth: NDArray[np.void]  # rows of TRUTH_DTYPE, empty without a simulator
    events: list[dict[str, Any]]
    cut: frozenset[int] = frozenset()  # agents of whose ticks only those of the newest of several clocks are there


def evaluate(
    run: RunData,
    rules: Rules,
    outcome: str,
    problems: Sequence[str] = (),
    *,
    speed_factor: float | None = None,
) -> dict[str, Any]:
    """Return the figures and violations of a run as the content of `summary.json`.

    Args:
        run: the recorded run.
        rules: limits.
        outcome: "completed" | "failed" | "interrupted", as reported by the launcher.
        problems: problems reported by the launcher in words; each is a violation.
        speed_factor: simulated seconds per wall second.
    """
    clocked = by_station_clock(run.ticks, run.events, run.cut)
    run, known = replace(run, ticks=clocked.ticks, events=clocked.events(run.events)), clocked.known
    tracks = merge_tracks(known, run.truth, rules.agents)
    clock = _MissionClock(known, tracks)
    without = flown_without(run.events)
    here = [agent for agent in _agents_here(run, rules) if agent not in without]
    flew = outcome == "completed" or _has_armed(run)
    separation, apart = _evaluate_separation(tracks, rules, here if flew else (), clock)
    obstacles, clear = _evaluate_obstacles(tracks, rules, clock)
    volume, inside = _evaluate_volume(run, tracks, rules, clock)
    timing, punctual = evaluate_timing(run.ticks, rules.deadline_misses_01, speed_factor)
    tracking, tracked_s = _evaluate_tracking(run, rules.agents)
    unseen = [] if len(run.truth) else [*clocked.problems(), *_unseen(clocked, rules.agents, clock)]
    refused = _shorten(list(refused_peers(run.events)))
    if clocked.ahead_s is None:
        lacking = unrecorded(run.ticks, run.truth, here=here, at_s=clock.at_s)
        unseen += _shorten(list(lacking))
    configured = dict(enumerate(rules.goals_ned_m))
    goals_ned_m = {agent: configured.get(agent) for agent in here}
    ground_z_m = rules.ground_z_m if len(run.truth) else None
    crashed = _shorten(list(crashes(run.ticks, tracks, ground_z_m, clock.at_s)))
    violations = [*problems, *crashed, *apart, *clear, *inside, *unseen, *punctual, *refused]
    violations += _not_a_number(run.truth)
    if outcome == "completed":
        violations += _cut_short(tracked_s, rules, run.events)
        violations += _shorten(list(flown_away(run.ticks, run.truth, run.events, rules.required_separation_m)))
    summary = {
        "outcome": "failed" if outcome == "completed" and violations else outcome,
        "violations": violations,
        "version": __version__,
        "agents": rules.agents,
        "without": [agent for agent in range(rules.agents) if agent in without],
        "duration_s": max(tracked_s.values(), default=0.0),
        "time_zero": clock.zero,
        "mode": rules.mode,
        "tracking": tracking,
        "goals": reached_goals(run.ticks, run.truth, run.events, goals_ned_m),
        "separation": separation,
        "obstacles": obstacles,
        "volume": volume,
        "timing": timing,
        "own_controllers": own_controllers(run.events),
        "solver": solver_counts(run.ticks, rules.solver_name, rules.solver_retry),
        "comms": communication(run.ticks, run.events, tracks.time_field),
        "clocks": clocked.summary(),
        "seen_late": seen_late(clocked, clock.at_s),
        "deadlocks": deadlock_counts(run.events),
        "commitments": commitment_counts(run.events),
    }
    result: dict[str, Any] = json_safe(summary)
    return result


class _MissionClock:
    """Converts instants to the time that verdict and report count, see `time_zero`.

    Attributes:
        zero: what its zero is.
        first_us: the first tick of any agent, at which configured obstacles are at their centres.
    """

    def __init__(self, ticks: Mapping[int, NDArray[np.void]], tracks: Tracks) -> None:
        self._start_us, self.zero = time_zero(ticks, tracks)
        firsts_us = [float(rows[tracks.time_field][0]) for rows in ticks.values() if len(rows)]
        self.first_us = min(firsts_us, default=self._start_us)
        self.utc_offset_us = 0.0 if tracks.time_field == "utc_us" else utc_offset_us(ticks)

    def at_s(self, t_us: float) -> float:
        return (t_us - self._start_us) / 1e6


def _agents_here(run: RunData, rules: Rules) -> Sequence[int]:
    """Return the agents that flew from the computer that recorded the run: all, unless its launch says otherwise."""
    listed = started(run.events).get("agents")
    of_swarm = range(rules.agents)
    return [agent for agent in of_swarm if agent in listed] if isinstance(listed, list) and listed else of_swarm


def _has_armed(run: RunData) -> bool:
    """Return whether a vehicle was armed in what was recorded: before that nobody keeps a distance."""
    return bool(run.truth["armed"].any()) or any(rows["armed"].any() for rows in run.ticks.values())


def flown_without(events: Sequence[Mapping[str, Any]]) -> frozenset[int]:
    """Return the agents without which the others went on before they had flown."""
    told = (event.get("agents") for event in events if event.get("event") == "flown_without")
    return frozenset(agent for agents in told if isinstance(agents, list) for agent in agents if isinstance(agent, int))


def _evaluate_separation(
    tracks: Tracks, rules: Rules, here: Sequence[int], clock: _MissionClock
) -> tuple[dict[str, Any], list[str]]:
    """Find the smallest distance of all pairs of `here` at any time, also with heights scaled by downwash."""
    found: dict[str, Any] = {
        "min_m": None,
        "required_m": rules.required_separation_m,
        "min_pair": None,
        "min_at_s": None,
        "scaled_min_m": None,
    }
    scale = np.array([1.0, 1.0, 1.0 / rules.downwash])
    known = [agent for agent in here if np.isfinite(tracks.pos_ned_m[:, agent]).all(axis=1).any()]
    unknown = [agent for agent in here if agent not in known] if len(here) > 1 else []
    violations = [f"separation of agent {agent} can't be judged: no positions were recorded" for agent in unknown]
    for i, j in itertools.combinations(known, 2):
        apart_m = tracks.pos_ned_m[:, i] - tracks.pos_ned_m[:, j]
        nearest, scaled = tracks.nearest(apart_m), tracks.nearest(apart_m * scale)
        if nearest is None or scaled is None:
            violations.append(f"separation of agents {i} and {j} can't be judged: no common positions were recorded")
            continue
        least_m, at_s = nearest[0], clock.at_s(tracks.t_us[nearest[1]])
        if found["min_m"] is None or least_m < found["min_m"]:
            found |= {"min_m": least_m, "min_pair": [i, j], "min_at_s": at_s}
        found["scaled_min_m"] = min(scaled[0], scaled[0] if found["scaled_min_m"] is None else found["scaled_min_m"])
        if least_m < rules.required_separation_m:
            violations.append(
                f"separation {least_m:.3f} m below {rules.required_separation_m:g} m "
                f"between agents {i} and {j} at {at_s:.1f} s"
            )
    return found, _shorten(violations)


def _unseen(clocked: ClockedTicks, agents: int, clock: _MissionClock) -> Iterator[str]:
    """Yield a violation for each agent that flew without a known position, as its separation can't be judged."""
    for agent, ticks in clocked.known.items():
        rows = flight_rows(ticks)
        spans = unseen_spans(rows, "utc_us") if agent < agents else []
        if spans:
            seconds, begins_s = sum(end - begin for begin, end in spans) / 1e6, clock.at_s(spans[0][0])
            said = any(((begin < rows["utc_us"]) & (rows["utc_us"] < end)).any() for begin, end in spans)
            by_station = clocked.ahead_s is not None and not said
            why = "was not heard by the station" if by_station else "did not know where its armed vehicle was"
            yield f"agent {agent} {why} for {seconds:.1f} s, from {begins_s:.1f} s on: its separation can't be judged"


def _evaluate_obstacles(
    tracks: Tracks, rules: Rules, clock: _MissionClock
) -> tuple[dict[str, float | None], list[str]]:
    """Find the distance to the centre (axis of a column) of the obstacle with the least margin, and to the nearest."""
    worst: tuple[float, float] | None = None  # (distance, required) with the least margin
    nearest_m = math.inf
    violations = []
    for judged in rules.obstacles:
        obstacle, until_utc_us = judged.obstacle, judged.until_utc_us
        required_m = judged.required_m(rules.obstacle_margin_m)
        since_us = clock.first_us if judged.since_utc_us is None else judged.since_utc_us - clock.utc_offset_us
        elapsed_s = (tracks.t_us - since_us) / 1e6
        center_ned_m = obstacle.center_after(elapsed_s[:, None])  # (T, 3)
        gone_us = math.inf if until_utc_us is None else until_utc_us - clock.utc_offset_us
        counts = (elapsed_s >= 0.0) & (tracks.t_us <= gone_us)
        for agent in range(rules.agents):
            apart_m = tracks.pos_ned_m[:, agent] - center_ned_m
            apart_m[~counts] = np.nan
            nearest = tracks.nearest(apart_m[:, : obstacle.axes])
            if nearest is None:
                continue
            least_m, instant = nearest
            nearest_m = min(nearest_m, least_m)
            if worst is None or least_m - required_m < worst[0] - worst[1]:
                worst = (least_m, required_m)
            if least_m < required_m:
                violations.append(
                    f"obstacle clearance {least_m:.3f} m below {required_m:g} m "
                    f"between agent {agent} and obstacle {judged.number} at {clock.at_s(tracks.t_us[instant]):.1f} s"
                )
    distance, required = worst or (None, None)
    figures = {"min_clearance_m": distance, "required_m": required, "nearest_m": finite(nearest_m)}
    return figures, _shorten(violations)


def _evaluate_volume(
    run: RunData, tracks: Tracks, rules: Rules, clock: _MissionClock
) -> tuple[dict[str, Any] | None, list[str]]:
    """Find how far inside of the volume everybody stayed, from standing at its start to its landing; None without one.

    Before that autopilots climb from below the floor, and afterwards they land through it.
    """
    if rules.volume is None:
        return None, []
    least_m, violations = np.inf, []
    for agent, rows in run.ticks.items():
        flown_us = rows[tracks.time_field][(rows["phase"] >= Phase.READY) & (rows["phase"] <= Phase.GOTO_LAND)]
        if agent >= rules.agents or not len(flown_us):
            continue
        during = (tracks.t_us >= flown_us[0]) & (tracks.t_us <= flown_us[-1])
        beyond_m = rules.volume.beyond_m(tracks.pos_ned_m[during, agent])
        if not np.isfinite(beyond_m).any():
            continue
        worst = int(np.nanargmax(beyond_m))
        least_m = min(least_m, -float(beyond_m[worst]))
        if beyond_m[worst] > 0.0:
            at_s = clock.at_s(tracks.t_us[during][worst])
            face = rules.volume.face(tracks.pos_ned_m[during, agent][worst])
            left = f"{beyond_m[worst]:.3f} m outside of the flight volume ({face})"
            violations.append(f"agent {agent} {left} at {at_s:.1f} s")
    return {"least_inside_m": finite(least_m), "margin_m": rules.volume.params.margin_m}, _shorten(violations)


def _evaluate_tracking(run: RunData, agents: int) -> tuple[dict[str, Any], dict[int, float]]:
    """Return tracking errors and, for each agent, the time of its newest mission that it tracked [s].

    The index of thesis Table 19 is the summed mean tracking error: the sum over agents of the distance to the shared
    reference, averaged over the mission time common to all agents.
    """
    errors = {agent: track_error(rows, run.truth, agent) for agent, rows in run.ticks.items() if agent < agents}
    errors = {agent: error for agent, error in errors.items() if len(error.mission_t_s)}
    rows = []
    for agent, error in errors.items():
        steady = error.mission_t_s >= STEADY_AFTER_S
        rows.append(
            {
                "id": agent,
                "mse_m2": np.mean(error.error_ned_m**2, axis=0),
                "mean_distance_m": float(np.mean(error.distance_m)),
                "rmse_m": float(np.sqrt(np.mean(error.distance_m**2))),
                "steady_rmse_m": float(np.sqrt(np.mean(error.distance_m[steady] ** 2))) if steady.any() else None,
            }
        )
    summed_m: tuple[float | None, float | None] = (None, None)
    if len(errors) == agents:
        first_s = max(error.mission_t_s[0] for error in errors.values())
        last_s = min(error.mission_t_s[-1] for error in errors.values())
        spans = [(first_s, last_s), (max(first_s, STEADY_AFTER_S), last_s)]
        summed_m = (_summed_mean_error_m(errors, *spans[0]), _summed_mean_error_m(errors, *spans[1]))
    tracked_s = {agent: error.tracked_s for agent, error in errors.items()}
    return {"index_m": summed_m[0], "index_after_10s_m": summed_m[1], "agents": rows}, tracked_s


def _summed_mean_error_m(errors: Mapping[int, Any], first_s: float, last_s: float) -> float | None:
    total_m = 0.0
    for error in errors.values():
        common = (error.mission_t_s >= first_s) & (error.mission_t_s <= last_s)
        if not common.any():
            return None
        total_m += float(np.mean(error.distance_m[common]))
    return total_m


def _not_a_number(truth: NDArray[np.void]) -> Iterator[str]:
    for vehicle in np.unique(truth["vehicle"][~np.isfinite(truth["pos_ned_m"]).all(axis=1)]):
        yield f"true position of agent {vehicle} is not a number: the simulation diverged"


def _cut_short(tracked_s: Mapping[int, float], rules: Rules, events: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield whose mission was shorter than that of the configuration, or than the last one that was set in flight."""
    if rules.duration_s is None:
        return
    changed = [event for event in events if event.get("event") == "mission_changed"]
    asked_s = {event.get("source"): event.get("duration_s") for event in changed}
    for agent, seconds in tracked_s.items():
        wanted_s = asked_s.get(agent_name(agent), rules.duration_s)
        if isinstance(wanted_s, int | float) and seconds < wanted_s - _DURATION_SLACK_S:
            yield f"mission time {seconds:.1f} s of agent {agent} below {wanted_s:g} s"


def _shorten(violations: list[str]) -> list[str]:
    if len(violations) <= _MAX_LISTED:
        return violations
    return [*violations[:_MAX_LISTED], f"and {len(violations) - _MAX_LISTED} more like the last"]
