"""What a controller is asked each tick: one frozen noun for every kind of controller, and for whoever records it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from swarmctl.control.collision.separation import KeepOut
from swarmctl.core.types import Array, Reference


@dataclass(frozen=True, slots=True)
class Start:
    """Where a plan begins: the predicted own state when its first setpoint acts."""

    t_us: int
    pos_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    cos_tilt: float  # cos(phi) cos(theta) now
    virtual_control: Array  # (3,) u_x, u_y, thrust over mass now held
    tilt: Array = field(default_factory=lambda: np.zeros(2))  # (2,) u_x, u_y realised, of a vehicle with a lag
    tilt_rate_1_s: Array = field(default_factory=lambda: np.zeros(2))  # (2,)


@dataclass(frozen=True, slots=True)
class Problem:
    """One tick's question."""

    start: Start
    reference: Reference  # at least the controller's `longest` + 1 points from `start.t_us` on
    disturbance_ned_m_s2: Array  # (3,) taken as constant
    keep_outs: tuple[KeepOut, ...]  # peers and obstacles, aligned with the plan's times
    guess_ned_m: Array | None  # (steps+1, 3) own previous prediction at the new times; None for constant velocity
