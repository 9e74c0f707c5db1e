"""Estimates of the hover thrust and of a constant disturbance acceleration, for offset-free tracking.

The observer compares the measured velocity with the one predicted from the *measured* attitude and the sent thrust, so
that attitude lag is not taken for wind. Drag is that of the model, as everybody who uses the estimate has it, too. The
vertical disturbance is slowly moved into the hover thrust: a wrong mass or thrust scale then causes no altitude error,
and horizontal gains (thrust over mass) become right as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned
from swarmctl.core.params import Params
from swarmctl.core.types import Array, VehicleState

_GAP_US = 200_000  # a sample that is later does not continue the ones before


class DisturbanceParams(Params):
    """Bandwidths and limits of the estimators."""

    enabled: bool = True  # false: plans assume the nominal model
    bandwidth_rad_s: float = Field(2.0, gt=0, le=50)  # of the disturbance observer
    limit_m_s2: float = Field(15.0, gt=0, le=50)  # 8 m/s of wind and a gust on 1 1/s of drag are 12
    hover_time_s: float = Field(2.0, gt=0, le=600)  # time constant of the hover-thrust estimate


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated deviations from the nominal model."""

    disturbance_ned_m_s2: Array  # (3,)
    hover_thrust_01: float


class HoverThrust:
    """Estimates the thrust setpoint (0..1) that carries the weight, within 0.4 to 2.2 of the first guess.

    Args:
        hover_thrust_01: first guess.
        time_s: time constant.
    """

    def __init__(self, hover_thrust_01: float, time_s: float) -> None:
        self.value_01, self._time_s = hover_thrust_01, time_s
        self._least, self._most = 0.4 * hover_thrust_01, min(0.95, 2.2 * hover_thrust_01)

    def learn(self, thrust_01: float) -> None:
        """Move the estimate towards the thrust with which the autopilot itself hovers, before the bridge flies."""
        self.value_01 += 0.2 * (min(self._most, max(self._least, thrust_01)) - self.value_01)

    def explain(self, down_m_s2: float, thrust_01: float, dt_s: float) -> float:
        """Move a fraction of the vertical disturbance into the hover thrust; thrust g / hover must grow by -down_m_s2.

        Args:
            down_m_s2: estimated vertical disturbance, down positive.
            thrust_01: thrust setpoint that acted.
            dt_s: time since the last call.

        Returns:
            the acceleration moved [m/s2], to be subtracted from the disturbance.
        """
        share = dt_s / self._time_s
        specific = max(1.0, thrust_01 * GRAVITY_M_S2 / self.value_01)
        factor = 1.0 + share * down_m_s2 / specific
        hover = min(self._most, max(self._least, self.value_01 * factor))
        moved = specific * (hover / self.value_01 - 1.0)
        self.value_01 = hover
        return moved


class DisturbanceObserver:
    """Second-order observer of the disturbance on each velocity axis, with an integrating hover-thrust estimate.

    v_hat' = a_model + d - drag v_hat + l1 (v - v_hat), d' = l2 (v - v_hat), without drag with both poles at
    `bandwidth_rad_s`.

    Args:
        params: bandwidths and limits.
        hover_thrust_01: first guess of the hover thrust.
        drag_1_s: linear drag over mass in still air, which is no disturbance.

    Attributes:
        estimate: newest.
    """

    def __init__(self, params: DisturbanceParams, hover_thrust_01: float, drag_1_s: float = 0.0) -> None:
        self._params, self._drag_1_s = params, drag_1_s
        self._hover = HoverThrust(hover_thrust_01, params.hover_time_s)
        self._disturbance = [0.0, 0.0, 0.0]
        self._velocity: list[float] | None = None
        self._t_us = 0
        self.estimate = self._estimated()

    def reset(self) -> None:
        """Forget velocity and disturbance, not the hover thrust, after the vehicle was flown by its autopilot."""
        self._velocity = None
        self._disturbance = [0.0, 0.0, 0.0]
        self.estimate = self._estimated()

    def update(self, state: VehicleState, thrust_01: float | None) -> Estimate:
        """Update with one new sample; `thrust_01` has acted since the last one, None if it is unknown."""
        if not self._params.enabled or thrust_01 is None:
            return self.estimate
        before, since_us, self._t_us = self._velocity, state.t_us - self._t_us, state.t_us
        if before is None or not 0 < since_us < _GAP_US:
            self._velocity = state.vel_ned_m_s.tolist()
            return self.estimate
        dt_s = since_us * 1e-6
        specific_m_s2 = thrust_01 * GRAVITY_M_S2 / self._hover.value_01
        north, east, down = body_z_ned(state.q_nb).tolist()
        model = (-specific_m_s2 * north, -specific_m_s2 * east, -specific_m_s2 * down + GRAVITY_M_S2)
        pole, limit_m_s2 = self._params.bandwidth_rad_s, self._params.limit_m_s2
        taken_01, learned_1_s = min(1.0, 2.0 * pole * dt_s), dt_s * pole * pole
        kept_01, gained_s = 1.0, dt_s
        if self._drag_1_s:
            kept_01 = math.exp(-self._drag_1_s * dt_s)
            gained_s = (1.0 - kept_01) / self._drag_1_s
        velocity, disturbance = [0.0] * 3, [0.0] * 3
        for i, (measured, accel) in enumerate(zip(state.vel_ned_m_s.tolist(), model, strict=True)):
            predicted = kept_01 * before[i] + gained_s * (accel + self._disturbance[i])
            innovation = measured - predicted
            velocity[i] = predicted + taken_01 * innovation
            disturbance[i] = min(max(self._disturbance[i] + learned_1_s * innovation, -limit_m_s2), limit_m_s2)
        disturbance[2] -= self._hover.explain(disturbance[2], thrust_01, dt_s)
        self._velocity, self._disturbance = velocity, disturbance
        self.estimate = self._estimated()
        return self.estimate

    def _estimated(self) -> Estimate:
        return Estimate(np.array(self._disturbance), self._hover.value_01)

    def learn_hover(self, thrust_01: float) -> None:
        """Move the hover thrust towards the autopilot's own, see `HoverThrust.learn`."""
        if self._params.enabled:
            self._hover.learn(thrust_01)
            self.estimate = self._estimated()

    def state(self, reported: VehicleState) -> VehicleState:
        """Return the state to plan from, here the reported one."""
        return reported
