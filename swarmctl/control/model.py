"""The controller's model of its vehicle: delay, lag, drag, bounds, and prediction to when a setpoint acts.

The model knows no mass: thrust enters as acceleration (thrust over mass), and the estimator in
`swarmctl.control.estimation.disturbance` finds the hover thrust that converts it to the autopilot's 0..1.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

import numpy as np
from pydantic import Field

from swarmctl.control.lag import Lag
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned, rotate_to_ned
from swarmctl.core.params import Params
from swarmctl.core.types import Array, VehicleState

_NOTICE_S = 0.15  # until a change of the wind is known by its effect


class VehicleModelParams(Params):
    """Sets bounds and lags of the airframe, independent of the controller."""

    delay_s: float = Field(0.06, ge=0, le=1)  # dead time from sending a setpoint to the first response
    attitude_rad_s: float = Field(0.0, ge=0, le=100)  # natural frequency of the attitude response; 0: immediate
    attitude_damping: float = Field(1.0, ge=0.3, le=3)  # damping ratio of the attitude response
    drag_1_s: float = Field(0.0, ge=0, le=10)  # linear drag over mass
    hover_thrust_01: float = Field(0.5, gt=0.05, lt=0.95)  # initial value; estimated in flight
    thrust_min_01: float = Field(0.05, ge=0, lt=1)  # keeps motors turning
    thrust_max_01: float = Field(1.0, gt=0, le=1)  # largest thrust that is asked for
    tilt_max_rad: float = Field(0.6, gt=0, lt=1.5)  # largest tilt that is asked for, by every controller and protection
    speed_max_m_s: float = Field(20.0, gt=0, le=100)  # a mission whose reference is faster is refused

    def lag(self) -> Lag | None:
        """Return the lag of the attitude behind its setpoints; None if it follows at once."""
        return Lag(self.attitude_rad_s, self.attitude_damping) if self.attitude_rad_s > 0 else None

    def u_max(self) -> float:
        """Return the largest horizontal part of the body's down axis."""
        return math.sin(self.tilt_max_rad)

    def thrust_range_m_s2(self) -> tuple[float, float]:
        """Return the least and the largest thrust over mass, by the hover thrust that is assumed at first."""
        per_01 = GRAVITY_M_S2 / self.hover_thrust_01
        return per_01 * self.thrust_min_01, per_01 * self.thrust_max_01

    def drift_m(self, gust_m_s: float, accel_max_m_s2: float) -> float:
        """Return how far a sudden wind blows a vehicle that hovers, until its controller has stopped it again.

        For as long as the controller does not react, v' = drag (wind - v); then all the authority that the wind
        leaves brakes. x500 in the simulator, 4 and 8 m/s: 0.43 and 1.23 m; by this 0.47 and 1.40 m.

        Args:
            gust_m_s: change of the wind.
            accel_max_m_s2: largest horizontal acceleration of the controller.
        """
        lag = self.lag()
        blind_s = _NOTICE_S + self.delay_s + (0.0 if lag is None else lag.ramp_delay_s)
        if self.drag_1_s == 0.0 or gust_m_s == 0.0:
            return 0.0
        kept = math.exp(-self.drag_1_s * blind_s)
        speed_m_s = gust_m_s * (1.0 - kept)
        drifted_m = gust_m_s * (blind_s - (1.0 - kept) / self.drag_1_s)
        authority_m_s2 = accel_max_m_s2 - self.drag_1_s * (gust_m_s - speed_m_s)
        return math.inf if authority_m_s2 <= 0.0 else drifted_m + 0.5 * speed_m_s * speed_m_s / authority_m_s2


class Predictor:
    """Predicts the own motion from the newest sample to the time at which a setpoint sent now acts.

    After the dead time the thrust acts at once and the attitude follows its lag, from the measured attitude and body
    rates on. Without a lag the body follows the command of `t - delay`.
    """

    def __init__(self, params: VehicleModelParams) -> None:
        self._delay_us = round(params.delay_s * 1e6)
        self._lag, self._drag_1_s = params.lag(), params.drag_1_s
        self._sent: deque[tuple[int, Array]] = deque(maxlen=128)  # time from which it acts, virtual controls (3,)

    @property
    def delay_us(self) -> int:
        """Return the time from sending to acting [us]."""
        return self._delay_us

    def sent(self, now_us: int, virtual_control: Array) -> None:
        """Remember a command, virtual_control controls (3,), that acts after the delay."""
        self._sent.append((now_us + self._delay_us, virtual_control))

    def clear(self) -> None:
        """Forget remembered commands, after a handover."""
        self._sent.clear()

    def start(self, state: VehicleState, until_us: int, disturbance_ned_m_s2: Array, held: Array) -> Start:
        """Return the start of a plan that acts from `until_us` on, after `held` (3,) was commanded last.

        The remembered commands act one after the other, each from its own time. Before the first one the vehicle is
        assumed to compensate the disturbance.
        """
        t_us, sent = state.t_us, self._sent
        while len(sent) > 1 and sent[1][0] <= t_us:
            sent.popleft()  # time does not go back
        motion = _Motion(state, disturbance_ned_m_s2, self._lag, self._drag_1_s)
        current = sent[0][1].tolist() if sent else None
        for start_us, virtual_control in sent:
            if start_us >= until_us:
                break
            if start_us > t_us:
                motion.advance(current, start_us - t_us)
                t_us = start_us
            current = virtual_control.tolist()
        motion.advance(current, max(0, until_us - t_us))
        return motion.start(until_us, held)


