"""The prediction of a condensed MPC: positions and velocities over the horizon, due to increments of the inputs.

Every axis obeys `p'' = gain(k) a + drift - drag p'`, where `a` is the input u or, with a lag, what follows it. Between
the Hc steps at which it may change, and after them, the input is constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.control.lag import lag_response
from swarmctl.control.mpc.condensed_qp.axes import AxesProblem, Axis, HalfSpaces, Horizon
from swarmctl.core.types import Array

_DECIDED_S = 0.12  # motion within this time after the dead time can hardly be changed
_ROW_SPACING_S = 0.08  # closer rows are nearly parallel, which slows a first-order solver down


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """Holds what cost and constraints of one step need: the motion without increments, and responses to them.

    The first axis of motions and responses is 0 for positions [m] and 1 for velocities [m/s].
    """

    asked: AxesProblem
    half_spaces: HalfSpaces | None
    u_prev: Array  # (axes,) held input, within its bounds
    accel_m_s2: Array  # (Hp, axes) over each step, without increments
    free: Array  # (2, Hp, axes) motion at steps 1..Hp, without increments
    error: Array  # (2, Hp, axes) of the free motion to the reference
    response: Array  # (2, axes, Hp, Hc) to unit increments

    @property
    def free_pos_m(self) -> Array:
        """Return positions (Hp, axes) without increments."""
        return np.asarray(self.free[0])

    @property
    def free_vel_m_s(self) -> Array:
        """Return velocities (Hp, axes) without increments."""
        return np.asarray(self.free[1])

    @property
    def pos_response(self) -> Array:
        """Return displacements (axes, Hp, Hc) [m] of unit increments."""
        return np.asarray(self.response[0])

    @property
    def vel_response(self) -> Array:
        """Return changes of velocity (axes, Hp, Hc) [m/s] by unit increments."""
        return np.asarray(self.response[1])


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
        step, blocks = np.array([a.du_max for a in axes])[:, None], horizon.blocks()
        self.du_max = step * blocks  # (axes, Hc)
        self.pos_of_accel, self.vel_of_accel = horizon.of_acceleration()  # (Hp, Hp) each
        self._of_accel = np.stack([self.pos_of_accel, self.vel_of_accel])  # (2, Hp, Hp)
        self._of_vel = np.stack(horizon.of_velocity_s())[:, :, None]  # (2, Hp, 1)
        self.hold = horizon.held()  # (Hp, Hc) inputs of a unit increment
        like = np.ones((len(axes), horizon.control + 1))  # operands of one shape are quicker than broadcast ones
        self._least, self._most = (bound[:, None] * like for bound in (self.u_min, self.u_max))
        ramps = step * np.append(0.0, blocks.cumsum())
        self._ramps = np.stack([ramps, -ramps])  # (2, axes, Hc+1) from the held input on
        self._has_lag = any(a.lag is not None for a in axes)
        self._lags = [lag_response(a.lag, horizon.dt_s, horizon.prediction) for a in axes]
        self.acted = np.stack([lag.of_command @ self.hold for lag in self._lags])  # (axes, Hp, Hc) realised inputs
        first, stride = self.first_row(), max(1, round(_ROW_SPACING_S / horizon.dt_s))
        self.checked = np.arange(horizon.prediction - 1, first - 1, -stride)[::-1]  # 0-based steps that get rows
        self.row_steps = np.append(self.checked, horizon.prediction - 1)  # those of the rows; the last looks beyond

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

    def motion(self, pos_m: Array, vel_m_s: Array, accel_m_s2: Array) -> Array:
        """Return positions and velocities (2, Hp, axes) under accelerations (Hp, axes) held over each step."""
        coasting = self._of_vel * vel_m_s
        coasting[0] += pos_m
        return np.asarray(coasting + self._of_accel @ accel_m_s2)

    def forecast(self, asked: AxesProblem, half_spaces: HalfSpaces | None) -> Forecast:
        """Return the forecast of one receding-horizon step."""
        gain_m_s2 = asked.gain_m_s2
        u_prev = np.minimum(np.maximum(asked.u_prev, self.u_min), self.u_max)
        acts = u_prev  # (axes,), or (Hp, axes) with a lag
        if self._has_lag:
            held = np.broadcast_to(u_prev, gain_m_s2.shape)
            acts = self.realised(held, asked.realised, asked.realised_1_s)
        accel = gain_m_s2 * acts + asked.drift_m_s2  # (Hp, axes)
        free = self.motion(asked.pos_m, asked.vel_m_s, accel)
        error = np.empty(free.shape)
        np.subtract(free[0], asked.ref_pos_m, out=error[0])
        np.subtract(free[1], asked.ref_vel_m_s, out=error[1])
        driven = gain_m_s2.T[:, :, None] * self.acted  # (axes, Hp, Hc)
        return Forecast(
            asked=asked,
            half_spaces=half_spaces,
            u_prev=u_prev,
            accel_m_s2=accel,
            free=free,
            error=error,
            response=self._of_accel[:, None] @ driven,
        )

    def extremes(self, u_prev: Array) -> Array:
        """Return increments (2, axes, Hc) that raise inputs, and that lower them, as fast as the bounds allow."""
        inputs = np.minimum(np.maximum(u_prev[:, None] + self._ramps, self._least), self._most)
        return np.asarray(inputs[:, :, 1:] - inputs[:, :, :-1])

    def increments(self, x: Array | None, u_prev: Array) -> Array:
        """Return increments (axes, Hc) of a solution, within both bounds exactly; zeros without a solution."""
        shape = len(self.axes), self.horizon.control
        if x is None:
            return np.zeros(shape)
        moves = x[: shape[0] * shape[1]].reshape(shape)
        wanted = np.minimum(np.maximum(moves, -1.0), 1.0) * self.du_max
        inputs = u_prev[:, None] + wanted.cumsum(axis=1)
        inputs = np.minimum(np.maximum(inputs, self._least[:, 1:]), self._most[:, 1:])
        inputs[:, 1:] -= inputs[:, :-1]
        inputs[:, 0] -= u_prev
        return np.asarray(inputs)

    def scaled(self, increments: Array) -> Array:
        """Return increments (axes, Hc) as variables (moves,) of the program."""
        return np.asarray(increments / self.du_max).ravel()
