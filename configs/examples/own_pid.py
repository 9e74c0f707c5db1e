"""An own controller in forty lines: a PID on position, flown by configs/examples/own_pid.toml."""

import numpy as np
from pydantic import Field

from swarmctl.control.controllers.own import FeedbackController
from swarmctl.core.params import Params


class PidParams(Params):
    kp: float = Field(4.0, ge=0, le=50)  # m/s2 per m
    ki: float = Field(0.5, ge=0, le=10)  # m/s2 per m s
    kd: float = Field(3.5, ge=0, le=50)  # m/s2 per m/s
    integral_max_m_s: float = Field(1.0, ge=0, le=100)


class Pid(FeedbackController):
    Params = PidParams

    def __init__(self, params, setup, dt_s, steps):
        super().__init__(params, setup, dt_s, steps)
        self._integral_m_s = np.zeros(3)

    def commands(self, problem):
        """Called once a tick: remember what has to be remembered, then plan by the law below."""
        error_m = problem.reference.pos_ned_m[0] - problem.start.pos_ned_m
        limit = self.params.integral_max_m_s
        self._integral_m_s = np.clip(self._integral_m_s + self.dt_s * error_m, -limit, limit)
        return super().commands(problem)

    def accel_ned_m_s2(self, pos, vel, wanted_pos, wanted_vel, wanted_accel):
        """Called for every step of the plan, on the model of the vehicle."""
        p = self.params
        feedback = p.kp * (wanted_pos - pos) + p.ki * self._integral_m_s + p.kd * (wanted_vel - vel)
        return wanted_accel + feedback

    def reset(self):
        self._integral_m_s = np.zeros(3)
