"""What the controller believes of its vehicle: delay, lag, drag, bounds, and where it will be when a setpoint acts.

The model knows no mass: thrust enters as acceleration (thrust over mass), and the estimator in
`swarmctl.control.estimation.disturbance` finds the hover thrust that converts it to the autopilot's 0..1.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from pydantic import Field

from swarmctl.control.lag import Lag
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned, rotate_to_ned
from swarmctl.core.params import Params
from swarmctl.core.types import Array, VehicleState


class VehicleModelParams(Params):
    """Bounds and lags of the airframe, not of the controller."""

    delay_s: float = Field(0.06, ge=0, le=1)  # dead time: from sending a setpoint to the body beginning to follow it
    attitude_rad_s: float = Field(0.0, ge=0, le=100)  # natural frequency of the attitude's answer; 0: follows at once
    attitude_damping: float = Field(1.0, ge=0.3, le=3)  # of that answer
    drag_1_s: float = Field(0.0, ge=0, le=10)  # linear drag over mass
    hover_thrust_01: float = Field(0.5, gt=0.05, lt=0.95)  # first guess; estimated in flight
    thrust_min_01: float = Field(0.05, ge=0, lt=1)  # motors keep turning
    thrust_max_01: float = Field(1.0, gt=0, le=1)
    tilt_max_rad: float = Field(0.6, gt=0, lt=1.5)

    def lag(self) -> Lag | None:
        """How attitude setpoints are followed; None at once."""
        return Lag(self.attitude_rad_s, self.attitude_damping) if self.attitude_rad_s > 0 else None

    def u_max(self) -> float:
        """Largest horizontal part of the body's down axis."""
        return math.sin(self.tilt_max_rad)


class Predictor:
    """Own motion from the newest sample to the moment a setpoint sent now acts.

    After the dead time the thrust is there at once and the attitude follows its lag, from the measured attitude and
    body rates on. Without a lag the body flies the command of `t - delay`.
    """

    def __init__(self, params: VehicleModelParams) -> None:
        self._delay_us = round(params.delay_s * 1e6)
        self._lag, self._drag_1_s = params.lag(), params.drag_1_s
        self._sent: deque[tuple[int, Array]] = deque(maxlen=128)  # time it acts from, virtual controls (3,)

    @property
    def delay_us(self) -> int:
        """From sending to acting [us]."""
        return self._delay_us

    def sent(self, now_us: int, virtual_control: Array) -> None:
        """Remember a command: virtual controls (3,), which act after the delay."""
        self._sent.append((now_us + self._delay_us, virtual_control))

    def clear(self) -> None:
        """Forget what was sent: somebody else has flown."""
        self._sent.clear()

    def acting(self, t_us: int) -> Array | None:
        """Virtual controls (3,) that have passed the dead time at `t_us`; None before the first."""
        acting = None
        for start_us, virtual_control in self._sent:
            if start_us > t_us:
                break
            acting = virtual_control
        return acting

    def start(self, state: VehicleState, until_us: int, disturbance_ned_m_s2: Array, held: Array) -> Start:
        """Where a plan begins that acts from `until_us` on, after `held` (3,) was commanded last.

        The remembered commands act one after the other, each from its own time; before the first one the vehicle is
        taken to hold itself against the disturbance.
        """
        pos, vel, t_us = state.pos_ned_m, state.vel_ned_m_s, state.t_us
        down = body_z_ned(state.q_nb)
        tilt, rate = down[:2], tilt_rate(state)
        current = None if not self._sent else self._sent[0][1]
        for start_us, virtual_control in self._sent:
            if start_us > t_us:
                if start_us >= until_us:
                    break
                pos, vel, tilt, rate = self._advance(
                    pos, vel, tilt, rate, current, disturbance_ned_m_s2, start_us - t_us
                )
                t_us = start_us
            current = virtual_control
        left_us = max(0, until_us - t_us)
        pos, vel, tilt, rate = self._advance(pos, vel, tilt, rate, current, disturbance_ned_m_s2, left_us)
        if self._lag is None:
            return Start(until_us, pos, vel, float(down[2]), held)
        cos_tilt = math.sqrt(max(0.0, 1.0 - float(tilt @ tilt)))
        return Start(until_us, pos, vel, cos_tilt, held, tilt, rate)

    def _advance(
        self,
        pos: Array,
        vel: Array,
        tilt: Array,
        rate: Array,
        command: Array | None,
        disturbance_ned_m_s2: Array,
        for_us: int,
    ) -> tuple[Array, Array, Array, Array]:
        dt_s = for_us * 1e-6
        if command is None:
            return pos + vel * dt_s, vel, tilt, rate
        flown = command
        if self._lag is not None and for_us > 0:
            ends = [self._lag.advance(float(tilt[i]), float(rate[i]), float(command[i]), dt_s) for i in (0, 1)]
            tilt, rate = np.array([end[0] for end in ends]), np.array([end[1] for end in ends])
            flown = np.array([ends[0][2] / dt_s, ends[1][2] / dt_s, command[2]])
        pos, vel = _moved(pos, vel, acceleration(flown) + disturbance_ned_m_s2, self._drag_1_s, dt_s)
        return pos, vel, tilt, rate


def tilt_rate(state: VehicleState) -> Array:
    """Rate (2,) [1/s] of the horizontal part of the body's down axis."""
    p, q, _ = (float(w) for w in state.rate_frd_rad_s)
    return rotate_to_ned(state.q_nb, np.array([q, -p, 0.0]))[:2]


def acceleration(virtual_control: Array) -> Array:
    """Acceleration (3,) NED of virtual controls (u_x, u_y, thrust over mass), gravity included (thesis 3.2)."""
    ux, uy, thrust = (float(c) for c in virtual_control)
    down = max(0.0, 1.0 - ux * ux - uy * uy) ** 0.5
    return np.array([-thrust * ux, -thrust * uy, GRAVITY_M_S2 - thrust * down])


def _moved(pos: Array, vel: Array, accel: Array, drag_1_s: float, dt_s: float) -> tuple[Array, Array]:
    if drag_1_s == 0.0:
        return pos + vel * dt_s + (0.5 * dt_s * dt_s) * accel, vel + dt_s * accel
    kept = math.exp(-drag_1_s * dt_s)
    gained_s = (1.0 - kept) / drag_1_s
    return pos + gained_s * vel + ((dt_s - gained_s) / drag_1_s) * accel, kept * vel + gained_s * accel
