"""What the view is told of the flight that a configuration describes."""

from __future__ import annotations

import math

import numpy as np

from swarmctl.config import Config
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.types import Array
from swarmctl.telemetry.scene.viewed_flight import AgentBounds, ViewedFlight

_POINTS = 200  # of each reference, to find the bounds of the scene
_AT_REST_M_S = 0.01  # a reference that ends slower has a goal


def viewed_flight(config: Config) -> ViewedFlight:
    """Return what is shown of a flight; the scene holds all starts and references."""
    starts, times_s = np.array(config.starts_ned_m()), np.linspace(0.0, config.mission.duration_s, _POINTS)
    references = config.mission.references(starts, config.separation.budget.planned_m)
    flown = [reference.sample(times_s) for reference in references]
    points = np.concatenate([starts, *(pos_ned_m for pos_ned_m, _ in flown)])
    low, high = points.min(axis=0), points.max(axis=0)
    north_m, east_m, down_m = (0.5 * (low + high)).tolist()
    return ViewedFlight(
        agents=tuple(_bounds(config.model_of(agent), *flown[agent]) for agent in range(config.swarm.agents)),
        separation_m=config.separation.radius_m,
        violation_m=config.limits.min_separation_m,
        tick_ms=1e3 / config.agent.rate_hz,
        center_ned_m=(north_m, east_m, down_m),
        extent_m=max(2.0, float(np.max(high - low)) / 2 + config.separation.radius_m),
        obstacles=config.obstacles,
    )


def _bounds(model: VehicleModelParams, pos_ned_m: Array, vel_ned_m_s: Array) -> AgentBounds:
    """Return the bounds of one agent, with the end of its reference (T, 3) as its goal if it rests there."""
    north_m, east_m, down_m = pos_ned_m[-1].tolist()
    rests = math.hypot(*vel_ned_m_s[-1].tolist()) < _AT_REST_M_S
    return AgentBounds(
        tilt_max_rad=model.tilt_max_rad,
        thrust_min_01=model.thrust_min_01,
        thrust_max_01=model.thrust_max_01,
        goal_ned_m=(north_m, east_m, down_m) if rests else None,
    )
