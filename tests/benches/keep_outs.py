"""Predicted paths and keep-outs of simple shape, for tests of distances."""

from __future__ import annotations

import numpy as np

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.types import Array, PredictedPath
from tests import builders

UTC_US = 1_700_000_000_000_000
DT_US = 100_000
STEPS = 10
PARAMS = SeparationParams(
    stop_m_s2=1.4, approach_01=0.0
)  # radius 0.9, slack 0.1, 4 m/s2 of age, at most 1 m, brake 3 m/s2, lost after 0.5 s


def peer(points: Array, dt_us: int = DT_US, radius_m: float = 0.0, agent: int = 1) -> PredictedPath:
    return builders.predicted_path(agent=agent, t0_utc_us=UTC_US, dt_us=dt_us, margin_m=radius_m, pos_ned_m=points)


def straight(speed_m_s: float, points: int = 6, dt_us: int = DT_US) -> PredictedPath:
    """Return points along north from the origin."""
    north = np.arange(points) * speed_m_s * dt_us * 1e-6
    return peer(np.stack([north, np.zeros(points), np.full(points, -2.0)], axis=1), dt_us)


def fixed(place: tuple[float, float, float], allowed_m: float, any_height: bool = False, steps: int = STEPS) -> KeepOut:
    return builders.keep_out(
        pos_ned_m=np.tile(place, (steps + 1, 1)),
        radius_m=allowed_m + 0.1,
        hard_min_distance_m=allowed_m,
        any_height=any_height,
    )


def line(start: tuple[float, float, float], end: tuple[float, float, float], steps: int = STEPS) -> Array:
    return np.linspace(start, end, steps + 1)
