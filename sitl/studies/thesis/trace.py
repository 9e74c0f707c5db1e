"""Results of a reproduced experiment: the flight as arrays, and its rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array

Path = Literal["plant", "full"]  # plant: model only; full: full MAVLink loop
Beside = Literal["beaten", "equal", "worse", "too close"]  # see `verdicts.MEANING`

SHORT_M = 0.01  # tolerated shortfall of a true distance from the constraint radius


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
    bound_source: str = ""  # formula or command that gives the lower bound
    decimals: int | None = None  # with which the published figure is printed; None: compared as it is
    short_m: float = 0.0  # by how much the flight falls short of the distances that the published one keeps
    matched_start: bool = False  # the flight begins with the reference's velocity instead of at rest
    preset: str = ""  # what the flown values of the controller are called
    differs: tuple[str, ...] = ()  # in what they differ from the thesis' values; none: they are the thesis'

    @property
    def met(self) -> bool | None:
        """Whether the limit is kept; None without a limit."""
        return None if self.limit is None else self.ours <= self.limit

    @property
    def out_of_reach(self) -> bool:
        """Whether no controller can keep the limit: the lower bound is above it. Such a limit still is missed."""
        return self.limit is not None and self.lower_bound is not None and self.lower_bound > self.limit

    @property
    def beside(self) -> Beside | None:
        """How the row stands beside the published figure; None without one. A figure that is no number is worse."""
        if self.published is None:
            return None
        ours = self.ours if self.decimals is None or not math.isfinite(self.ours) else round(self.ours, self.decimals)
        if math.isclose(ours, self.published, rel_tol=1e-9, abs_tol=1e-12):
            return "equal"
        if not ours < self.published:
            return "worse"
        return "beaten" if self.short_m <= SHORT_M else "too close"
