"""Computes tracks from recorded rows: positions of all vehicles at common instants, and tracking errors.

Pure numpy. Referee and report share this module, so that their figures agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.closest_pair import closest_m
from swarmctl.core.types import Array, Phase

GRID_US = 20_000
_AT_ONCE_US = 2 * GRID_US  # instants that are farther apart do not follow each other
GAP_US = 500_000  # no interpolation between reported positions farther apart in time
_STALE_MS = GAP_US / 1e3  # an agent that receives nothing keeps recording the last known position
_AGAIN_S = 0.5  # mission time that falls by more begins again; by less, somebody has set the clock
_AT_REST_M = 0.01  # a reference that moves less in its last ticks has come to rest, and is a goal
_LAST_TICKS = 10
_SAME_M = 0.05  # references closer than this are the same
_DIFFERENT_01 = 0.02  # fraction of the mission in which they may be apart all the same: at their steps
MAX_RUN_US = 48 * 3_600_000_000  # longest run; clocks farther apart belong to different runs


@dataclass(frozen=True, slots=True)
class Tracks:
    """Positions of all agents at common instants, from the first arming to the end."""

    t_us: Array  # (T,) in the clock `time_field` names
    pos_ned_m: Array  # (T, agents, 3), NaN where unknown
    time_field: str  # "t_us" for true positions, "utc_us" for reported ones: agents may be on several hosts

    def nearest(self, apart_m: Array) -> tuple[float, int] | None:
        """Return the least length of vectors (T, D) that change with these tracks, and at which instant.

        Between true positions that follow each other at once vehicles move straight, to a millimetre, and the least may
        be there; the instant is then the later one. Reported positions are not that exact, and jump. None: none is
        known.
        """
        lengths_m = np.linalg.norm(apart_m, axis=1)
        if not np.isfinite(lengths_m).any():
            return None
        instant = int(np.nanargmin(lengths_m))
        least_m = float(lengths_m[instant])
        if self.time_field == "t_us":
            step_m = float(np.fmax.reduce(np.abs(np.diff(apart_m, axis=0)), axis=None, initial=0.0))
            # nobody who is farther away comes nearer in half a step:
            reach_m = least_m + 0.5 * math.sqrt(apart_m.shape[1]) * step_m
            near = np.fmin(lengths_m[:-1], lengths_m[1:]) <= reach_m
            later = np.flatnonzero(near & (np.diff(self.t_us) <= _AT_ONCE_US)) + 1
            between_m = closest_m(apart_m[later - 1], apart_m[later])
            if len(later) and (between_m < least_m).any():
                nearest = int(np.nanargmin(between_m))
                least_m, instant = float(between_m[nearest]), int(later[nearest])
        return least_m, instant


@dataclass(frozen=True, slots=True)
class TrackError:
    """Tracking error of one agent, one row for each tick of the mission."""

    mission_t_s: Array  # (T,) of all missions that were flown one after the other
    error_ned_m: Array  # (T, 3) position minus reference
    distance_m: Array  # (T,)
    tracked_s: float  # time of the newest mission at the last of them


def flight_rows(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the ticks between arming and the end of landing."""
    during: NDArray[np.void] = rows[(rows["phase"] >= Phase.ARM) & (rows["phase"] < Phase.DONE)]
    return during


