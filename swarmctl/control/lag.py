"""Second-order lag of an attitude loop behind its setpoint, exact for commands held over equal steps.

    tilt'' = w^2 (u - tilt) - 2 zeta w tilt'

where u is the commanded and tilt the realised horizontal part of the body's down axis. A real PX4 quadrotor has w 9 to
10.5 rad/s, zeta 0.95 to 1.05, and a dead time of 80 ms, which is not part of the lag (`VehicleModelParams.delay_s`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmctl.core.types import Array

_TERMS = 16  # terms of the Taylor series: exact to rounding over one step
_STEP_RAD = 0.5  # largest step, times the natural frequency


@dataclass(frozen=True, slots=True)
class Lag:
    """A second-order lag with natural frequency [rad/s] and damping ratio."""

    natural_rad_s: float
    damping: float

    @property
    def ramp_delay_s(self) -> float:
        """Return the time [s] by which a steady ramp of the command leads the realised tilt."""
        return 2.0 * self.damping / self.natural_rad_s

    def advance(self, tilt: float, rate_1_s: float, command: float, t_s: float) -> tuple[float, float, float]:
        """Return tilt [1], its rate [1/s] and its integral [s] after `t_s` of a held command."""
        count = max(1, math.ceil(self.natural_rad_s * t_s / _STEP_RAD))
        total = 0.0
        for _ in range(count):
            tilt, rate_1_s, integral = self._step(tilt, rate_1_s, command, t_s / count)
            total += integral
        return tilt, rate_1_s, total

    def _step(self, tilt: float, rate_1_s: float, command: float, t_s: float) -> tuple[float, float, float]:
        """Sum the Taylor series of e = tilt - command, e'' = -w^2 e - 2 zeta w e', of its rate and its integral."""
        stiffness, friction = self.natural_rad_s**2, 2.0 * self.damping * self.natural_rad_s
        this, following = tilt - command, rate_1_s  # n-th derivative of e, and the next
        power = 1.0  # t^n / n!
        error = rate = integral = 0.0
        for n in range(_TERMS):
            error += this * power
            rate += following * power
            integral += this * power * t_s / (n + 1)
            power *= t_s / (n + 1)
            this, following = following, -stiffness * this - friction * following
        return command + error, rate, command * t_s + integral


@dataclass(frozen=True, slots=True)
class LagResponse:
    """Holds mean realised tilts over equal steps: due to a command held over one step, and to the initial state."""

    of_command: Array  # (steps, steps) lower triangular
    of_tilt: Array  # (steps,)
    of_rate_s: Array  # (steps,)


def lag_response(lag: Lag | None, dt_s: float, steps: int) -> LagResponse:
    """Return the response over `steps` steps of `dt_s`; without a lag the command is realised at once."""
    if lag is None:
        return LagResponse(np.eye(steps), np.zeros(steps), np.zeros(steps))
    of_tilt, of_rate_s, held = (
        _means(lag, *start, dt_s=dt_s, steps=steps) for start in ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    pulse = np.diff(held, prepend=0.0)
    since = np.subtract.outer(np.arange(steps), np.arange(steps))
    return LagResponse(np.where(since >= 0, pulse[np.maximum(since, 0)], 0.0), of_tilt, of_rate_s)


def _means(lag: Lag, tilt: float, rate_1_s: float, command: float, *, dt_s: float, steps: int) -> Array:
    means = np.empty(steps)
    for k in range(steps):
        tilt, rate_1_s, integral = lag.advance(tilt, rate_1_s, command, dt_s)
        means[k] = integral / dt_s
    return means
