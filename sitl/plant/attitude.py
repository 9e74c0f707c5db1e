"""Attitude loops of all vehicles at once, at physics rate: the thesis' PIDs, and a PX4-like cascade.

Both turn one attitude setpoint per vehicle into body torques (3, N) [N m]. They know no modes: an idle vehicle
(disarmed, on the ground, clamped) gets zero torque and its loop is reset, so that at release the setpoint acts as a
step from the attitude of the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sitl.plant.airframes import Preset
from sitl.plant.rates import RateLoop
from swarmctl.core.frames import euler_from_quat
from swarmctl.core.types import Array

_TURN_RAD = 2.0 * math.pi
_LEFT, _RIGHT = np.repeat(np.arange(4), 4), np.tile(np.arange(4), 4)  # factors of all products of two quaternions


class Sensed(Protocol):
    """Attitude and rates of all vehicles: true (`Plant`), or as estimated by the autopilots (`Estimator`)."""

    @property
    def q_nb(self) -> Array:
        """Attitude (4, N), wxyz."""

    @property
    def euler_rad(self) -> Array:
        """Roll, pitch, yaw (3, N) [rad]."""

    @property
    def rate_frd_rad_s(self) -> Array:
        """Body rates (3, N), FRD [rad/s]."""


class AttitudeLoop(Protocol):
    """Follows the attitude setpoints of all vehicles."""

    rates: RateLoop

    def set_reference(self, vehicle: int, q_nb: Array) -> None:
        """Set the setpoint (4,) wxyz of one vehicle; it acts from the next step."""

    def torque(self, sensed: Sensed, live: Array | None, out: Array) -> None:
        """Write torques (3, N) [N m] to `out`.

        `live` (N,) is 1.0 in free flight and 0.0 for idle vehicles; None: all are in free flight.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class PidGains:
    """PID gains of roll, pitch, yaw; error in rad, output in N m."""

    proportional: tuple[float, float, float]
    integral: tuple[float, float, float]
    derivative: tuple[float, float, float]
    on_measurement: bool = False  # derivative of the measurement, so that a reference step does not kick


THESIS_GAINS = {
    "swarm": PidGains(
        proportional=(0.05, 0.05, 0.005), integral=(1e-4, 1e-4, 1e-4), derivative=(0.15, 0.15, 0.05)
    ),  # section 4.3
    "single": PidGains(
        proportional=(0.15, 0.05, 0.005), integral=(1e-4, 1e-4, 1e-4), derivative=(0.3, 0.25, 0.01)
    ),  # chapter 3
    "pid_step": PidGains(
        proportional=(0.9, 0.6, 1.5), integral=(0.01, 0.001, 0.001), derivative=(0.1, 0.1, 0.65), on_measurement=True
    ),  # chapter 2
    "pid_trajectory": PidGains(proportional=(0.2, 0.4, 0.01), integral=(0.0, 1e-4, 0.0), derivative=(0.1, 0.1, 0.001)),
}
THESIS_SAMPLE_S = 0.02


