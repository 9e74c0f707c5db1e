"""The cost of a condensed MPC: squared errors to the reference, squared increments, and the cost beyond the end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.mpc.axes import Axis
from swarmctl.control.mpc.prediction import Forecast, Prediction
from swarmctl.control.mpc.terminal import TerminalRegion, terminal_region
from swarmctl.core.types import Array


class TrackingCost:
    """Fills Hessian and slope of the scaled increments, which the scale of the cost brings to about 1."""

    def __init__(self, prediction: Prediction) -> None:
        self._prediction = prediction
        self._regions = {i: self._region(a) for i, a in enumerate(prediction.axes) if a.terminal == "region"}
        self.scale = 1.0 / max(self._largest(), 1e-12)

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
        hc = self._prediction.horizon.control
        for i, axis in enumerate(self._prediction.axes):
            own, pos, vel = self._prediction.columns(i), forecast.pos_response[i], forecast.vel_response[i]
            curvature = axis.q_pos * (pos.T @ pos) + axis.q_vel * (vel.T @ vel)
            pull = axis.q_pos * (forecast.pos_error_m[:, i] @ pos) + axis.q_vel * (forecast.vel_error_m_s[:, i] @ vel)
            if i in self._regions:
                end = self._end_response(i, forecast)
                weighted = end.T @ self._regions[i].beyond
                curvature += weighted @ end
                pull += weighted @ forecast.end_error[:, i]
            curvature.reshape(-1)[:: hc + 1] += axis.r  # the diagonal
            hessian[own, own] = (2.0 * axis.du_max**2 * self.scale) * curvature
            slope[own] = (2.0 * axis.du_max * self.scale) * pull

    def _end_response(self, i: int, forecast: Forecast) -> Array:
        """Return position, velocity and acceleration (3, Hc) at the end, due to unit increments of axis `i`."""
        accel = forecast.asked.gain_m_s2[-1, i] * self._prediction.acted[i, -1]
        return np.array([forecast.pos_response[i, -1], forecast.vel_response[i, -1], accel])

    def outside_m(self, forecast: Forecast, pos_m: Array, vel_m_s: Array, increments: Array) -> float:
        """Return how far [m] the end of a motion (Hp, axes) due to `increments` (Hc, axes) is outside its regions."""
        asked, farthest_m = forecast.asked, 0.0
        for i, region in self._regions.items():
            accel = forecast.end_error[2, i]
            accel += asked.gain_m_s2[-1, i] * float(self._prediction.acted[i, -1] @ increments[:, i])
            error = (pos_m[-1, i] - asked.ref_pos_m[-1, i], vel_m_s[-1, i] - asked.ref_vel_m_s[-1, i], accel)
            farthest_m = max(farthest_m, region.outside_m(np.array(error)))
        return farthest_m
