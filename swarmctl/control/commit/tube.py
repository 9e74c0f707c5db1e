"""The bound within which a vehicle is flown around its committed trajectory, and what follows when it leaves it. Pure.

Two committed trajectories keep a distance that leaves each vehicle a *tube*: half of what lies beyond touching bodies.
A vehicle that leaves its tube no longer flies what it has committed to. It commits anew, from the state that was
measured, and tells its peers a wider tube, by which they plan. What happens next depends on how often that happens:

1. *widen*: the agent goes on, in a wider tube, which narrows again;
2. *stop*: it proposes nothing until it has stayed in its tube for a while, and so rests where it stops;
3. *land*: it can't hold any trajectory, and lands where it is.
"""

from __future__ import annotations

import math
from collections import deque
from enum import IntEnum

_WIDENED_S = 0.3  # time for which a deviation is expected to grow at its present speed
_WIDEST_M = 2.0  # a wider tube would only stop everybody else
_NARROWING_S = 1.0  # time constant with which a widened tube narrows
_HELD_US = 1_000_000  # in the tube for this long: it is held again
_WINDOW_US = 10_000_000
_STOPS_AT, _LANDS_AT = 3, 40  # how often a vehicle has left its tube within that window


class Grip(IntEnum):
    """How well a vehicle follows what it commits to."""

    HELD = 0
    WIDENED = 1
    STOPPED = 2
    LOST = 3


class Tube:
    """Watches one vehicle.

    Args:
        nominal_m: radius of the tube that all distances leave room for.

    Attributes:
        radius_m: what peers are told, `nominal_m` or more.
        worst_m: largest deviation so far.
    """

    def __init__(self, nominal_m: float) -> None:
        self._nominal_m = nominal_m
        self._left_us: deque[int] = deque()
        self._updated_us: int | None = None
        self.radius_m, self.worst_m = nominal_m, 0.0

    def update(self, utc_us: int, error_m: float, error_m_s: float) -> bool:
        """Take in the deviation from the committed trajectory, of position and of velocity.

        Returns:
            whether the vehicle has left its tube, so that it has to commit anew.
        """
        since_us = 0 if self._updated_us is None else utc_us - self._updated_us
        self._updated_us = utc_us
        self.worst_m = max(self.worst_m, error_m)
        while self._left_us and utc_us - self._left_us[0] > _WINDOW_US:
            self._left_us.popleft()
        widened_m = (self.radius_m - self._nominal_m) * math.exp(-1e-6 * since_us / _NARROWING_S)
        left = error_m > self._nominal_m
        if left:
            self._left_us.append(utc_us)
            widened_m = max(widened_m, min(_WIDEST_M, _WIDENED_S * error_m_s))
        self.radius_m = self._nominal_m + widened_m
        return left

    def grip(self, utc_us: int) -> Grip:
        """Return how well the vehicle follows its commitments now."""
        if not self._left_us:
            return Grip.HELD
        if len(self._left_us) >= _LANDS_AT:
            return Grip.LOST
        if utc_us - self._left_us[-1] >= _HELD_US:
            return Grip.HELD
        return Grip.STOPPED if len(self._left_us) >= _STOPS_AT else Grip.WIDENED
