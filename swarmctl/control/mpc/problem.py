"""The problem a controller solves each tick, the same type for every kind of controller and for recorders."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from swarmctl.control.collision.keep_outs import KeepOut
from swarmctl.core.types import Array, Reference


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Holds the initial state of a plan: the own state, predicted to when its first setpoint acts."""

    t_us: int
    pos_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    cos_tilt: float  # cos(phi) cos(theta) now
    virtual_control: Array  # (3,) u_x, u_y, thrust over mass held now
    tilt: Array = field(default_factory=lambda: np.zeros(2))  # (2,) realised u_x, u_y of a vehicle with a lag
    tilt_rate_1_s: Array = field(default_factory=lambda: np.zeros(2))  # (2,) rate of `tilt`

    def at_constant_velocity(self, steps: int, dt_s: float) -> tuple[Array, Array]:
        """Return positions and velocities (steps+1, 3) from the start on, without any acceleration."""
        t_s = np.arange(steps + 1)[:, None] * dt_s
        return self.pos_ned_m + t_s * self.vel_ned_m_s, np.tile(self.vel_ned_m_s, (steps + 1, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Holds the problem of one tick."""

    start: Start
    reference: Reference  # at least the controller's `longest` + 1 points from `start.t_us` on
    disturbance_ned_m_s2: Array  # (3,) constant over the horizon
    keep_outs: tuple[KeepOut, ...]  # peers and obstacles, aligned with the plan's times
    guess_ned_m: Array | None  # (steps+1, 3) own previous prediction at the new times; None for constant velocity
    ground_z_m: float | None = None  # down coordinate of the place of the take-off; None where it is not known
