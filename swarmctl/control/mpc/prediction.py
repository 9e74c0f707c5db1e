"""The prediction of a condensed MPC: positions and velocities over the horizon, due to increments of the inputs.

Every axis obeys `p'' = gain(k) a + drift - drag p'`, where `a` is the input u or, with a lag, what follows it. After
the control horizon Hc the input is constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.control.lag import lag_response
from swarmctl.control.mpc.axes import AxesProblem, Axis, HalfSpaces, Horizon
from swarmctl.core.types import Array

_DECIDED_S = 0.12  # motion within this time after the dead time can hardly be changed


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """Holds what cost and constraints of one step need: the motion without increments, and responses to them."""

    asked: AxesProblem
    half_spaces: HalfSpaces | None
    u_prev: Array  # (axes,) held input, within its bounds
    free_pos_m: Array  # (Hp, axes) at steps 1..Hp, without increments
    free_vel_m_s: Array  # (Hp, axes)
    pos_response: Array  # (axes, Hp, Hc) metres of a unit increment
    vel_response: Array  # (axes, Hp, Hc)
    pos_error_m: Array  # (Hp, axes) of the free motion to the reference
    vel_error_m_s: Array  # (Hp, axes)
    end_error: Array  # (3, axes) of position, velocity and acceleration, at the end of the free motion


class Prediction:
    """Computes forecasts; all that does not depend on the step is computed once.

    Args:
        axes: weights and bounds of each axis.
        horizon: lengths and sample time.
    """

    def __init__(self, axes: tuple[Axis, ...], horizon: Horizon) -> None:
        self.axes, self.horizon = axes, horizon
        self.u_min = np.array([a.u_min for a in axes])
        self.u_max = np.array([a.u_max for a in axes])
        self.du_max = np.array([a.du_max for a in axes])
        self.pos_of_accel, self.vel_of_accel = horizon.of_acceleration()  # (Hp, Hp) each
        self._pos_of_vel, self._vel_of_vel = horizon.of_velocity_s()
        self.hold = horizon.held()  # (Hp, Hc) inputs of a unit increment
        self._ramps = [a.du_max * np.arange(horizon.control + 1) for a in axes]  # (Hc+1,) each, from the held input on
        self._has_lag = any(a.lag is not None for a in axes)
        self._lags = [lag_response(a.lag, horizon.dt_s, horizon.prediction) for a in axes]
        self.acted = np.stack([lag.of_command @ self.hold for lag in self._lags])  # (axes, Hp, Hc) realised inputs

    def columns(self, axis: int) -> slice:
        """Return the variables that are the increments of an axis."""
        return slice(axis * self.horizon.control, (axis + 1) * self.horizon.control)

    def first_row(self) -> int:
        """Return the 0-based index of the first step at which increments change a position noticeably."""
        slowest_s = max((a.lag.ramp_delay_s for a in self.axes if a.lag is not None), default=0.0)
        steps = math.ceil((_DECIDED_S + slowest_s) / self.horizon.dt_s - 1e-9)
        return min(steps, self.horizon.prediction - 1)

    def realised(self, u: Array, at_start: Array | None, rate_1_s: Array | None) -> Array:
        """Return mean realised inputs (Hp, axes) over each step, for commanded inputs `u` (Hp, axes).

        `at_start` (axes,) is the input realised at the start (None: the first command), `rate_1_s` (axes,) its rate
        (None: 0).
        """
        acts = np.empty(u.shape)
        for i, lag in enumerate(self._lags):
            if self.axes[i].lag is None:
                acts[:, i] = u[:, i]
                continue
            begins = u[0, i] if at_start is None else at_start[i]
            acts[:, i] = lag.of_command @ u[:, i] + begins * lag.of_tilt
            if rate_1_s is not None:
                acts[:, i] += rate_1_s[i] * lag.of_rate_s
        return acts

    def motion(self, pos_m: Array, vel_m_s: Array, accel_m_s2: Array) -> tuple[Array, Array]:
        """Return positions and velocities (Hp, axes) under accelerations (Hp, axes) held over each step."""
        pos = pos_m + self._pos_of_vel[:, None] * vel_m_s + self.pos_of_accel @ accel_m_s2
        return pos, self._vel_of_vel[:, None] * vel_m_s + self.vel_of_accel @ accel_m_s2

    def forecast(self, asked: AxesProblem, half_spaces: HalfSpaces | None) -> Forecast:
        """Return the forecast of one receding-horizon step."""
        gain_m_s2, ref_vel_m_s = asked.gain_m_s2, asked.ref_vel_m_s
        u_prev = np.minimum(np.maximum(asked.u_prev, self.u_min), self.u_max)
        acts = u_prev  # (axes,), or (Hp, axes) with a lag
        if self._has_lag:
            held = np.broadcast_to(u_prev, gain_m_s2.shape)
            acts = self.realised(held, asked.realised, asked.realised_1_s)
        accel = gain_m_s2 * acts + asked.drift_m_s2  # (Hp, axes)
        free_pos, free_vel = self.motion(asked.pos_m, asked.vel_m_s, accel)
        driven = gain_m_s2.T[:, :, None] * self.acted  # (axes, Hp, Hc)
        pos_error, vel_error = free_pos - asked.ref_pos_m, free_vel - ref_vel_m_s
        ref_accel = (ref_vel_m_s[-1] - ref_vel_m_s[-2]) / self.horizon.dt_s if len(ref_vel_m_s) > 1 else 0.0 * u_prev
        surplus = accel[-1] - self.horizon.drag_1_s * ref_vel_m_s[-1] - ref_accel
        return Forecast(
            asked=asked,
            half_spaces=half_spaces,
            u_prev=u_prev,
            free_pos_m=free_pos,
            free_vel_m_s=free_vel,
            pos_response=self.pos_of_accel @ driven,
            vel_response=self.vel_of_accel @ driven,
            pos_error_m=pos_error,
            vel_error_m_s=vel_error,
            end_error=np.array([pos_error[-1], vel_error[-1], surplus]),
        )

    def extremes(self, axis: int, u_prev: Array) -> tuple[Array, Array]:
        """Return increments (Hc,) of `axis` that raise, and that lower, its input as fast as the bounds allow."""
        bounds, held, ramp = self.axes[axis], u_prev[axis], self._ramps[axis]
        rise = np.minimum(held + ramp, bounds.u_max)
        fall = np.maximum(held - ramp, bounds.u_min)
        return rise[1:] - rise[:-1], fall[1:] - fall[:-1]

    def increments(self, x: Array | None, u_prev: Array) -> Array:
        """Return increments (Hc, axes) of a solution, within both bounds exactly; zeros without a solution."""
        hc, n = self.horizon.control, len(self.axes)
        if x is None:
            return np.zeros((hc, n))
        wanted = x[: n * hc].reshape(n, hc).T * self.du_max
        wanted = np.minimum(np.maximum(wanted, -self.du_max), self.du_max)
        inputs = np.empty((n, hc + 1)).T  # the held one first; the layout decides how sums over increments are rounded
        inputs[0] = u_prev
        inputs[1:] = np.minimum(np.maximum(u_prev + wanted.cumsum(axis=0), self.u_min), self.u_max)
        return np.asarray(inputs[1:] - inputs[:-1])
