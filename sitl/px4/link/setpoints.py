"""SET_ATTITUDE_TARGET as PX4 1.18 takes it: the type masks that count as a stream, and their effect.

PX4 validates nothing: a thrust that is not a number stops the motors while it lasts, and one zero or non-finite
quaternion corrupts the attitude controller until reboot. Here such setpoints are refused and counted, unless
`reject_bad` is off: then they have the same effect as in PX4.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sitl.vehicle_parts import IDLE, Command
from swarmctl.core.ordered_sums import dot

NO_ROLL_RATE, NO_PITCH_RATE, NO_YAW_RATE = 1, 2, 4
THRUST_BODY, NO_THRUST, NO_ATTITUDE = 32, 64, 128
BOTH_RATES_SHARE = 0.1  # of a roll rate that opposes the attitude: 0.5 rad/s held 0.7 deg too much at gain 4
_LEVEL = (1.0, 0.0, 0.0, 0.0)
_NO_RATES = (0.0, 0.0, 0.0)
Triple = tuple[float, float, float]


class OffboardStream:
    """The setpoint stream of one vehicle.

    Attributes:
        command: the newest usable setpoint that came while OFFBOARD was on; what OFFBOARD flies.
        seen: there has been a stream since boot.
        poisoned: the attitude controller is corrupted until reboot.
        refused: number of unused setpoints, by reason.
        echo: quaternion as sent, thrust without sign, and body rates of `command`, for ATTITUDE_TARGET.
    """

    def __init__(self, *, reject_bad: bool = True) -> None:
        self.reject_bad = reject_bad
        self.refused: Counter[str] = Counter()
        self.reset()

    def reset(self) -> None:
        """Reset to the state after boot."""
        self.command = IDLE
        self.seen = self.poisoned = self._bad = False
        self.echo: tuple[Sequence[float], float, Triple] = (_LEVEL, 0.0, _NO_RATES)
        self._last_us: int | None = None

    @property
    def newest_us(self) -> int | None:
        """Return when the newest setpoint came that proves a stream; None before the first."""
        return self._last_us

    def age_us(self, now_us: int) -> float:
        """Return the age of that setpoint; infinite before the first."""
        return math.inf if self._last_us is None else now_us - self._last_us

    def take(
        self,
        type_mask: int,
        q_nb: Sequence[float],
        rates: Triple,
        thrust_01: float,
        *,
        now_us: int,
        flying: bool,
    ) -> bool:
        """Take a setpoint addressed to this vehicle; return whether it counts as a stream.

        Args:
            type_mask: ATTITUDE_TARGET_TYPEMASK.
            q_nb: (4,) wxyz as sent.
            rates: FRD [rad/s] as sent.
            thrust_01: as sent.
            now_us: since boot.
            flying: OFFBOARD is on. Before, setpoints only mark the signal alive.
        """
        has_attitude = not type_mask & NO_ATTITUDE
        if not has_attitude and type_mask & (NO_ROLL_RATE | NO_PITCH_RATE):
            return self._refuse("no_attitude")
        if type_mask & THRUST_BODY:
            thrust_01 = 0.0  # thrust_body is flown instead, and the dialect has no such field: zeros
        elif type_mask & NO_THRUST:
            return self._refuse("no_thrust")
        if self.reject_bad:
            complaint = _complaint(type_mask, q_nb, rates, thrust_01)
            if complaint:
                return self._refuse(complaint)
        self._last_us, self.seen = now_us, True
        if flying:
            self._fly(type_mask, q_nb, rates, thrust_01, has_attitude=has_attitude)
        return True

    def _fly(
        self, type_mask: int, q_nb: Sequence[float], rates: Triple, thrust_01: float, *, has_attitude: bool
    ) -> None:
        stopped = not math.isfinite(thrust_01)
        thrust = 0.0 if stopped else max(0.0, min(1.0, thrust_01))
        yaw_rate = math.nan if type_mask & NO_YAW_RATE else rates[2]
        if not has_attitude:
            asked = rates[0], rates[1], yaw_rate
            self.command = Command(q_nb=IDLE.q_nb, thrust_01=thrust, rate_frd_rad_s=asked, stopped=stopped)
            self.echo = _LEVEL, abs(thrust_01), asked
            return
        size = math.sqrt(dot(q_nb, q_nb))
        self._bad = not (math.isfinite(size) and size > 0.0)
        loose = self.poisoned or self._bad
        q_unit = IDLE.q_nb if loose else np.array(q_nb, dtype=np.float64) / size
        feed = _feed(type_mask, rates)
        self.command = Command(q_nb=q_unit, thrust_01=thrust, feed_frd_rad_s=feed, stopped=stopped, loose=loose)
        self.echo = q_nb, abs(thrust_01), _NO_RATES

    def flown(self) -> None:
        """Note that the attitude controller uses the newest setpoint, so that the one before is skipped."""
        self.poisoned = self.poisoned or self._bad
        self._bad = False

    def spoiled(self, command: Command) -> Command:
        """Return a command of any mode as a corrupted attitude controller flies it: thrust, but no torque."""
        if not self.poisoned or command.loose or command.rate_frd_rad_s is not None:
            return command
        return replace(command, loose=True)

    def _refuse(self, reason: str) -> bool:
        self.refused[reason] += 1
        return False


def _complaint(type_mask: int, q_nb: Sequence[float], rates: Triple, thrust_01: float) -> str:
    """Return why a setpoint would harm PX4; empty when it would not."""
    if not math.isfinite(thrust_01):
        return "not_finite"
    used = [rate for bit, rate in zip((1, 2, 4), rates, strict=True) if not type_mask & bit]
    if not all(math.isfinite(rate) for rate in used):
        return "not_finite"
    if type_mask & NO_ATTITUDE:
        return ""
    size = dot(q_nb, q_nb)
    if not math.isfinite(size):
        return "not_finite"
    return "zero_quaternion" if size < 1e-12 else ""


def _feed(type_mask: int, rates: Triple) -> Triple | None:
    """Return the body rates that act beside an attitude: yaw's as feed-forward, roll's and pitch's against it."""
    roll = 0.0 if type_mask & NO_ROLL_RATE else rates[0] * BOTH_RATES_SHARE
    pitch = 0.0 if type_mask & NO_PITCH_RATE else rates[1] * BOTH_RATES_SHARE
    yaw = 0.0 if type_mask & NO_YAW_RATE else rates[2]
    feed = roll, pitch, yaw
    return feed if any(feed) and all(math.isfinite(rate) for rate in feed) else None
