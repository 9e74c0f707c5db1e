"""Errors of each autopilot's own estimate: seeded error models, independent for each vehicle.

The autopilot's navigator and attitude loop use the same estimate that its client receives. The model `exact` has no
error and draws nothing. Stamps give the publishing time of an estimate; the age of its sample (`latency_s`) is not
reported, as on a real autopilot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.plant.attitude import Sensed
from sitl.plant.sensors import FULL, Estimate, Power
from sitl.plant.vehicle import Plant
from swarmctl.core.types import Array

_BLOCK = 50  # steps of random numbers drawn at a time
_WHITE = 9  # random numbers per step and vehicle for the white noise on position, velocity and attitude
_TILT, _FAST = slice(6, 8), slice(8, 14)  # of what wanders
_PURPOSE = 1  # purpose of the random stream, beside run seed and vehicle
_LOST_M_S2 = 0.05  # acceleration that a tilt error of 0.3 deg causes in an uncorrected position
_RESTS_S = 0.8  # in which it rests once the vehicle is on the ground; a PX4 1.18 drifted 1.0 m on from about 1.2 m/s
EXACT_ACCURACY_M = (0.01, 0.01)
# Rows of what is known of a vehicle: the plant's state, NED velocity, roll, pitch, yaw, and the body's down axis.
_QUAT, _MOTION, _SAMPLE, _EULER, _DOWN = slice(4), slice(10, 16), slice(16), slice(16, 19), slice(19, 22)
_KNOWN_ROWS = 22

# Small turns: which component of a quaternion times which half angle, or its negative, to add; first, second, third.
_TURNED = np.array([1, 0, 0, 0, 2, 2, 3, 1, 3, 3, 1, 2])
_TURN = np.array([3, 0, 1, 2, 4, 2, 0, 1, 5, 4, 5, 3])
# Rotation matrix: products ww, xx, yy, zz, xz, wy, yz, wx, xy, wz, and sums of them: the down axis, the sine of pitch,
# and what the arctangents of roll and yaw take.
_LEFT, _RIGHT = np.array([0, 1, 2, 3, 1, 0, 2, 0, 1, 0]), np.array([0, 1, 2, 3, 3, 2, 3, 1, 2, 3])
_SUMS = np.array(
    [
        [0.0, 0, 0, 0, 2, 2, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 2, -2, 0, 0],
        [1, -1, -1, 1, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, -2, 2, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 2, 2, 0, 0],
        [0, 0, 0, 0, 0, 0, 0, 0, 2, 2],
        [1, -1, -1, 1, 0, 0, 0, 0, 0, 0],
        [1, 1, -1, -1, 0, 0, 0, 0, 0, 0],
    ]
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorModel:
    """Slow and fast errors: root mean square and correlation time, NED per axis.

    They are white noise behind two equal low-passes. A filter that integrates inertial data, as an autopilot's does,
    has smooth errors, so that its position can still be differentiated. Slow ones are its drift between fixes. Fast
    ones (0.1 to 1.5 Hz) come from its accelerometers, and are what a controller follows.
    """

    position_m: tuple[float, float, float]
    position_tau_s: float
    velocity_m_s: tuple[float, float, float]  # reported velocity against the derivative of the reported position
    velocity_tau_s: float
    tilt_rad: float  # roll and pitch each
    tilt_tau_s: float
    noise_position_m: float  # white, per axis and physics step
    noise_velocity_m_s: float
    noise_attitude_rad: float
    latency_s: tuple[float, float]  # age of a sample when published; drawn for each vehicle from this interval
    fast_position_m: tuple[float, float, float] = (0.0,) * 3
    fast_position_tau_s: float = 1.0
    fast_velocity_m_s: tuple[float, float, float] = (0.0,) * 3
    fast_velocity_tau_s: float = 1.0

    @property
    def wander(self) -> Array:
        """RMS and correlation time [s] of what wanders, (2, 8): position, velocity, tilt; (2, 14) with fast ones."""
        groups: list[tuple[tuple[float, ...], float]] = [
            (self.position_m, self.position_tau_s),
            (self.velocity_m_s, self.velocity_tau_s),
            ((self.tilt_rad,) * 2, self.tilt_tau_s),
        ]
        if any((*self.fast_position_m, *self.fast_velocity_m_s)):
            groups.append((self.fast_position_m, self.fast_position_tau_s))
            groups.append((self.fast_velocity_m_s, self.fast_velocity_tau_s))
        return np.array([(rms, tau_s) for errors, tau_s in groups for rms in errors]).T

    @property
    def accuracy_m(self) -> tuple[float, float]:
        """Accuracy [m], 1 sigma, horizontal (both axes together, as PX4 reports it) and vertical."""
        pairs = zip(self.position_m, self.fast_position_m, strict=True)
        north, east, down = (math.hypot(slow_m, fast_m, self.noise_position_m) for slow_m, fast_m in pairs)
        return math.hypot(north, east), down


_PERFECT = ErrorModel(  # carries faults only
    position_m=(0.0,) * 3,
    position_tau_s=1.0,
    velocity_m_s=(0.0,) * 3,
    velocity_tau_s=1.0,
    tilt_rad=0.0,
    tilt_tau_s=1.0,
    noise_position_m=0.0,
    noise_velocity_m_s=0.0,
    noise_attitude_rad=0.0,
    latency_s=(0.0, 0.0),
)

_INERTIAL = partial(
    ErrorModel,
    tilt_rad=math.radians(0.3),
    tilt_tau_s=20.0,
    noise_attitude_rad=math.radians(0.1),
    latency_s=(0.010, 0.020),
)
_SLOW = partial(_INERTIAL, position_tau_s=25.0, velocity_tau_s=4.0, noise_position_m=0.005, noise_velocity_m_s=0.02)
_FITTED = partial(_INERTIAL, position_tau_s=10.0, velocity_tau_s=5.0, noise_position_m=0.0012, noise_velocity_m_s=0.006)

ESTIMATORS: dict[str, ErrorModel | None] = {
    "exact": None,
    "gps": _SLOW(  # slow errors of PX4 with its default GPS: position 0.3-0.6 m off in space, velocity 0.1-0.3 m/s
        position_m=(0.2, 0.2, 0.25),
        velocity_m_s=(0.15, 0.15, 0.15),
    ),
    "external": _SLOW(  # position fed from outside into the same filter: 4 cm off in space, velocity 0.05-0.1 m/s
        position_m=(0.023, 0.023, 0.023),
        velocity_m_s=(0.055, 0.055, 0.055),
    ),
    "px4_gps": _FITTED(  # slow and fast, fitted to logs of PX4 1.18 beside the truth of its simulator
        position_m=(0.12, 0.25, 0.3),
        velocity_m_s=(0.14, 0.3, 0.14),
        fast_position_m=(0.03, 0.03, 0.02),
        fast_position_tau_s=1.2,
        fast_velocity_m_s=(0.03, 0.07, 0.045),
        fast_velocity_tau_s=0.5,
    ),
    "px4_external": _FITTED(  # the same, position fed at 50 Hz into a PX4 set up for it: 2 cm off
        position_m=(0.006, 0.015, 0.005),
        velocity_m_s=(0.03, 0.03, 0.012),
        fast_position_m=(0.005, 0.014, 0.011),
        fast_position_tau_s=0.5,
        fast_velocity_m_s=(0.025, 0.085, 0.055),
        fast_velocity_tau_s=0.5,
    ),
}


class Estimator:
    """Estimates of all vehicles. Call `advance` after every physics step; `of` returns an estimate.

    Attributes:
        q_nb: (4, N) attitude for the attitude loop: without latency and white noise.
        euler_rad: (3, N) the same as roll, pitch, yaw.
        rate_frd_rad_s: (3, N) body rates.
        power: measurements of each vehicle's power module.
    """

    def __init__(self, model: ErrorModel | None, plant: Plant, seed: int, *, first_vehicle: int = 0) -> None:
        self._model = model
        self._plant = plant
        self._seed = seed
        self._first_vehicle = first_vehicle  # its number in the swarm, by which each draws its own errors
        self._accuracy_m = model.accuracy_m if model else EXACT_ACCURACY_M
        self._stale = True
        count = plant.state.shape[1]
        self.power: list[Power] = [FULL] * count
        self._jump_ned_m = np.zeros((3, count))
        self._lost = np.zeros(count)  # 1: GPS is lost
        self._drift_m, self._drift_m_s = np.zeros(count), np.zeros(count)  # of the estimate since then
        self._displaced = False  # by any fault, ever
        self._drift_axis = np.zeros((3, count))
        self._frozen: dict[int, Estimate] = {}
        self._rows: list[Any] = []  # (22,) per vehicle
        self._on_ground: list[bool] = []
        if model is not None:
            self._start(model, plant)

    def _start(self, model: ErrorModel, plant: Plant) -> None:
        count, dt_s = plant.state.shape[1], plant.dt_s
        self._rngs = [self._rng(i, _PURPOSE) for i in range(count)]
        rms, taus_s = model.wander
        self._keep = np.exp(-2.0 * dt_s / taus_s)[:, None]  # of each low-pass, with half the correlation time
        self._follow = 1.0 - self._keep
        rough_rms = math.sqrt(2.0) * rms  # of the first stage: the second halves its variance
        self._drive = (rough_rms * np.sqrt(1.0 - np.exp(-4.0 * dt_s / taus_s)))[:, None]
        self._white_rms = np.repeat(
            [model.noise_position_m, model.noise_velocity_m_s, model.noise_attitude_rad], (3, 3, 3)
        )[:, None]
        wanders = len(rms)
        first = np.stack([rng.standard_normal((2, wanders)) for rng in self._rngs], axis=2)  # (2, wanders, N)
        self._wander = first[0] * rms[:, None]
        self._rough = self._wander + first[1] * rms[:, None]  # stationary variance and correlation of the two
        low_s, high_s = model.latency_s
        self._start_history(np.array([round(rng.uniform(low_s, high_s) / dt_s) for rng in self._rngs]))
        self._driven = np.zeros((0, wanders, count))  # of each step of a block: what drives the wander, white noise
        self._noise = np.zeros((0, _WHITE, count))
        self._drawn = 0
        self._white = np.zeros((_WHITE, count))
        self._lead = np.zeros((wanders, count))  # of the first stage over the second
        self._tilt_rad = np.zeros((3, count))
        self._believed = np.zeros((_KNOWN_ROWS, count))
        self._tilt_quat()

    def _rng(self, vehicle: int, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, self._first_vehicle + vehicle, *purpose])

    def _start_history(self, lag_steps: NDArray[np.int64]) -> None:
        """Fill the ring of the newest samples, (steps, 16, N); `_delayed` finds in it what each vehicle has by now."""
        length, count = int(lag_steps.max()) + 1, len(lag_steps)
        self._history = np.zeros((length, 16, count))
        for self._head in range(length):
            self._sample()
        rows = (np.arange(length)[:, None] - lag_steps) % length  # (head, N)
        places = np.arange(16 * count).reshape(16, count)
        self._delayed = [row * 16 * count + places for row in rows]  # for each head (16, N), in the flat ring

    def advance(self) -> None:
        """Update the estimates after a physics step."""
        self._stale = True
        if self._model is None:
            return
        if self._drawn == len(self._noise):
            self._draw()
        self._white = self._noise[self._drawn]
        self._rough *= self._keep
        self._rough += self._driven[self._drawn]
        np.subtract(self._rough, self._wander, out=self._lead)
        self._lead *= self._follow
        self._wander += self._lead
        self._drawn += 1
        if self._displaced:
            self._drift()
        self._head = (self._head + 1) % len(self._history)
        self._sample()
        self._tilt_quat()

    def _drift(self) -> None:
        """Let the error without GPS accelerate; that of a vehicle on the ground comes to rest."""
        before_m_s, dt_s = self._drift_m_s, self._plant.dt_s
        flown_m_s = before_m_s + self._lost * (_LOST_M_S2 * dt_s)
        self._drift_m_s = np.where(self._plant.contact, before_m_s * math.exp(-dt_s / _RESTS_S), flown_m_s)
        self._drift_m += 0.5 * dt_s * (before_m_s + self._drift_m_s)

    def _draw(self) -> None:
        """Draw the random numbers of a block of steps."""
        wanders = len(self._wander)
        draws = np.stack([rng.standard_normal((_BLOCK, wanders + _WHITE)) for rng in self._rngs], axis=2)
        self._driven, self._noise = self._drive * draws[:, :wanders], draws[:, wanders:] * self._white_rms
        self._drawn = 0

    def of(self, vehicle: int, t_us: int) -> Estimate:
        """Return the estimate of a vehicle; its stamp is `t_us` since boot."""
        frozen = self._frozen.get(vehicle)
        if frozen is not None:
            return frozen._replace(t_us=t_us, on_ground=bool(self._plant.contact[vehicle]), battery=self.power[vehicle])
        if self._stale:
            self._publish()
        row = self._rows[vehicle]
        accuracy_m, gps_ok = self._accuracy_m, True
        if self._displaced:
            accuracy_m = math.hypot(accuracy_m[0], self._drift_m[vehicle]), accuracy_m[1]
            gps_ok = not self._lost[vehicle]
        return Estimate(
            t_us=t_us,
            pos_ned_m=row[10:13],
            vel_ned_m_s=row[13:16],
            q_nb=row[:4],
            euler_rad=row[16:19],
            rate_frd_rad_s=row[4:7],
            down_axis_ned=row[19:],
            on_ground=self._on_ground[vehicle],
            pos_accuracy_m=accuracy_m,
            gps_ok=gps_ok,
            gps_accuracy_m=self._accuracy_m,
            battery=self.power[vehicle],
        )

    # --- faults ---

    @property
    def sensed(self) -> Sensed:
        """Return the attitude and rates that the attitude loop uses."""
        return self._plant if self._model is None else self

    def jump(self, vehicle: int, by_ned_m: Array) -> None:
        """Shift the reported position by (3,) [m]; the negative reverts it."""
        self._wake()
        self._jump_ned_m[:, vehicle] += by_ned_m
        self._stale = True

    def freeze(self, vehicle: int, t_us: int) -> None:
        """Repeat the present estimate from now on."""
        self._frozen[vehicle] = self.of(vehicle, t_us)

    def thaw(self, vehicle: int) -> None:
        """Resume an estimate that was frozen."""
        self._frozen.pop(vehicle, None)

    def lose_gps(self, vehicle: int) -> None:
        """Dead-reckon the position from now on: its horizontal error accelerates; height has a barometer."""
        self._wake()
        heading = self._rng(vehicle, _PURPOSE, 1).uniform(0.0, 2.0 * math.pi)
        self._drift_axis[:, vehicle] = math.cos(heading), math.sin(heading), 0.0
        self._lost[vehicle] = 1.0
        self._drift_m[vehicle] = self._drift_m_s[vehicle] = 0.0

    def find_gps(self, vehicle: int) -> None:
        """Restore GPS: the estimate jumps to its position."""
        self._lost[vehicle] = self._drift_m[vehicle] = self._drift_m_s[vehicle] = 0.0

    def _wake(self) -> None:
        self._displaced = True
        if self._model is None:
            self._model = _PERFECT
            self._start(_PERFECT, self._plant)

    # --- what the error models make of the truth ---

    @property
    def euler_rad(self) -> Array:
        euler_rad: Array = _euler_and_down(self.q_nb)[0]
        return euler_rad

    @property
    def rate_frd_rad_s(self) -> Array:
        return self._plant.rate_frd_rad_s

    def _sample(self) -> None:
        """Note state and NED velocity of this instant."""
        sample = self._history[self._head]
        sample[:13], sample[13:] = self._plant.state, self._plant.vel_ned_m_s

    def _tilt_quat(self) -> None:
        """Update the attitude that the attitude loop uses."""
        self._tilt_rad[:2] = self._wander[_TILT]
        self.q_nb = _turned(self._plant.q_nb, self._tilt_rad)

    def _publish(self) -> None:
        """Convert the numbers of all vehicles at once: one conversion per step instead of six per message."""
        self._stale = False
        plant = self._plant
        self._on_ground = plant.contact.tolist()
        if self._model is None:
            known = plant.state, plant.vel_ned_m_s, plant.euler_rad, plant.rotation[2::3]
            self._rows = list(zip(*(row for rows in known for row in rows.tolist()), strict=True))
        else:
            self._believe()
            self._rows = list(zip(*self._believed.tolist(), strict=True))

    def _believe(self) -> None:
        """Fill `_believed` with what each vehicle knows, delayed and wrong."""
        believed = self._believed
        self._history.take(self._delayed[self._head], out=believed[_SAMPLE], mode="clip")
        believed[_MOTION] += self._wander[:6] + self._white[:6]
        if len(self._wander) > _FAST.start:
            believed[_MOTION] += self._wander[_FAST]
        if self._displaced:
            believed[10:13] += self._jump_ned_m + self._drift_axis * self._drift_m
            believed[13:16] += self._drift_axis * self._drift_m_s
        believed[_QUAT] = _turned(believed[_QUAT], self._tilt_rad + self._white[6:])
        believed[_EULER], believed[_DOWN] = _euler_and_down(believed[_QUAT])


def _turned(q_nb: Array, turn_rad: Array) -> Array:
    """Return attitudes (4, N) with small errors (3, N) about the body axes; unit length."""
    angles = np.empty((6, q_nb.shape[1]))
    np.multiply(turn_rad, 0.5, out=angles[:3])
    np.negative(angles[:3], out=angles[3:])
    terms = q_nb.take(_TURNED, 0)
    terms *= angles.take(_TURN, 0)
    turned: Array = q_nb + terms[:4]
    turned += terms[4:8]
    turned += terms[8:]
    turned /= np.sqrt(np.add.reduce(turned * turned))
    return turned


def _euler_and_down(q_nb: Array) -> tuple[Array, Array]:
    """Return roll, pitch, yaw (3, N) and the body's down axis in NED (3, N)."""
    products = q_nb.take(_LEFT, 0)
    products *= q_nb.take(_RIGHT, 0)
    sums = np.matmul(_SUMS, products)
    euler_rad = np.empty_like(q_nb[:3])
    np.arctan2(sums[4:6], sums[6:], out=euler_rad[::2])
    np.arcsin(np.minimum(np.maximum(sums[3], -1.0), 1.0), out=euler_rad[1])
    return euler_rad, sums[:3]
