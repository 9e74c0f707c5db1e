"""The bound within which a vehicle is flown around its committed trajectory, and what follows when it leaves it. Pure.

Two committed trajectories keep a distance that leaves each vehicle a *tube*: half of what lies beyond touching bodies.
A vehicle that leaves its tube tells its peers a wider one, by which they plan, and which narrows again once it is back.
It also *slows*: it plans to go on at a share of its pace that is the less the farther outside it is, down to standing,
and that it regains little by little. A vehicle that merely lags need not hurry, because what is flown waits for it
(`Commitments.wait_for`): it is on its way to the places it has committed to.

A vehicle that is blown away, or far outside, no longer flies what it has committed to. One that is less far had better
return: its commitment keeps clear of all others, a new one from beside it may not. But one that rests there, and comes
no nearer, never will, as where it has evaded to beyond the flight volume, which it is flown back into. Peers
keep clear of the wider tube, where it is. What follows depends on how often a commitment is lost:

1. *widen*: it commits anew, from the state that was measured, and goes on;
2. *stop*: it proposes nothing until it has lost none for a while, and so rests where it stops;
3. *land*: it can't hold any trajectory, and lands where it is.
"""

from __future__ import annotations

import math
from collections import deque
from enum import IntEnum

_WIDENED_S = 0.3  # time for which a deviation is expected to grow at its present speed
_WIDEST_M = 2.0  # a wider tube would only stop everybody else
_NARROWING_S = 1.0  # time constant with which a widened tube narrows
_BLOWN_M, _BLOWN_M_S = 0.15, 1.0  # outside the tube, and moving away: gusts do that
_FAR_M = 0.5  # outside the tube, however slowly; trackers of real autopilots lag by 0.27 m at most (PX4 1.18)
_SLOWS_M, _STANDS_M = 0.03, 0.13  # outside the tube: where it begins to plan to be slower, and plans to stand
_REGAINED_S = 2.0  # time in which it then goes from rest to its full pace again
_RESTS_M_S, _NEARER_M = 0.1, 0.02  # outside the tube: slower a vehicle rests, by more it comes nearer
_PATIENCE_US = 3_000_000  # for which a vehicle may rest there: peers have planned anew since it does
_HELD_US = 1_000_000  # nothing lost for this long: what is committed is held again
_WINDOW_US = 10_000_000
_STOPS_AT, _LANDS_AT = 3, 40  # how often a commitment has been lost within that window


class Grip(IntEnum):
    """How well a vehicle follows what it commits to."""

    HELD = 0
    OUTSIDE = 1  # of the tube, slower, on the way back
    WIDENED = 2
    STOPPED = 3
    LOST = 4


class Tube:
    """Watches one vehicle.

    Args:
        nominal_m: radius of the tube that all distances leave room for.

    Attributes:
        radius_m: what peers are told, `nominal_m` or more.
        worst_m: largest deviation so far.
        pace_01: share of its speed at which it may plan to go on.
    """

    def __init__(self, nominal_m: float) -> None:
        self._nominal_m = nominal_m
        self._lost_us: deque[int] = deque()
        self._updated_us: int | None = None
        self._is_outside = False
        self._nearest_m, self._nearest_us = math.inf, 0  # to what is committed since it rests outside, and when
        self.radius_m, self.worst_m, self.pace_01 = nominal_m, 0.0, 1.0

    def update(
        self, utc_us: int, error_m: float, error_m_s: float, late_m: float = 0.0, *, speed_m_s: float = math.inf
    ) -> bool:
        """Take in the deviation from the committed trajectory, of position and of velocity.

        Args:
            utc_us: now.
            error_m, error_m_s: deviations.
            late_m: how far behind the committed trajectory the vehicle is flown along it, because it lags.
            speed_m_s: of the vehicle.

        Returns:
            whether the commitment is lost, so that the vehicle has to commit anew.
        """
        since_us = 0 if self._updated_us is None else utc_us - self._updated_us
        self._updated_us = utc_us
        self.worst_m = max(self.worst_m, error_m)
        while self._lost_us and utc_us - self._lost_us[0] > _WINDOW_US:
            self._lost_us.popleft()
        widened_m = (self.radius_m - self._nominal_m) * math.exp(-1e-6 * since_us / _NARROWING_S)
        beyond_m = error_m - self._nominal_m
        self._is_outside = beyond_m > 0.0
        if self._is_outside:
            widened_m = max(widened_m, min(_WIDEST_M, beyond_m + _WIDENED_S * error_m_s))
        self.radius_m = self._nominal_m + widened_m
        regained_01 = self.pace_01 + 1e-6 * since_us / _REGAINED_S
        self.pace_01 = max(0.0, min(1.0, regained_01, (_STANDS_M - beyond_m) / (_STANDS_M - _SLOWS_M)))
        is_lost = beyond_m > _FAR_M or (beyond_m - late_m > _BLOWN_M and error_m_s > _BLOWN_M_S)
        is_lost |= self._rests_in_vain(utc_us, error_m, speed_m_s)
        if is_lost:
            self._lost_us.append(utc_us)
        return is_lost

    def _rests_in_vain(self, utc_us: int, error_m: float, speed_m_s: float) -> bool:
        """Return whether the vehicle has long rested outside the tube, and come no nearer to its commitment."""
        rests = self._is_outside and speed_m_s < _RESTS_M_S
        if not rests or error_m < self._nearest_m - _NEARER_M:
            self._nearest_m, self._nearest_us = error_m, utc_us
        return utc_us - self._nearest_us > _PATIENCE_US

    def grip(self, utc_us: int) -> Grip:
        """Return how well the vehicle follows its commitments now."""
        if len(self._lost_us) >= _LANDS_AT:
            return Grip.LOST
        if not self._lost_us or utc_us - self._lost_us[-1] >= _HELD_US:
            return Grip.OUTSIDE if self._is_outside else Grip.HELD
        return Grip.STOPPED if len(self._lost_us) >= _STOPS_AT else Grip.WIDENED
