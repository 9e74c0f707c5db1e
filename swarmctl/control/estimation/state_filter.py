"""Kalman filter on the states reported by an autopilot: position, velocity, bias of that velocity, and disturbance.

An EKF that fuses GPS reports a velocity that is biased against its own position by 0.1 to 0.3 m/s, wandering over
seconds; a controller that uses it unfiltered circles beside its reference. Per axis, with the model's acceleration `a`
of the measured attitude and the acting thrust,

    p' = v,   v' = a + d - drag v + w_a,   b' = -b / T_b + w_b,   d' = w_d,      measured: p + n_p,  v + b + n_v.

The axes share one covariance, because their noises are equal and samples come for all at once. While the autopilot
flies, the acceleration is unknown: it is then modelled as noise, and d stays constant.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from pydantic import Field

from swarmctl.control.estimation.disturbance import DisturbanceParams, Estimate, HoverThrust
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned
from swarmctl.core.params import Params
from swarmctl.core.types import VehicleState

_POS, _VEL, _BIAS, _DIST = range(4)
_STALE_US = 200_000
_UNKNOWN_M_S2 = 3.0  # one sigma of the acceleration while the autopilot flies
_FIRST_M_S2 = 1.0  # one sigma of the disturbance when the agent takes control


class StateFilterParams(Params):
    """Noise model, one sigma each, of an autopilot's estimate; the filter is off for exact states."""

    enabled: bool = False  # true: filter reported states; for estimates with noise
    pos_m: float = Field(0.02, gt=0, le=10)  # noise of a reported position
    vel_m_s: float = Field(0.05, gt=0, le=10)  # noise of a reported velocity
    bias_m_s: float = Field(0.2, ge=0, le=10)  # wandering bias of a reported velocity
    bias_time_s: float = Field(4.0, gt=0, le=600)  # correlation time of that bias
    accel_m_s2: float = Field(0.5, gt=0, le=20)  # unmodelled acceleration, white, over one second
    disturbance_m_s2: float = Field(0.5, gt=0, le=20)  # random walk of the disturbance over one second
    jump_m: float = Field(1.0, gt=0, le=100)  # a larger position innovation restarts the filter: estimator reset


