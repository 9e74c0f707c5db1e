"""Computes roll, pitch and tilt of whole recordings at once; `core.frames` handles single quaternions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.types import Array


def roll_pitch_rad(q_nb: NDArray[np.floating]) -> Array:
    """Return roll and pitch (T, 2) [rad] of quaternions (T, 4) wxyz body -> NED; NaN stays NaN."""
    w, x, y, z = np.asarray(q_nb, np.float64).T
    roll_rad = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch_rad = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return np.column_stack([roll_rad, pitch_rad])


def tilt_rad(q_nb: NDArray[np.floating]) -> Array:
    """Return tilts (T,) [rad] from level of quaternions (T, 4) wxyz body -> NED; NaN stays NaN."""
    _, x, y, _ = np.asarray(q_nb, np.float64).T
    return np.asarray(np.arccos(np.clip(1.0 - 2.0 * (x**2 + y**2), -1.0, 1.0)))
