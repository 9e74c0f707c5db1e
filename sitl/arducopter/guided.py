"""ArduCopter's GUIDED: which attitude setpoints are flown, the meaning of their thrust, their timeout, and take-off."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sitl.arducopter.navigator import CopterNavigator
from sitl.arducopter.parameters import CopterParameters
from sitl.plant.sensors import Estimate
from swarmctl.core.frames import euler_from_quat, quat_from_euler
from swarmctl.core.types import Array

MASK_RATES, MASK_NO_THRUST, MASK_NO_ATTITUDE = 7, 64, 128
OPTION_THRUST = 8  # GUID_OPTIONS: the thrust field is a thrust
NORM_TOLERANCE = 1e-3  # of the squared norm of a setpoint's quaternion
SOME_RATES = "some_rates"  # the refusal that also stops GUIDED
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
REACHED_M = 0.1
_STILL = (0.0, 0.0, 0.0)


class Guided(enum.Enum):
    """Names what GUIDED flies at present."""

    STOP = "stop"  # brake and hold
    TAKEOFF = "takeoff"
    ANGLE = "angle"  # the attitude of the setpoints


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """Flown target: an attitude that turns at body rates, with a thrust or, if that is None, at a climb rate."""

    q_nb: Array = field(default_factory=lambda: LEVEL)  # (4,) wxyz
    rate_frd_rad_s: tuple[float, float, float] = _STILL
    thrust_01: float | None = None
    climb_m_s: float = 0.0

    @property
    def rises(self) -> bool:
        """Whether it takes off when landed."""
        return (self.climb_m_s if self.thrust_01 is None else self.thrust_01) > 0.0

    def turned(self, dt_s: float) -> Target:
        """Return the target after `dt_s`: body rates turn the attitude."""
        if not any(self.rate_frd_rad_s):
            return self
        rate = np.array(self.rate_frd_rad_s)
        speed = math.sqrt(float(rate @ rate))
        a, b, c = (float(v) for v in rate * (math.sin(0.5 * speed * dt_s) / speed))
        d = math.cos(0.5 * speed * dt_s)
        w, x, y, z = (float(v) for v in self.q_nb)
        q_nb = [w * d - x * a - y * b - z * c, x * d + w * a + y * c - z * b]
        q_nb += [y * d + w * b + z * a - x * c, z * d + w * c + x * b - y * a]
        return replace(self, q_nb=np.array(q_nb))


class Setpoints:
    """The newest accepted setpoint of one vehicle."""

    def __init__(self, parameters: CopterParameters) -> None:
        self._parameters = parameters
        self.target = Target()
        self._accepted_us = 0

    def take(
        self,
        type_mask: int,
        q_nb: Sequence[float],
        rates: Sequence[float],
        thrust: float,
        *,
        flown: Array,
        now_us: int,
    ) -> str:
        """Accept a SET_ATTITUDE_TARGET, or return why not.

        Args:
            type_mask: as in MAVLink; THRUST_BODY_SET (32) is ignored. Attitude, or all three rates, or both.
            q_nb: wxyz.
            rates: body [rad/s]; they turn the attitude from then on.
            thrust: thrust or climb rate, by GUID_OPTIONS; NaN becomes mid-range.
            flown: (4,) the present target attitude, at which rates without an attitude begin.
            now_us: time since boot.
        """
        if type_mask & MASK_NO_THRUST:
            return "no_thrust"
        ignored_rates = type_mask & MASK_RATES
        if ignored_rates not in (0, MASK_RATES):
            return SOME_RATES
        attitude = np.array(flown if type_mask & MASK_NO_ATTITUDE else q_nb, dtype=np.float64)
        if type_mask & MASK_NO_ATTITUDE and ignored_rates:
            return "neither_attitude_nor_rates"
        square = float(attitude @ attitude)
        if not abs(square - 1.0) < NORM_TOLERANCE:
            return "not_unit_quaternion"
        rate = _STILL if ignored_rates else (float(rates[0]), float(rates[1]), float(rates[2]))
        if not all(math.isfinite(r) for r in rate):
            return "not_finite"
        self.target = self._with_thrust(Target(q_nb=attitude / math.sqrt(square), rate_frd_rad_s=rate), thrust)
        self._accepted_us = now_us
        return ""

    def _with_thrust(self, target: Target, thrust: float) -> Target:
        if self._parameters.integer("GUID_OPTIONS") & OPTION_THRUST:
            return replace(target, thrust_01=0.0 if math.isnan(thrust) else max(-1.0, min(1.0, thrust)))
        share = 0.0 if math.isnan(thrust) else 2.0 * max(0.0, min(1.0, thrust)) - 1.0
        scale = self._parameters.metres("WPNAV_SPEED_UP" if share > 0 else "WPNAV_SPEED_DN")
        return replace(target, climb_m_s=0.0 if abs(share) < 1e-6 else share * scale)

    def stale(self, now_us: int) -> bool:
        """Return whether no setpoint was accepted for GUID_TIMEOUT."""
        return now_us - self._accepted_us > self._parameters.real("GUID_TIMEOUT") * 1e6


class GuidedFlight:
    """GUIDED of one vehicle.

    Attributes:
        stage: what it flies at present.
        setpoints: what it is sent.
    """

    def __init__(self, parameters: CopterParameters, navigator: CopterNavigator) -> None:
        self.stage = Guided.STOP
        self.setpoints = Setpoints(parameters)
        self._navigator = navigator
        self._takeoff_z_m = 0.0
        self._takeoff_reached = False

    def aim(self, z_ned_m: float) -> None:
        """Set the height at which a take-off ends."""
        self._takeoff_z_m, self._takeoff_reached = z_ned_m, False

    @property
    def takes_off(self) -> bool:
        """Whether it is on the way to the height of a take-off."""
        return self.stage is Guided.TAKEOFF and not self._takeoff_reached

    def wants_up(self, estimate: Estimate, flown_q_nb: Array, now_us: int) -> bool:
        """Return whether a vehicle on the ground is to leave it; arguments as in `fly`."""
        if self.stage is Guided.ANGLE:
            return self._target(estimate, flown_q_nb, now_us).rises
        return self.stage is Guided.TAKEOFF

    def fly(self, estimate: Estimate, flown_q_nb: Array, now_us: int, dt_s: float) -> tuple[Array, float]:
        """Return attitude (4,) and throttle of this tick; `flown_q_nb` (4,) is the attitude of the last one."""
        navigator = self._navigator
        if self.stage is Guided.ANGLE:
            target = self.setpoints.target = self._target(estimate, flown_q_nb, now_us).turned(dt_s)
            if target.thrust_01 is not None:
                return target.q_nb, target.thrust_01
            return target.q_nb, navigator.climb(estimate, target.climb_m_s, dt_s)
        if self.stage is Guided.STOP:
            return navigator.hold(estimate, dt_s), navigator.hold_height(estimate, dt_s)
        self._takeoff_reached |= estimate.pos_ned_m[2] <= self._takeoff_z_m + REACHED_M
        throttle = navigator.to_height(estimate, self._takeoff_z_m, dt_s)
        return navigator.hold(estimate, dt_s), throttle

    def _target(self, estimate: Estimate, flown_q_nb: Array, now_us: int) -> Target:
        """Return the newest setpoint; when it is too old: level, climb rate 0, for either meaning of thrust."""
        if self.setpoints.stale(now_us):
            if self.setpoints.target.thrust_01 is not None:
                self._navigator.engage(estimate)
            self.setpoints.target = Target(q_nb=levelled(flown_q_nb))
        return self.setpoints.target


def levelled(q_nb: Array) -> Array:
    """Return the level attitude (4,) of the same yaw."""
    _, _, yaw_rad = euler_from_quat(q_nb)
    return quat_from_euler(0.0, 0.0, yaw_rad)