class StateFilter:
    """Filters reported states and estimates disturbance and hover thrust.

    Args:
        params: noise model.
        disturbance: limits and the hover thrust's time constant, shared with the observer; whether to estimate at all.
        model: drag, dead time and first guess of the hover thrust.

    Attributes:
        estimate: newest.
    """

    def __init__(self, params: StateFilterParams, disturbance: DisturbanceParams, model: VehicleModelParams) -> None:
        self._params, self._limit_m_s2, self._learns = params, disturbance.limit_m_s2, disturbance.enabled
        self._drag_1_s, self._delay_us = model.drag_1_s, round(model.delay_s * 1e6)
        self._hover = HoverThrust(model.hover_thrust_01, disturbance.hover_time_s)
        self._thrusts: deque[tuple[int, float]] = deque(maxlen=256)  # time it was sent, thrust 0..1
        self._mean = np.zeros((4, 3))
        self._covariance = np.zeros((4, 4))
        self._t_us: int | None = None
        self.estimate = self._estimated()

    def reset(self) -> None:
        """Begin to estimate the disturbance: from now on the acting thrust is known."""
        self._mean[_DIST] = 0.0
        self._covariance[_DIST] = self._covariance[:, _DIST] = 0.0
        if self._learns:
            self._covariance[_DIST, _DIST] = _FIRST_M_S2**2
        self._thrusts.clear()
        self.estimate = self._estimated()

    def learn_hover(self, thrust_01: float) -> None:
        """Move the hover thrust towards the autopilot's own, see `HoverThrust.learn`."""
        if self._learns:
            self._hover.learn(thrust_01)
        self.estimate = self._estimated()

    def update(self, state: VehicleState, thrust_01: float | None) -> Estimate:
        """Update with one new sample; `thrust_01` is the setpoint being sent, None while the autopilot flies."""
        if thrust_01 is not None:
            self._thrusts.append((state.t_us, thrust_01))
        since_us = 0 if self._t_us is None else state.t_us - self._t_us
        dt_s = since_us * 1e-6
        if not 0 < since_us < _STALE_US or self._jumped(state, dt_s):
            self._begin(state)
            return self.estimate
        self._t_us = state.t_us
        acted_01 = None if thrust_01 is None else self._acting(state.t_us, thrust_01)
        self._predict(state, acted_01, dt_s)
        self._correct(state)
        if acted_01 is not None and self._learns:
            self._mean[_DIST, 2] -= self._hover.explain(float(self._mean[_DIST, 2]), acted_01, dt_s)
            limited = np.minimum(np.maximum(self._mean[_DIST], -self._limit_m_s2), self._limit_m_s2)
            self._mean[_DIST] = limited
        self.estimate = self._estimated()
        return self.estimate

    def _estimated(self) -> Estimate:
        return Estimate(self._mean[_DIST].copy(), self._hover.value_01)

    def state(self, reported: VehicleState) -> VehicleState:
        """Return the state to plan from: filtered position and velocity at the time of the sample."""
        if self._t_us != reported.t_us:
            return reported
        return replace(reported, pos_ned_m=self._mean[_POS].copy(), vel_ned_m_s=self._mean[_VEL].copy())

    def _begin(self, state: VehicleState) -> None:
        p = self._params
        self._t_us = state.t_us
        disturbance, spread = self._mean[_DIST].copy(), self._covariance[_DIST, _DIST]
        self._mean = np.stack([state.pos_ned_m, state.vel_ned_m_s, np.zeros(3), disturbance])
        velocity = p.vel_m_s**2 + p.bias_m_s**2
        self._covariance = np.diag([p.pos_m**2, velocity, p.bias_m_s**2, spread])
        self._covariance[_VEL, _BIAS] = self._covariance[_BIAS, _VEL] = -(p.bias_m_s**2)

    def _jumped(self, state: VehicleState, dt_s: float) -> bool:
        off = state.pos_ned_m - (self._mean[_POS] + dt_s * self._mean[_VEL])
        return float(off @ off) > self._params.jump_m**2

    def _acting(self, t_us: int, newest_01: float) -> float:
        """Return the thrust setpoint that has passed the dead time at `t_us`."""
        acting_01 = newest_01 if not self._thrusts else self._thrusts[0][1]
        while self._thrusts and self._thrusts[0][0] + self._delay_us <= t_us:
            acting_01 = self._thrusts[0][1]
            if len(self._thrusts) == 1 or self._thrusts[1][0] + self._delay_us > t_us:
                break
            self._thrusts.popleft()
        return acting_01

    def _predict(self, state: VehicleState, thrust_01: float | None, dt_s: float) -> None:
        p, noise_m_s2 = self._params, self._params.accel_m_s2
        model, drag_1_s, walk = np.zeros(3), self._drag_1_s, p.disturbance_m_s2 if self._learns else 0.0
        if thrust_01 is None:
            noise_m_s2, drag_1_s, walk = _UNKNOWN_M_S2, 0.0, 0.0
        else:
            model = -(thrust_01 * GRAVITY_M_S2 / self._hover.value_01) * body_z_ned(state.q_nb)
            model[2] += GRAVITY_M_S2
        kept = max(0.0, 1.0 - dt_s / p.bias_time_s)
        push = 0.0 if thrust_01 is None else dt_s
        f = np.eye(4)
        f[_POS, _VEL] = dt_s
        f[_VEL, _VEL], f[_VEL, _DIST] = 1.0 - drag_1_s * dt_s, push
        f[_BIAS, _BIAS] = kept
        mean = f @ self._mean
        accel = model - drag_1_s * self._mean[_VEL] + (push / dt_s) * self._mean[_DIST]
        mean[_POS] += 0.5 * dt_s * dt_s * accel
        mean[_VEL] += dt_s * model
        self._mean = mean
        q, by_noise = np.zeros((4, 4)), noise_m_s2**2 * dt_s
        q[_POS, _POS], q[_VEL, _VEL] = (0.5 * dt_s) ** 2 * by_noise, by_noise
        q[_BIAS, _BIAS], q[_DIST, _DIST] = (1.0 - kept * kept) * p.bias_m_s**2, walk**2 * dt_s
        self._covariance = f @ self._covariance @ f.T + q

    def _correct(self, state: VehicleState) -> None:
        p = self._params
        innovation, seen, spread = np.empty((2, 3)), np.empty((2, 4)), np.empty((2, 2))
        innovation[0] = state.pos_ned_m - self._mean[_POS]
        innovation[1] = state.vel_ned_m_s - self._mean[_VEL] - self._mean[_BIAS]
        seen[0], seen[1] = self._covariance[_POS], self._covariance[_VEL] + self._covariance[_BIAS]  # H P
        spread[:, 0], spread[:, 1] = seen[:, _POS], seen[:, _VEL] + seen[:, _BIAS]
        spread[0, 0] += p.pos_m**2
        spread[1, 1] += p.vel_m_s**2
        gain = np.linalg.solve(spread, seen).T  # (4, 2)
        self._mean = self._mean + gain @ innovation
        self._covariance = self._covariance - gain @ seen
        self._covariance = 0.5 * (self._covariance + self._covariance.T)