def tracking_rows(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the ticks of the mission itself."""
    during: NDArray[np.void] = rows[_is_tracking(rows)]
    return during


def _is_tracking(rows: NDArray[np.void]) -> NDArray[np.bool_]:
    tracking: NDArray[np.bool_] = (rows["phase"] == Phase.TRACK) & (np.abs(rows["mission_t_s"]) < MAX_RUN_US / 1e6)
    return tracking


def missions(rows: NDArray[np.void]) -> list[NDArray[np.void]]:
    """Return the ticks of each mission that was flown, one after the other."""
    during = tracking_rows(rows)
    return np.split(during, _begins(during["mission_t_s"]))


def newest_mission(rows: NDArray[np.void]) -> NDArray[np.void]:
    """Return the ticks of the mission that was flown last: an operator may have set another, which begins anew."""
    return missions(rows)[-1]


def goal_ned_m(mission: NDArray[np.void]) -> Array | None:
    """Return the place (3,) at which the reference of a mission has come to rest; None while it moves."""
    last = mission["ref_pos_ned_m"][-_LAST_TICKS:]
    return None if not len(last) or np.ptp(last, axis=0).max() >= _AT_REST_M else np.asarray(last[-1])


def unbroken_mission_t_s(rows: NDArray[np.void]) -> Array:
    """Return the mission time (T,) of ticks of a mission, which goes on where another mission begins in flight."""
    times_s: Array = rows["mission_t_s"].astype(np.float64)
    for begin in _begins(times_s):
        elapsed_s = float(rows["t_us"][begin] - rows["t_us"][begin - 1]) * 1e-6
        times_s[begin:] += times_s[begin - 1] + elapsed_s - times_s[begin]
    return times_s


def _begins(times_s: Array) -> NDArray[np.intp]:
    """Return the ticks at which mission time (T,) begins again."""
    return np.flatnonzero(np.diff(times_s) < -_AGAIN_S) + 1


def mission_start_us(ticks: Mapping[int, NDArray[np.void]], time_field: str) -> float | None:
    """Return the instant of mission time 0 in the clock named by `time_field`; None without a mission."""
    for rows in ticks.values():
        tracking = tracking_rows(rows)
        if len(tracking):
            return float(tracking[time_field][0]) - 1e6 * float(tracking["mission_t_s"][0])
    return None


def time_zero(ticks: Mapping[int, NDArray[np.void]], tracks: Tracks) -> tuple[float, str]:
    """Return the instant from which verdict and report count, and what it is: mission start, of the first mission.

    Without a mission it is the first arming, and the first tick where nobody was armed.
    """
    start_us = mission_start_us(ticks, tracks.time_field)
    if start_us is not None:
        return start_us, "mission start"
    if len(tracks.t_us):
        return float(tracks.t_us[0]), "the first arming"
    firsts_us = [float(rows[tracks.time_field][0]) for rows in ticks.values() if len(rows)]
    return min(firsts_us, default=0.0), "the first tick"


def utc_offset_us(ticks: Mapping[int, NDArray[np.void]]) -> float:
    """Return UTC minus monotonic time of the host [us]; 0 when nothing was recorded."""
    for rows in ticks.values():
        if len(rows):
            utc_us: NDArray[np.int64] = rows["utc_us"]
            t_us: NDArray[np.int64] = rows["t_us"]
            return float(np.median(utc_us - t_us))
    return 0.0


def merge_tracks(ticks: Mapping[int, NDArray[np.void]], truth: NDArray[np.void], agents: int) -> Tracks:
    """Return positions at common instants: every instant of the simulator, else reports interpolated to 50 Hz.

    A report counts at the time of its state, not at the tick that repeats it: a vehicle that is no longer received has
    no position, however often its last one was recorded.
    """
    return _true_tracks(truth, agents) if len(truth) else _reported_tracks(ticks, agents)


def _true_tracks(truth: NDArray[np.void], agents: int) -> Tracks:
    rows = truth[truth["vehicle"] < agents]
    armed = rows["armed"] != 0
    if not armed.any():
        return Tracks(np.zeros(0), np.zeros((0, agents, 3)), "t_us")
    rows = rows[rows["t_us"] >= rows["t_us"][armed].min()]
    t_us, instant = np.unique(rows["t_us"], return_inverse=True)
    pos_ned_m = np.full((len(t_us), agents, 3), np.nan)
    pos_ned_m[instant, rows["vehicle"]] = rows["pos_ned_m"]
    return Tracks(t_us.astype(np.float64), pos_ned_m, "t_us")


def _reported_tracks(ticks: Mapping[int, NDArray[np.void]], agents: int) -> Tracks:
    known = {agent: rows[_located(rows)] for agent, rows in ticks.items() if agent < agents}
    armed_us = [int(rows["utc_us"][rows["armed"] != 0].min()) for rows in known.values() if rows["armed"].any()]
    nothing = Tracks(np.zeros(0), np.zeros((0, agents, 3)), "utc_us")
    if not armed_us:
        return nothing
    first_us, last_us = min(armed_us), max(int(rows["utc_us"].max()) for rows in known.values() if len(rows))
    if last_us - first_us > MAX_RUN_US:
        return nothing
    t_us = np.arange(first_us, last_us + 1, GRID_US)
    pos_ned_m = np.full((len(t_us), agents, 3), np.nan)
    for agent, rows in known.items():
        pos_ned_m[:, agent] = _reported_positions(rows, "utc_us", t_us)
    return Tracks(t_us.astype(np.float64), pos_ned_m, "utc_us")


def _located(rows: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return a mask (T,) of ticks that contain a position, of whatever age."""
    located: NDArray[np.bool_] = np.isfinite(rows["pos_ned_m"]).all(axis=1) & np.isfinite(rows["state_age_ms"])
    return located


def located_states_us(rows: NDArray[np.void]) -> Array:
    """Return the monotonic times of the states in ticks whose vehicle was heard."""
    heard = rows[_located(rows) & (rows["state_age_ms"] <= _STALE_MS)]
    return np.unique(heard["t_us"] - heard["state_age_ms"].astype(np.float64) * 1e3)


def _reported_positions(rows: NDArray[np.void], time_field: str, at_us: NDArray[np.int64]) -> Array:
    """Return the reported positions (T, 3) at instants (T,); each report counts at the time of its state.

    At 5 m/s the 10 ms that a state is old at a tick, on average, are 5 cm.
    """
    located = rows[_located(rows)]
    age_us = np.clip(located["state_age_ms"].astype(np.float64) * 1e3, 0.0, MAX_RUN_US)
    of_us, newest = np.unique(located[time_field] - np.round(age_us).astype(np.int64), return_index=True)
    return interpolate(at_us, of_us, located["pos_ned_m"][newest], GAP_US)


def unseen_spans(rows: NDArray[np.void], time_field: str) -> list[tuple[float, float]]:
    """Return the intervals in which an armed vehicle's position was stale or unknown, from known to known position.

    Also unknown is what was between two ticks, or two states, that are too far apart to interpolate. Between states it
    begins at the older one: the ticks that bring them may follow each other.
    """
    if not len(rows):
        return []
    t_us, armed, located = rows[time_field].astype(np.float64), rows["armed"] != 0, _located(rows)
    age_us = np.where(located, rows["state_age_ms"] * 1e3, np.nan)
    unseen = armed & ~(located & (rows["state_age_ms"] <= _STALE_MS))
    ticks_missing = (np.diff(t_us) > GAP_US) & (armed[:-1] | armed[1:])
    states_missing = (np.diff(t_us - age_us) > GAP_US) & armed[:-1] & armed[1:]
    hidden = unseen[:-1] | unseen[1:] | ticks_missing | states_missing  # (T - 1,) of the times between rows
    edges = np.flatnonzero(np.diff(np.concatenate([[False], hidden, [False]])))
    begins_us = np.where(states_missing & ~ticks_missing, t_us[:-1] - age_us[:-1], t_us[:-1])
    return [(float(begins_us[first]), float(t_us[end])) for first, end in edges.reshape(-1, 2)]


def interpolate(at_us: NDArray[np.int64], t_us: NDArray[np.int64], values: Array, gap_us: int) -> Array:
    """Interpolate rows (T, k) at `t_us` (T,) linearly to `at_us`; NaN outside and in gaps longer than `gap_us`."""
    if not len(t_us):
        return np.full((len(at_us), values.shape[1]), np.nan)
    base = t_us[0]  # float64 would lose digits on microseconds of UTC
    at, t = (at_us - base).astype(np.float64), (t_us - base).astype(np.float64)
    result = np.column_stack([np.interp(at, t, values[:, k]) for k in range(values.shape[1])])
    after = np.clip(np.searchsorted(t_us, at_us), 1, max(1, len(t_us) - 1))
    if len(t_us) > 1:
        result[(t_us[after] - t_us[after - 1]) > gap_us] = np.nan
    result[(at_us < t_us[0]) | (at_us > t_us[-1])] = np.nan
    return result


def true_positions(rows: NDArray[np.void], truth: NDArray[np.void], agent: int) -> Array:
    """Return positions (T, 3) of an agent's vehicle at each tick: of the truth, else of its reports; else NaN."""
    if not len(truth):
        return _reported_positions(rows, "t_us", rows["t_us"])
    own = truth[truth["vehicle"] == agent]
    return interpolate(rows["t_us"], own["t_us"], own["pos_ned_m"], GAP_US)


def shared_references(ticks: Mapping[int, NDArray[np.void]]) -> dict[int, list[int]]:
    """Return the agents that have flown the same reference in their newest mission, by the lowest number among them.

    Agents tick at different instants: references are compared at the same mission times.
    """
    found: dict[int, list[int]] = {}
    flown = {agent: newest_mission(rows) for agent, rows in sorted(ticks.items())}
    for agent, rows in flown.items():
        if len(rows):
            same = (other for other in found if _apart_01(rows, flown[other]) < _DIFFERENT_01)
            found.setdefault(next(same, agent), []).append(agent)
    return found


def _apart_01(rows: NDArray[np.void], others: NDArray[np.void]) -> float:
    """Return the fraction of the mission time of both agents in which their references are apart."""
    times_s: NDArray[np.float64] = rows["mission_t_s"]
    others_s: NDArray[np.float64] = others["mission_t_s"]
    others_ned_m: NDArray[np.float64] = others["ref_pos_ned_m"]
    both = (times_s >= others_s[0]) & (times_s <= others_s[-1])
    if not both.any():
        return 1.0
    theirs = [np.interp(times_s[both], others_s, others_ned_m[:, k]) for k in range(3)]
    apart_m = np.linalg.norm(rows["ref_pos_ned_m"][both] - np.column_stack(theirs), axis=1)
    return float(np.mean(apart_m > _SAME_M))


def track_error(rows: NDArray[np.void], truth: NDArray[np.void], agent: int) -> TrackError:
    """Return the tracking error of one agent at each tick of the mission with known position and reference."""
    during = _is_tracking(rows)
    tracking = rows[during]
    ref_ned_m: NDArray[np.float64] = tracking["ref_pos_ned_m"]
    error_ned_m = true_positions(rows, truth, agent)[during] - ref_ned_m
    known = np.isfinite(error_ned_m).all(axis=1)
    error_ned_m = error_ned_m[known]
    return TrackError(
        unbroken_mission_t_s(tracking)[known],
        error_ned_m,
        np.linalg.norm(error_ned_m, axis=1),
        float(tracking["mission_t_s"][known][-1]) if known.any() else 0.0,
    )
