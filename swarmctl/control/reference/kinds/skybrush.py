"""References of a drone show in Skybrush's compiled format: each agent flies the trajectory of one drone.

The file is read when a configuration is loaded (`swarmctl/configuration/shows.py`), which puts the trajectories beside
its name; this module knows those only. A trajectory is a list of points at times, with the control points of the Bezier
curve that leads there from the point before: none for a straight line, two for a cubic curve.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import MissionKind, Place, mission_kind
from swarmctl.control.reference.kinds.csv_table import FRAMES_TO_NED, Frame, Row
from swarmctl.control.reference.polynomial import PiecewisePolynomial
from swarmctl.core.params import Params, Vec3
from swarmctl.core.types import Array, Sampled

_MOST_CONTROLS = 6  # a curve of degree 7, the highest that Skybrush flies


class ShowTrajectory(Params):
    """The trajectory of one drone; filled in when the show is read."""

    takeoff_s: float = Field(0.0, ge=0, le=36000)  # show time at which it begins
    points: Annotated[tuple[Row, ...], Field(strict=False)]  # t, x, y, z, and x, y, z of each control point before it


@mission_kind("skybrush")
class SkybrushParams(MissionKind):
    """Describes the flight of a drone show, from a `.skyc` file; x, y and z are metres, z up from the ground."""

    file: str = ""  # .skyc, beside this file
    frame: Frame = "nwu"  # of the show, whose geodetic location and orientation are not used
    origin_ned_m: Vec3 = (0.0, 0.0, 0.0)  # of the show, in the shared frame
    begin_s: float = Field(0.0, ge=0, le=36000)  # show time at which the mission begins, behind its take-off
    trajectories: tuple[ShowTrajectory, ...] = Field((), strict=False)  # filled in where a run is recorded

    def reference(self, place: Place) -> Sampled:
        flight, turn = _flight(self.trajectories[place.agent]), FRAMES_TO_NED[self.frame]

        def sampled(t_s: Array) -> tuple[Array, Array]:
            value, rate = flight.sample(t_s + self.begin_s)
            return value @ turn.T + np.array(self.origin_ned_m), rate @ turn.T

        return sampled

    def ends_s(self, place: Place) -> float:
        return _flight(self.trajectories[place.agent]).end_s - self.begin_s

    def problems(self, agents: int) -> Iterator[str]:
        if not self.file and not self.trajectories:
            yield "mission.skybrush.file: missing; name a .skyc file"
        elif len(self.trajectories) != agents:
            yield f"mission.skybrush.file: a show of {len(self.trajectories)} drones for swarm.agents = {agents}"
        for drone, trajectory in enumerate(self.trajectories):
            yield from (f"mission.skybrush: drone {drone}: {problem}" for problem in _problems(trajectory))


def _problems(trajectory: ShowTrajectory) -> Iterator[str]:
    """Yield what is wrong with each point, because files are made by programs and mended all at once."""
    points = trajectory.points
    if not points:
        yield "has no points"
    for i, row in enumerate(points):
        controls = (len(row) - 4) / 3
        if len(row) < 4 or not controls.is_integer():
            yield f"point {i}: {len(row)} numbers; a time, three coordinates, and three of each control point"
        elif controls > (_MOST_CONTROLS if i else 0):
            why = f"at most {_MOST_CONTROLS} are flown" if i else "nothing leads to the first point"
            yield f"point {i}: {controls:.0f} control points; {why}"
    times = [row[0] for row in points if row]
    late = [i for i, (before, after) in enumerate(itertools.pairwise(times), 1) if after <= before]
    yield from (f"point {i}: t = {times[i]:g} after {times[i - 1]:g}; times must increase" for i in late)


@lru_cache(maxsize=128)  # of every agent, whose reference is asked for several times
def _flight(trajectory: ShowTrajectory) -> PiecewisePolynomial:
    """Return a trajectory as polynomials of show time (t, x, y, z)."""
    rows = [np.array(row) for row in trajectory.points]
    knots_s = np.array([row[0] for row in rows]) + trajectory.takeoff_s
    if len(rows) == 1:  # it stays where it is
        return PiecewisePolynomial(knots_s=np.append(knots_s, knots_s + 1.0), coefficients=rows[0][None, None, 1:4])
    most = max(len(row) - 4 for row in rows) // 3 + 2
    coefficients = np.zeros((len(rows) - 1, most, 3))
    for i, (before, after) in enumerate(itertools.pairwise(rows)):
        curve = np.vstack([before[1:4], after[4:].reshape(-1, 3), after[1:4]])
        powers = _powers(curve, float(after[0] - before[0]))
        coefficients[i, : len(powers)] = powers
    return PiecewisePolynomial(knots_s=knots_s, coefficients=coefficients)


def _powers(curve: Array, span_s: float) -> Array:
    """Return the coefficients (n+1, 3) of the powers of time of a Bezier curve with n+1 points, flown in `span_s`."""
    degree, found = len(curve) - 1, np.empty_like(curve)
    for k in range(degree + 1):
        signs = [(-1.0) ** (i + k) * math.comb(k, i) for i in range(k + 1)]
        found[k] = math.comb(degree, k) * (np.array(signs) @ curve[: k + 1]) / span_s**k
    return found
