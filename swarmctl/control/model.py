"""The controller's model of its vehicle: delay, lag, drag, bounds, and prediction to when a setpoint acts.

The model knows no mass: thrust enters as acceleration (thrust over mass), and the estimator in
`swarmctl.control.estimation.disturbance` finds the hover thrust that converts it to the autopilot's 0..1.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Literal

import numpy as np
from pydantic import Field

from swarmctl.control.lag import Lag
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2, body_z_ned, rotate_to_ned
from swarmctl.core.params import Params
from swarmctl.core.types import Array, VehicleState

_REMEMBERED = 512  # commands: more than the longest dead time holds at the highest rate, with a state that is late
_NOTICE_S = 0.17  # until a change of the wind is known by its effect, and tilt grows against it


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
    heading: Literal["euler", "swing_twist"] = "euler"  # how a tilted body is turned; swing_twist: as little as can be
    speed_max_m_s: float = Field(20.0, gt=0, le=100)  # far references are approached no faster; faster missions refused

    def lag(self) -> Lag | None:
        """Return the lag of the attitude behind its setpoints; None if it follows at once."""
        return Lag(self.attitude_rad_s, self.attitude_damping) if self.attitude_rad_s > 0 else None

    @property
    def lag_s(self) -> float:
        """Return the time by which an attitude is later than setpoints that change steadily, besides the dead time."""
        lag = self.lag()
        return 0.0 if lag is None else lag.ramp_delay_s

    @property
    def response_s(self) -> float:
        """Return the time by which accelerations are later than what asks for them: dead time, and lag of a ramp."""
        return self.delay_s + self.lag_s

    def u_max(self) -> float:
        """Return the largest horizontal part of the body's down axis."""
        return math.sin(self.tilt_max_rad)

    def thrust_range_m_s2(self) -> tuple[float, float]:
        """Return the least and the largest thrust over mass, by the hover thrust that is assumed at first."""
        per_01 = GRAVITY_M_S2 / self.hover_thrust_01
        return per_01 * self.thrust_min_01, per_01 * self.thrust_max_01

    def drift_m(self, gust_m_s: float, *, at_once_m_s2: float, accel_max_m_s2: float) -> float:
        """Return how far a sudden wind blows a vehicle that hovers, until its controller has stopped it again.

        For as long as the controller does not react, v' = drag (wind - v); then what the wind leaves of the authority
        brakes. That grows from tilted thrust of hovering to thrust that also keeps the height: the mean counts. x500 in
        the simulator, along an axis, by 4 and 8 m/s: 0.49 and 1.51 m; by this 0.51 and 1.64 m.

        Args:
            gust_m_s: change of the wind.
            at_once_m_s2: horizontal acceleration of the largest tilt at the thrust of hovering.
            accel_max_m_s2: largest horizontal acceleration that keeps the height.

        Returns:
            Infinity where the vehicle cannot stand in that wind.
        """
        blind_s = _NOTICE_S + self.response_s
        if self.drag_1_s == 0.0 or gust_m_s == 0.0:
            return 0.0
        if accel_max_m_s2 <= self.drag_1_s * gust_m_s:
            return math.inf
        kept = math.exp(-self.drag_1_s * blind_s)
        speed_m_s = gust_m_s * (1.0 - kept)
        drifted_m = gust_m_s * (blind_s - (1.0 - kept) / self.drag_1_s)
        authority_m_s2 = 0.5 * (at_once_m_s2 + accel_max_m_s2) - self.drag_1_s * (gust_m_s - speed_m_s)
        return math.inf if authority_m_s2 <= 0.0 else drifted_m + 0.5 * speed_m_s * speed_m_s / authority_m_s2


class Predictor:
    """Predicts the own motion from the newest sample to the time at which a setpoint sent now acts.

    After the dead time the thrust acts at once and the attitude follows its lag, from the measured attitude and body
    rates on. Without a lag the body follows the command of `t - delay`.
    """

    def __init__(self, params: VehicleModelParams) -> None:
        self._delay_us = round(params.delay_s * 1e6)
        self._lag, self._drag_1_s = params.lag(), params.drag_1_s
        self._sent = deque[tuple[int, Array]](maxlen=_REMEMBERED)  # time from which it acts, virtual controls (3,)

    @property
    def delay_us(self) -> int:
        """Return the time from sending to acting [us]."""
        return self._delay_us

    def sent(self, now_us: int, virtual_control: Array) -> None:
        """Remember a command, virtual controls (3,), that acts after the delay."""
        self._sent.append((now_us + self._delay_us, virtual_control))

    def clear(self) -> None:
        """Forget remembered commands, after a handover."""
        self._sent.clear()

    def start(self, state: VehicleState, until_us: int, disturbance_ned_m_s2: Array, held: Array) -> Start:
        """Return the start of a plan that acts from `until_us` on, after `held` (3,) was commanded last.

        The remembered commands act one after the other, each from its own time. Before the first one the vehicle is
        assumed to compensate the disturbance.
        """
        moved, t_us = _Motion(state, self._lag, self._drag_1_s, disturbance_ned_m_s2), state.t_us
        acting = self._acting_from(t_us)
        current = acting[0][1] if acting else None
        for start_us, virtual_control in acting:
            if start_us > t_us:
                if start_us >= until_us:
                    break
                moved.advance(current, start_us - t_us)
                t_us = start_us
            current = virtual_control
        moved.advance(current, max(0, until_us - t_us))
        return moved.start(until_us, held)

    def _acting_from(self, t_us: int) -> list[tuple[int, Array]]:
        """Return the command that acts at `t_us`, or before all the oldest one, and those that act after it."""
        found = []
        for sent in reversed(self._sent):
            found.append(sent)
            if sent[0] <= t_us:
                break
        found.reverse()
        return found


