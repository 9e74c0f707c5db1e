"""An own controller: a linear-quadratic regulator of each axis, flown by configs/examples/own_lqr.toml."""

import numpy as np
from pydantic import Field
from scipy.linalg import solve_discrete_are

from swarmctl.control.controllers.own import FeedbackController
from swarmctl.core.params import Params


class LqrParams(Params):
    q_pos: float = Field(20.0, gt=0, le=1e4)  # weight of the position error
    q_vel: float = Field(2.0, ge=0, le=1e4)  # weight of the velocity error
    r: float = Field(1.0, gt=0, le=1e4)  # weight of the acceleration


class Lqr(FeedbackController):
    Params = LqrParams

    def __init__(self, params, setup, dt_s, steps):
        super().__init__(params, setup, dt_s, steps)
        a, b = np.array([[1.0, dt_s], [0.0, 1.0]]), np.array([[0.5 * dt_s**2], [dt_s]])
        cost = solve_discrete_are(a, b, np.diag([params.q_pos, params.q_vel]), np.array([[params.r]]))
        self._gain = np.linalg.solve(params.r + b.T @ cost @ b, b.T @ cost @ a)[0]  # of position and velocity

    def accel_ned_m_s2(self, pos, vel, wanted_pos, wanted_vel, wanted_accel):
        return wanted_accel + self._gain[0] * (wanted_pos - pos) + self._gain[1] * (wanted_vel - vel)
