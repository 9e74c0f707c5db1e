"""What the controller believes of its vehicle: delay, bounds, and where the vehicle will be when a setpoint acts.

The model knows no mass: thrust enters as acceleration (thrust over mass), and the estimator in
`swarmctl.control.disturbance` finds the hover thrust that converts it to the autopilot's 0..1.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from pydantic import Field

from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.params import Params
from swarmctl.core.types import Array, VehicleState


class VehicleModelParams(Params):
    """Bounds and lags of the airframe, not of the controller."""

    delay_s: float = Field(0.06, ge=0, le=1)  # from sending a setpoint to the body having followed it
    hover_thrust_01: float = Field(0.5, gt=0.05, lt=0.95)  # first guess; estimated in flight
    thrust_min_01: float = Field(0.05, ge=0, lt=1)  # motors keep turning
    thrust_max_01: float = Field(1.0, gt=0, le=1)
    tilt_max_rad: float = Field(0.6, gt=0, lt=1.5)


class Predictor:
    """Own motion from the newest sample to the moment a setpoint sent now acts.

    Attitude lag and dead time are taken together as one delay: at time t the body flies the command of `t - delay`.
    """

    def __init__(self, params: VehicleModelParams) -> None:
        self._delay_us = round(params.delay_s * 1e6)
        self._sent: deque[tuple[int, Array]] = deque(maxlen=128)  # time it acts from, acceleration it causes

    @property
    def delay_us(self) -> int:
        """From sending to acting [us]."""
        return self._delay_us

    def sent(self, now_us: int, accel_ned_m_s2: Array) -> None:
        """Remember a command: the acceleration (3,) it causes once it acts, gravity included."""
        self._sent.append((now_us + self._delay_us, accel_ned_m_s2))

    def clear(self) -> None:
        """Forget what was sent: somebody else has flown."""
        self._sent.clear()

    def predict(self, state: VehicleState, until_us: int, disturbance_ned_m_s2: Array) -> tuple[Array, Array]:
        """Position and velocity (3,), (3,) at `until_us`.

        Piecewise constant acceleration: the remembered commands, each from when it acts; before the first one, none.
        """
        pos, vel, t_us = state.pos_ned_m, state.vel_ned_m_s, state.t_us
        current = np.zeros(3) - disturbance_ned_m_s2 if not self._sent else self._sent[0][1]
        for start_us, accel in self._sent:
            if start_us <= t_us:
                current = accel
                continue
            if start_us >= until_us:
                break
            pos, vel = _advance(pos, vel, current + disturbance_ned_m_s2, (start_us - t_us) * 1e-6)
            t_us, current = start_us, accel
        return _advance(pos, vel, current + disturbance_ned_m_s2, max(0, until_us - t_us) * 1e-6)


def acceleration(virtual: Array) -> Array:
    """Acceleration (3,) NED of virtual controls (u_x, u_y, thrust over mass), gravity included (thesis 3.2)."""
    ux, uy, thrust = (float(c) for c in virtual)
    down = max(0.0, 1.0 - ux * ux - uy * uy) ** 0.5
    return np.array([-thrust * ux, -thrust * uy, GRAVITY_M_S2 - thrust * down])


def _advance(pos: Array, vel: Array, accel: Array, dt_s: float) -> tuple[Array, Array]:
    return pos + vel * dt_s + (0.5 * dt_s * dt_s) * accel, vel + dt_s * accel
