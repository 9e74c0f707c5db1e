"""The heading of setpoints: the mission's, or one that an operator asks for, turned to at a bounded rate. Pure."""

from __future__ import annotations

import math

_TURNED_RAD = 0.1  # beyond errors of estimates and of flight: the vehicle stands at another heading
_RATE_RAD_S = 1.0  # slow beside the attitude loop, so that thrust keeps pointing where it is planned to


class Heading:
    """Turns from one heading to another the shorter way round.

    Args:
        first_yaw_rad: heading to begin with, clockwise from north.
    """

    def __init__(self, first_yaw_rad: float) -> None:
        self._yaw_rad = first_yaw_rad
        self._then_us: int | None = None

    def begin(self, yaw_rad: float) -> None:
        """Begin from the heading [rad] of a vehicle that somebody else flies, or that stands on the ground."""
        if abs(math.remainder(yaw_rad - self._yaw_rad, math.tau)) > _TURNED_RAD:
            self._yaw_rad = yaw_rad

    def at(self, now_us: int, asked_yaw_rad: float | None) -> float:
        """Return the heading of the setpoint of this tick.

        Args:
            now_us: monotonic time.
            asked_yaw_rad: heading to turn to; None, or what is no finite number: the present one.
        """
        goal_rad = self._yaw_rad if asked_yaw_rad is None or not math.isfinite(asked_yaw_rad) else asked_yaw_rad
        passed_s = 0.0 if self._then_us is None else (now_us - self._then_us) * 1e-6
        self._then_us = now_us
        step_rad = _RATE_RAD_S * min(passed_s, 0.1)  # after a gap the vehicle has not turned meanwhile
        left_rad = math.remainder(goal_rad - self._yaw_rad, math.tau)
        if abs(left_rad) <= step_rad:
            self._yaw_rad = goal_rad
        else:
            self._yaw_rad = math.remainder(self._yaw_rad + math.copysign(step_rad, left_rad), math.tau)
        return self._yaw_rad
