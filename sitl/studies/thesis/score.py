"""Figures of a flight, all from true states, as the thesis defines them (its 2.6, 2.7 and Table 19)."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from sitl.studies.thesis.trace import Trace
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Array
from swarmctl.telemetry.evaluation.referee import STEADY_AFTER_S


def mean_distance_m(trace: Trace) -> float:
    """Return the mean Euclidean distance of the first vehicle to its reference (2.7)."""
    return float(_distance_m(trace)[:, 0].mean())


def mse_m2(trace: Trace, axis: int) -> float:
    """Return the mean squared error of the first vehicle on one axis (2.6)."""
    return float((_error_m(trace)[:, 0, axis] ** 2).mean())


def steady_rmse_m(trace: Trace) -> float:
    """Return the largest root mean squared error of the first vehicle on any axis after 10 s."""
    error = _error_m(trace)[trace.t_s >= STEADY_AFTER_S, 0]
    return float(np.sqrt((error**2).mean(axis=0)).max())


def index_m(trace: Trace, after_s: float = 0.0) -> float:
    """Return the sum over agents of the mean distance to the shared reference (Table 19)."""
    return float(_distance_m(trace)[trace.t_s >= after_s].mean(axis=0).sum())


def among_agents_m(trace: Trace) -> float:
    """Return the sum of the mean distances of all pairs of agents: the other reading of "among the agents" (4.4)."""
    pos, pairs = trace.pos_ned_m, combinations(range(trace.pos_ned_m.shape[1]), 2)
    return float(sum(np.linalg.norm(pos[:, i] - pos[:, j], axis=1).mean() for i, j in pairs))


def separation_m(trace: Trace) -> float:
    """Return the smallest distance of two agents at any step; infinite for one agent."""
    return float(np.fmin.reduce(closest_pair_m(trace.pos_ned_m), initial=math.inf))


def clearance_m(trace: Trace) -> float:
    """Return the smallest distance of an agent to the centre of an obstacle; infinite without obstacles."""
    centers = [np.array(obstacle.center_ned_m) for obstacle in trace.obstacles]
    return min((float(np.linalg.norm(trace.pos_ned_m - c, axis=2).min()) for c in centers), default=math.inf)


def _error_m(trace: Trace) -> Array:
    return trace.pos_ned_m - trace.ref_pos_ned_m  # (T, N, 3)


def _distance_m(trace: Trace) -> Array:
    return np.asarray(np.linalg.norm(_error_m(trace), axis=2))  # (T, N)