class _Motion:
    """Moves by the model from a measured state on, held command by held command; in plain numbers, which are few."""

    def __init__(self, state: VehicleState, disturbance_ned_m_s2: Array, lag: Lag | None, drag_1_s: float) -> None:
        self._pos, self._vel = state.pos_ned_m.tolist(), state.vel_ned_m_s.tolist()
        self._disturbance, self._lag, self._drag_1_s = disturbance_ned_m_s2.tolist(), lag, drag_1_s
        *self._tilt, self._down = body_z_ned(state.q_nb).tolist()
        self._rate = [0.0, 0.0] if lag is None else tilt_rate(state).tolist()

    def advance(self, command: list[float] | None, for_us: int) -> None:
        """Move by a time in which a command acts; None: one that compensates the disturbance."""
        dt_s = for_us * 1e-6
        if command is None:
            self._pos = [p + v * dt_s for p, v in zip(self._pos, self._vel, strict=True)]
            return
        ux, uy, thrust = command
        if self._lag is not None and for_us > 0:
            self._tilt[0], self._rate[0], x_s = self._lag.advance(self._tilt[0], self._rate[0], ux, dt_s)
            self._tilt[1], self._rate[1], y_s = self._lag.advance(self._tilt[1], self._rate[1], uy, dt_s)
            ux, uy = x_s / dt_s, y_s / dt_s
        for i, (pushed, disturbed) in enumerate(zip(acceleration((ux, uy, thrust)), self._disturbance, strict=True)):
            pos, vel, accel = self._pos[i], self._vel[i], pushed + disturbed
            self._pos[i], self._vel[i] = _moved(pos, vel, accel, self._drag_1_s, dt_s=dt_s)

    def start(self, t_us: int, held: Array) -> Start:
        """Return where a plan begins that acts from now on, after `held` (3,) was commanded last."""
        pos, vel = np.array(self._pos), np.array(self._vel)
        if self._lag is None:
            return Start(t_us=t_us, pos_ned_m=pos, vel_ned_m_s=vel, cos_tilt=self._down, virtual_control=held)
        x, y = self._tilt
        return Start(
            t_us=t_us,
            pos_ned_m=pos,
            vel_ned_m_s=vel,
            cos_tilt=math.sqrt(max(0.0, 1.0 - (x * x + y * y))),
            virtual_control=held,
            tilt=np.array(self._tilt),
            tilt_rate_1_s=np.array(self._rate),
        )


def tilt_rate(state: VehicleState) -> Array:
    """Return the rate (2,) [1/s] of the horizontal part of the body's down axis."""
    p, q, _ = state.rate_frd_rad_s.tolist()
    return rotate_to_ned(state.q_nb, np.array([q, -p, 0.0]))[:2]


def acceleration(virtual_control: Iterable[float]) -> tuple[float, float, float]:
    """Return the acceleration NED [m/s2] of virtual controls (3,), gravity included (thesis 3.2)."""
    ux, uy, thrust = virtual_control
    down = max(0.0, 1.0 - ux * ux - uy * uy) ** 0.5
    return -thrust * ux, -thrust * uy, GRAVITY_M_S2 - thrust * down


def _moved(pos: float, vel: float, accel: float, drag_1_s: float, *, dt_s: float) -> tuple[float, float]:
    if drag_1_s == 0.0:
        return pos + vel * dt_s + (0.5 * dt_s * dt_s) * accel, vel + dt_s * accel
    kept = math.exp(-drag_1_s * dt_s)
    gained_s = (1.0 - kept) / drag_1_s
    return pos + gained_s * vel + ((dt_s - gained_s) / drag_1_s) * accel, kept * vel + gained_s * accel
