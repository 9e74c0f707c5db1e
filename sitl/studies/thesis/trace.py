"""Results of a reproduced experiment: the flight as arrays, and its rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.obstacle import Obstacle

Array = NDArray[np.float64]
Path = Literal["plant", "full"]  # plant: model only; full: full MAVLink loop


@dataclass(frozen=True, slots=True, kw_only=True)
class Trace:
    """One flight from mission start to mission end, true states at every tick of 0.02 s.

    The setpoint at index k is the one computed from the state at index k. NaN where nothing was recorded: torques exist
    in model-only flights only.
    """

    name: str  # unique name of the flight: "circle 0.90 dmpc"
    path: Path
    t_s: Array  # (T,)
    pos_ned_m: Array  # (T, N, 3)
    vel_ned_m_s: Array  # (T, N, 3)
    euler_rad: Array  # (T, N, 3) roll, pitch, yaw
    ref_pos_ned_m: Array  # (T, N, 3)
    euler_ref_rad: Array  # (T, N, 3) attitude setpoint
    thrust_n: Array  # (T, N)
    torque_n_m: Array  # (T, N, 3)
    failed: int  # plans that could not be flown
    terminal_missed: int | None  # plans whose terminal condition was not met; None where it was not recorded
    obstacles: tuple[Obstacle, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of `reproduce.json`; lower is better in every row."""

    name: str
    published: float | None
    ours: float
    limit: float | None  # required value
    path: Path
    unit: str
    note: str = ""
    lower_bound: float | None = None  # the theoretical lower bound, where it is known

    @property
    def met(self) -> bool | None:
        """Whether the limit is kept; None without a limit."""
        return None if self.limit is None else self.ours <= self.limit
