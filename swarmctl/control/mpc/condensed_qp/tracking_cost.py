"""The cost of a condensed MPC: squared errors to the reference, squared increments, and the cost beyond the end.

Agents plan at the same time, each with what the others planned before: Jacobi iterations, in which exact answers
overshoot. A proximal term, the squared difference to the increments planned before, damps them, as in the proximal
Jacobian ADMM (Deng, Lai, Peng and Yin, J. Sci. Comput. 71, 2017, eq. 1.5). It vanishes where plans stay the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.mpc.condensed_qp.axes import Axis
from swarmctl.control.mpc.condensed_qp.prediction import Forecast, Prediction
from swarmctl.control.mpc.condensed_qp.terminal import TerminalRegion, terminal_region
from swarmctl.core.types import Array


class TrackingCost:
    """Fills Hessian and slope of the scaled increments, which the scale of the cost brings to about 1."""

    def __init__(self, prediction: Prediction) -> None:
        self._prediction, axes = prediction, prediction.axes
        self._regions = {i: self._region(a) for i, a in enumerate(axes) if a.terminal == "region"}
        self.scale = 1.0 / max(self._largest(), 1e-12)
        self._own, hc = [prediction.columns(i) for i in range(len(axes))], prediction.horizon.control
        self._moves = np.arange(hc)
        like, square = np.ones((len(axes), hc)), np.ones((len(axes), hc, hc))  # quicker than broadcast operands
        du_max = prediction.du_max
        weights = np.array([[a.q_pos for a in axes], [a.q_vel for a in axes]])  # (2, axes)
        self._slope_weight, self._weight = weights[:, :, None] * like, weights[:, :, None, None] * square
        self._r = np.array([np.diag(a.r / prediction.horizon.blocks()) for a in axes])  # (axes, Hc, Hc), as if ramped
        self._proximal = np.array([a.proximal for a in axes])[:, None] * like  # (axes, Hc)
        self._slope_factor = 2.0 * du_max * self.scale  # (axes, Hc)
        self._factor = 2.0 * (du_max[:, :, None] * du_max[:, None, :]) * self.scale  # (axes, Hc, Hc)

    def _region(self, axis: Axis) -> TerminalRegion:
        """Return the terminal region of an axis, in units of acceleration."""
        gain = axis.gain_m_s2
        room = min(axis.u_max - axis.u_rest, axis.u_rest - axis.u_min)
        return terminal_region(
            axis.q_pos,
            axis.q_vel,
            axis.r / gain**2,
            gain * room,
            daccel_max_m_s2=gain * axis.du_max,
            dt_s=self._prediction.horizon.dt_s,
        )

    def _largest(self) -> float:
        """Return the largest diagonal entry of the Hessian of errors, under nominal gains."""
        ahead, largest = self._prediction, 0.0
        for i, axis in enumerate(ahead.axes):
            pos, vel = ahead.pos_of_accel @ ahead.acted[i], ahead.vel_of_accel @ ahead.acted[i]  # (Hp, Hc)
            gram = axis.q_pos * pos.T @ pos + axis.q_vel * vel.T @ vel
            if i in self._regions:
                end = np.stack([pos[-1], vel[-1], ahead.acted[i, -1]])  # (3, Hc)
                gram += end.T @ self._regions[i].beyond @ end
            largest = max(largest, 2.0 * (axis.du_max * axis.gain_m_s2) ** 2 * float(np.max(np.diag(gram))))
        return largest

    def pattern(self) -> NDArray[np.bool_]:
        """Return the entries (moves, moves) of the Hessian that may differ from 0: a block for each axis."""
        hc = self._prediction.horizon.control
        return np.kron(np.eye(len(self._prediction.axes), dtype=bool), np.ones((hc, hc), bool))

    def fill(self, hessian: Array, slope: Array, forecast: Forecast) -> None:
        """Write the Hessian (moves, moves) and the linear cost (moves,) of one step."""
        response = forecast.response
        gram = self._weight * (response.swapaxes(2, 3) @ response)
        curvature = gram[0] + gram[1]  # (axes, Hc, Hc)
        errors = forecast.error.swapaxes(1, 2)[:, :, None]  # (2, axes, 1, Hp)
        pulls = self._slope_weight * (errors @ response)[:, :, 0]
        pull = pulls[0] + pulls[1]  # (axes, Hc)
        for i, region in self._regions.items():
            end = self._end_response(i, forecast)
            weighted = end.T @ region.beyond
            curvature[i] += weighted @ end
            pull[i] += weighted @ np.array(self._end_error(i, forecast))
        curvature = self._factor * (curvature + self._r)
        pull = self._slope_factor * pull
        if (before := forecast.asked.before) is not None:
            weight = self._proximal * self._factor[:, self._moves, self._moves]
            curvature[:, self._moves, self._moves] += weight
            pull -= weight * before
        for i, own in enumerate(self._own):
            hessian[own, own] = curvature[i]
        slope[: pull.size] = pull.ravel()

    def _end_response(self, i: int, forecast: Forecast) -> Array:
        """Return position, velocity and acceleration (3, Hc) at the end, due to unit increments of axis `i`."""
        end = np.empty((3, self._prediction.horizon.control))
        end[:2] = forecast.response[:, i, -1]
        end[2] = forecast.asked.gain_m_s2[-1, i] * self._prediction.acted[i, -1]
        return end

    def _end_error(self, i: int, forecast: Forecast) -> tuple[float, float, float]:
        """Return errors of position, velocity and acceleration at the end of the free motion of axis `i`."""
        pos_m, vel_m_s = forecast.error[:, -1, i].tolist()
        ref_m_s, horizon = forecast.asked.ref_vel_m_s[-2:, i].tolist(), self._prediction.horizon
        ref_m_s2 = (ref_m_s[-1] - ref_m_s[0]) / horizon.dt_s
        return pos_m, vel_m_s, float(forecast.accel_m_s2[-1, i]) - horizon.drag_1_s * ref_m_s[-1] - ref_m_s2

    def outside_m(self, forecast: Forecast, motion: Array, increments: Array) -> float:
        """Return how far [m] a motion (2, Hp, axes), due to `increments` (axes, Hc), ends outside of its regions."""
        asked, farthest_m = forecast.asked, 0.0
        for i, region in self._regions.items():
            accel = self._end_error(i, forecast)[2]
            accel += float(asked.gain_m_s2[-1, i]) * float(self._prediction.acted[i, -1] @ increments[i])
            pos_m, vel_m_s = motion[:, -1, i].tolist()
            error = (pos_m - float(asked.ref_pos_m[-1, i]), vel_m_s - float(asked.ref_vel_m_s[-1, i]), accel)
            farthest_m = max(farthest_m, region.outside_m(np.array(error)))
        return farthest_m