class ThesisAttitude:
    """Three PIDs on Euler angles; the derivative is of the error, reference included, or of the measurement (steps).

    The thesis samples at 0.02 s. At a faster physics rate the derivative is taken over a sliding 0.02 s window,
    (e(t) - e(t - 0.02)) / 0.02, so that a reference step gives the same impulse; at dt = 0.02 s this is its discrete
    PID.
    """

    def __init__(self, vehicles: int, dt_s: float, gains: PidGains = THESIS_GAINS["swarm"]) -> None:
        self._window = max(1, round(THESIS_SAMPLE_S / dt_s))
        self._kp = np.array(gains.proportional).reshape(3, 1)
        self._ki = np.array(gains.integral).reshape(3, 1) * dt_s
        self._kd = np.array(gains.derivative).reshape(3, 1) / (self._window * dt_s)
        self._on_measurement = gains.on_measurement
        self._reference_rad = np.zeros((3, vehicles))
        self._rate_gain = np.array(gains.derivative).reshape(3, 1)
        self.rates = RateLoop(self._rate_gain, vehicles, dt_s)
        self._past = np.zeros((self._window, 3, vehicles))
        self._head = 0
        self._integral = np.zeros((3, vehicles))  # already multiplied by kI
        self._error = np.zeros((3, vehicles))
        self._term = np.zeros((3, vehicles))

    def set_reference(self, vehicle: int, q_nb: Array) -> None:
        self._reference_rad[:, vehicle] = euler_from_quat(q_nb)

    def torque(self, sensed: Sensed, live: Array | None, out: Array) -> None:
        error, term = self._error, self._term
        np.subtract(self._reference_rad, sensed.euler_rad, out=error)
        np.multiply(error, 1.0 / _TURN_RAD, out=term)
        np.rint(term, out=term)
        term *= _TURN_RAD
        error -= term  # wrapped to the nearest turn
        watched = np.remainder(-sensed.euler_rad, _TURN_RAD) if self._on_measurement else error
        if live is not None:
            error *= live
            self._integral *= live
            if self._on_measurement:
                watched *= live
        past = self._past[self._head]
        np.subtract(watched, past, out=term)
        if self._on_measurement:
            term -= np.rint(term / _TURN_RAD) * _TURN_RAD  # wrapped to the nearest turn
        past[...] = watched
        self._head = (self._head + 1) % self._window
        np.multiply(term, self._kd, out=out)
        np.multiply(error, self._ki, out=term)
        self._integral += term
        out += self._integral
        np.multiply(error, self._kp, out=term)
        out += term
        if self.rates.feeding:
            out += self._rate_gain * self.rates.feed_rad_s
        if live is not None:
            out *= live
        self.rates.overrule(sensed.rate_frd_rad_s, live, out)


@dataclass(frozen=True, slots=True, kw_only=True)
class CascadeGains:
    """Gains of one airframe's loops; roll, pitch, yaw."""

    attitude_1_s: tuple[float, float, float]
    rate_1_s: tuple[float, float, float]  # angular acceleration over rate error
    rate_integral_1_s2: tuple[float, float, float]
    rate_derivative: tuple[float, float, float]
    rate_limit_rad_s: tuple[float, float, float]
    delay_s: float  # from a setpoint to the first reaction of the loop


CASCADE_GAINS = {
    "x500": CascadeGains(  # fitted to PX4 1.18 SIH: t10, t50, t63, t90, overshoot of roll, pitch and yaw steps
        attitude_1_s=(4.02, 4.02, 3.0),
        rate_1_s=(13.4, 13.4, 2.95),
        rate_integral_1_s2=(0.41, 0.41, 0.1),
        rate_derivative=(0.40, 0.40, 0.5),
        rate_limit_rad_s=(3.84, 3.84, 3.49),  # MC_ROLLRATE_MAX 220, MC_YAWRATE_MAX 200 deg/s
        delay_s=0.036,
    ),
    "crazyflie": CascadeGains(  # as fast as its rotor lag allows without overshoot; no published step response
        attitude_1_s=(7.0, 7.0, 4.0),
        rate_1_s=(20.0, 20.0, 8.0),
        rate_integral_1_s2=(2.0, 2.0, 0.5),
        rate_derivative=(0.1, 0.1, 0.0),
        rate_limit_rad_s=(5.0, 5.0, 3.5),
        delay_s=0.008,  # from radio to stabiliser
    ),
    "arducopter": CascadeGains(  # fitted to ArduCopter 4.6.3: t10, t50, t63, t90 of a roll step; yaw not measured
        attitude_1_s=(5.3, 5.3, 4.0),
        rate_1_s=(28.0, 28.0, 8.0),
        rate_integral_1_s2=(0.4, 0.4, 0.1),
        rate_derivative=(0.3, 0.3, 0.1),
        rate_limit_rad_s=(6.0, 6.0, 3.0),
        delay_s=0.028,
    ),
}


