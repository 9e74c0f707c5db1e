"""What an agent knows of its own vehicle's motion: state and disturbance, and the state that a plan begins from."""

from __future__ import annotations

import numpy as np

from swarmctl.control.estimation.disturbance import DisturbanceObserver, Estimate
from swarmctl.control.estimation.state_filter import StateFilter
from swarmctl.control.model import Predictor, VehicleModelParams, acceleration
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned
from swarmctl.core.types import Array, FlightMode, VehicleState

_AUTOPILOT_HOVER_MODES = (FlightMode.HOLD, FlightMode.EXTERNAL)  # ArduCopter takes off by itself in the latter
_BRAKES_01 = 0.05  # share by which thrust may be less than hovering takes at the end of a climb, while it slows down


class OwnState:
    """Estimates what moves the vehicle, and predicts its state to the time at which a setpoint acts.

    Args:
        model: what the vehicle does with a setpoint.
        estimator: of state and disturbance.
    """

    def __init__(self, model: VehicleModelParams, estimator: DisturbanceObserver | StateFilter) -> None:
        self._estimator, self._predictor = estimator, Predictor(model)
        self._virtual_control = np.array([0.0, 0.0, GRAVITY_M_S2])  # (3,) sent last
        self._thrust_01 = model.hover_thrust_01  # sent last
        self._taken_us: int | None = None  # time of the newest state

    @property
    def delay_us(self) -> int:
        """Return the time from sending a setpoint to when it acts."""
        return self._predictor.delay_us

    @property
    def estimate(self) -> Estimate:
        """Return the newest estimate of disturbance and hover thrust."""
        return self._estimator.estimate

    @property
    def setpoint_accel_ned_m_s2(self) -> Array:
        """Return the acceleration (3,) that the last setpoint asks for, with what disturbs the vehicle, drag aside."""
        return acceleration(self._virtual_control) + self._estimator.estimate.disturbance_ned_m_s2

    def update(self, state: VehicleState, hover_thrust_01: float | None, *, controls: bool) -> None:
        """Take in the newest state, which may be that of the last tick.

        Args:
            state: of the vehicle.
            hover_thrust_01: thrust with which the autopilot hovers by itself; None if unknown.
            controls: the vehicle follows the agent's setpoints.
        """
        if state.t_us == self._taken_us:
            return
        self._taken_us = state.t_us
        self._estimator.update(state, self._thrust_01 if controls else None)
        if controls or hover_thrust_01 is None:
            return
        level_01 = hover_thrust_01 * float(body_z_ned(state.q_nb)[2])
        differs_01 = abs(level_01 / self.estimate.hover_thrust_01 - 1.0)
        if state.mode in _AUTOPILOT_HOVER_MODES or (state.mode is FlightMode.TAKEOFF and differs_01 > _BRAKES_01):
            self._estimator.learn_hover(level_01)

    def start(self, state: VehicleState, act_us: int, *, controls: bool) -> Start:
        """Return where a plan begins whose first setpoint acts at `act_us`."""
        if controls:
            disturbance_ned_m_s2 = self._estimator.estimate.disturbance_ned_m_s2
            return self._predictor.start(
                self._estimator.state(state), act_us, disturbance_ned_m_s2, self._virtual_control
            )
        self._virtual_control = np.array([0.0, 0.0, GRAVITY_M_S2])
        return Start(
            t_us=act_us,
            pos_ned_m=state.pos_ned_m,
            vel_ned_m_s=state.vel_ned_m_s,
            cos_tilt=float(body_z_ned(state.q_nb)[2]),
            virtual_control=self._virtual_control,
        )

    def sent(self, now_us: int, virtual_control: Array, thrust_01: float) -> None:
        """Note what the setpoint of this tick commands, (3,)."""
        self._virtual_control, self._thrust_01 = virtual_control, thrust_01
        self._predictor.sent(now_us, virtual_control)

    def reset(self) -> None:
        """Begin anew: until now the vehicle was flown by its autopilot."""
        self._predictor.clear()
        self._estimator.reset()
