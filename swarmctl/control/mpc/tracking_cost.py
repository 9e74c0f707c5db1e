"""The cost of a condensed MPC: squared errors to the reference, squared increments, and the cost beyond the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.mpc.axes import Axis
from swarmctl.control.mpc.prediction import Forecast, Prediction
from swarmctl.control.mpc.terminal import TerminalRegion, terminal_region
from swarmctl.core.types import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class _Parts:
    """Holds what the responses to increments alone decide of the cost, which is the same for all steps of one gain."""

    curvature: Array  # (axes, Hc, Hc) of the errors, in scaled increments
    pull: Array  # (2, axes, Hp, Hc) slope of unit errors of position and velocity
    beyond: dict[int, Array]  # by axis with a terminal region: (3, Hc) slope of unit errors at the end


class TrackingCost:
    """Fills Hessian and slope of the scaled increments, which the scale of the cost brings to about 1."""

    def __init__(self, prediction: Prediction) -> None:
        self._prediction, axes = prediction, prediction.axes
        self._regions = {i: self._region(a) for i, a in enumerate(axes) if a.terminal == "region"}
        self.scale = 1.0 / max(self._largest(), 1e-12)
        self._own = [prediction.columns(i) for i in range(len(axes))]
        weights = np.array([[a.q_pos for a in axes], [a.q_vel for a in axes]])  # (2, axes)
        du_max = prediction.du_max
        self._weight = 2.0 * self.scale * (weights * du_max)[:, :, None, None]  # (2, axes, 1, 1)
        self._du_max = du_max[:, None, None]  # (axes, 1, 1)
        on_moves = 2.0 * self.scale * np.array([a.r for a in axes]) * du_max**2
        self._on_moves = on_moves[:, None, None] * np.eye(prediction.horizon.control)  # (axes, Hc, Hc)
        self._unit = self._parts(prediction.unit_response, prediction.acted[:, -1])

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

    def _parts(self, response: Array, end_accel: Array) -> _Parts:
        """Return the cost's parts for responses (2, axes, Hp, Hc), and (axes, Hc) of the acceleration at the end."""
        pull = self._weight * response
        curvatures = self._du_max * (pull.swapaxes(2, 3) @ response)
        curvature, beyond = curvatures[0] + curvatures[1], dict[int, Array]()
        for i, region in self._regions.items():
            end = np.stack([response[0, i, -1], response[1, i, -1], end_accel[i]])  # (3, Hc)
            du_max = float(self._du_max[i, 0, 0])
            beyond[i] = (2.0 * self.scale * du_max) * (region.beyond @ end)
            curvature[i] += du_max * (beyond[i].T @ end)
        return _Parts(curvature=curvature, pull=pull, beyond=beyond)

    def fill(self, hessian: Array, slope: Array, forecast: Forecast) -> None:
        """Write the Hessian (moves, moves) and the linear cost (moves,) of one step."""
        gain = forecast.asked.gain_m_s2
        if len(gain) == 1:  # the same over all steps
            parts, factor = self._unit, gain[0, :, None]
            curvature = (factor * factor)[:, :, None] * parts.curvature + self._on_moves
        else:
            parts = self._parts(forecast.response, gain[-1, :, None] * self._prediction.acted[:, -1])
            factor, curvature = np.ones((len(self._own), 1)), parts.curvature + self._on_moves
        pulls = (forecast.error.swapaxes(1, 2)[:, :, None] @ parts.pull)[:, :, 0]
        pull = pulls[0] + pulls[1]  # (axes, Hc)
        for i, beyond in parts.beyond.items():
            pull[i] += np.array(self._end_error(i, forecast)) @ beyond
        for i, own in enumerate(self._own):
            hessian[own, own] = curvature[i]
        slope[: pull.size] = (factor * pull).ravel()

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