class CascadeAttitude:
    """Quaternion P loop around a rate PID, behind a dead time: the x500's response with its motor lag."""

    def __init__(self, preset: Preset, vehicles: int, dt_s: float, gains: CascadeGains | None = None) -> None:
        gains = gains or CASCADE_GAINS[preset.name]
        inertia = np.array(preset.inertia_kg_m2).reshape(3, 1)
        self._attitude = 2.0 * np.array(gains.attitude_1_s).reshape(3, 1)
        self._limit = np.array(gains.rate_limit_rad_s).reshape(3, 1)
        self._least = -self._limit
        self._kp = inertia * np.array(gains.rate_1_s).reshape(3, 1)
        self._ki = inertia * np.array(gains.rate_integral_1_s2).reshape(3, 1) * dt_s
        self.rates = RateLoop(self._kp, vehicles, dt_s)
        self._kd = inertia * np.array(gains.rate_derivative).reshape(3, 1) / dt_s
        self._reference = np.zeros((4, vehicles))
        self._reference[0] = 1.0
        self._line = np.repeat(self._reference[None], max(0, round(gains.delay_s / dt_s)) + 1, axis=0)
        self._head = 0
        # conj(q) * q_sp over the products q_i q_sp_j: vector part, then scalar part
        self._error_rows = np.zeros((4, 16))
        for row, terms in enumerate(
            (
                ((0, 1, 1), (1, 0, -1), (2, 3, -1), (3, 2, 1)),
                ((0, 2, 1), (2, 0, -1), (3, 1, -1), (1, 3, 1)),
                ((0, 3, 1), (3, 0, -1), (1, 2, -1), (2, 1, 1)),
                ((0, 0, 1), (1, 1, 1), (2, 2, 1), (3, 3, 1)),
            )
        ):
            for left, right, sign in terms:
                self._error_rows[row, 4 * left + right] = sign
        self._measured, self._products = np.zeros((2, 16, vehicles))
        self._error = np.zeros((4, vehicles))
        self._integral = np.zeros((3, vehicles))
        self._last_rate = np.zeros((3, vehicles))
        self._term = np.zeros((3, vehicles))

    def set_reference(self, vehicle: int, q_nb: Array) -> None:
        self._reference[:, vehicle] = q_nb

    def torque(self, sensed: Sensed, live: Array | None, out: Array) -> None:
        self._line[self._head] = self._reference
        self._head = (self._head + 1) % len(self._line)
        sensed.q_nb.take(_LEFT, 0, self._measured, "clip")
        self._line[self._head].take(_RIGHT, 0, self._products, "clip")
        np.multiply(self._measured, self._products, out=self._products)
        np.matmul(self._error_rows, self._products, out=self._error)
        rate_error, term, rate = self._error[:3], self._term, sensed.rate_frd_rad_s
        rate_error *= np.sign(self._error[3])
        rate_error *= self._attitude
        np.minimum(rate_error, self._limit, out=rate_error)
        np.maximum(rate_error, self._least, out=rate_error)
        if self.rates.feeding:
            rate_error += self.rates.feed_rad_s
        rate_error -= rate
        np.multiply(rate_error, self._ki, out=term)
        self._integral += term
        if live is not None:
            self._integral *= live
        np.multiply(rate_error, self._kp, out=out)
        out += self._integral
        np.subtract(self._last_rate, rate, out=term)
        self._last_rate[...] = rate
        term *= self._kd
        out += term
        if live is not None:
            out *= live
        self.rates.overrule(rate, live, out)


def attitude_loop(preset: Preset, vehicles: int, dt_s: float, gains: str = "swarm") -> AttitudeLoop:
    """Return the loop of an airframe; `gains` is a key of `THESIS_GAINS` and used by that airframe only."""
    if preset.name == "thesis":
        return ThesisAttitude(vehicles, dt_s, THESIS_GAINS[gains])
    return CascadeAttitude(preset, vehicles, dt_s)