class _Motion:
    """The predicted motion of a vehicle, in plain numbers: there are too few for arrays to pay."""

    def __init__(self, state: VehicleState, lag: Lag | None, drag_1_s: float, disturbance_ned_m_s2: Array) -> None:
        self._pos, self._vel = state.pos_ned_m.tolist(), state.vel_ned_m_s.tolist()
        *self._tilt, self._down = body_z_ned(state.q_nb).tolist()
        self._rate = [0.0, 0.0] if lag is None else tilt_rate(state).tolist()
        self._lag, self._drag_1_s, self._disturbance = lag, drag_1_s, disturbance_ned_m_s2.tolist()

    def advance(self, command: Array | None, for_us: int) -> None:
        """Move on under a command (3,); without one, at constant velocity."""
        dt_s = for_us * 1e-6
        if command is None:
            self._pos = [p + v * dt_s for p, v in zip(self._pos, self._vel, strict=True)]
            return
        ux, uy, thrust = command.tolist()
        if self._lag is not None and for_us > 0:
            ends = [self._lag.advance(*now, dt_s) for now in zip(self._tilt, self._rate, (ux, uy), strict=True)]
            self._tilt, self._rate = [end[0] for end in ends], [end[1] for end in ends]
            ux, uy = ends[0][2] / dt_s, ends[1][2] / dt_s
        accel = [a + d for a, d in zip(_acceleration(ux, uy, thrust), self._disturbance, strict=True)]
        self._pos, self._vel = _moved(self._pos, self._vel, accel, self._drag_1_s, dt_s=dt_s)

    def start(self, t_us: int, held: Array) -> Start:
        """Return the start of a plan from here on, after `held` (3,) was commanded last."""
        pos, vel = np.array(self._pos), np.array(self._vel)
        if self._lag is None:
            return Start(t_us=t_us, pos_ned_m=pos, vel_ned_m_s=vel, cos_tilt=self._down, virtual_control=held)
        north, east = self._tilt
        return Start(
            t_us=t_us,
            pos_ned_m=pos,
            vel_ned_m_s=vel,
            cos_tilt=math.sqrt(max(0.0, 1.0 - (north * north + east * east))),
            virtual_control=held,
            tilt=np.array(self._tilt),
            tilt_rate_1_s=np.array(self._rate),
        )


def tilt_rate(state: VehicleState) -> Array:
    """Return the rate (2,) [1/s] of the horizontal part of the body's down axis."""
    p, q, _ = state.rate_frd_rad_s.tolist()
    return rotate_to_ned(state.q_nb, np.array([q, -p, 0.0]))[:2]


def acceleration(virtual_control: Array) -> Array:
    """Return the acceleration (3,) NED [m/s2] of virtual controls (3,), gravity included (thesis 3.2)."""
    return np.array(_acceleration(*virtual_control.tolist()))


def _acceleration(ux: float, uy: float, thrust_m_s2: float) -> tuple[float, float, float]:
    down = max(0.0, 1.0 - ux * ux - uy * uy) ** 0.5
    return -thrust_m_s2 * ux, -thrust_m_s2 * uy, GRAVITY_M_S2 - thrust_m_s2 * down


def _moved(
    pos: list[float], vel: list[float], accel: list[float], drag_1_s: float, *, dt_s: float
) -> tuple[list[float], list[float]]:
    """Return positions and velocities after `dt_s` of a held acceleration."""
    kept, gained_s, fallen_s2 = 1.0, dt_s, 0.5 * dt_s * dt_s
    if drag_1_s != 0.0:
        kept = math.exp(-drag_1_s * dt_s)
        gained_s = (1.0 - kept) / drag_1_s
        fallen_s2 = (dt_s - gained_s) / drag_1_s
    ends = [p + gained_s * v + fallen_s2 * a for p, v, a in zip(pos, vel, accel, strict=True)]
    return ends, [kept * v + gained_s * a for v, a in zip(vel, accel, strict=True)]
