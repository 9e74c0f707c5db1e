"""Offset and rate of the vehicle's clock against ours, from arrivals, which are never early, and round-trip bounds.

A stamp that arrives at y was taken at y or before: the line under all points (stamp, arrival) that touches the earliest
ones is the clock seen through the shortest delay. An answered TIMESYNC bounds the line from the other side, because the
answer is later than the request, and gives the shortest delay. Delays that creep up look like a slower clock, but move
the bounds apart: by as much as they have never been before, stamps are older. Autopilot clocks run up to some percent
off ours, and simulated ones also stand still.

A stamp far in the past, or ahead of what the line allows, is refused. The clock is taken to have restarted only when
several refused stamps follow and agree with each other, and the vehicle to have rebooted only when the boot time of
another message agrees with them.

Most messages tell the time since boot in 32 bits of milliseconds, which begin again after 49.7 days. Those that do so
when the vehicle's clock is expected to be there have only begun another turn.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from itertools import pairwise

_BUCKET_US = 250_000  # of vehicle time; the earliest arrival of each bucket is kept
_BUCKETS = 32
_RATE_AFTER_US = 1_000_000  # points must span this before a rate is believed
_KNEE_01 = 0.6  # the line at this share of the window is extrapolated to now
_PAST_US = 1_000_000  # an older stamp is of another boot, or wrong
_EARLY_US = 30_000  # tolerated early arrival once a rate is known
_EARLY_01 = 0.2  # added for every second since the newest stamp: no clock's rate is farther off
_SETTLED = 10  # before this many stamps the clock may restart without a reboot: the very first may be wrong
_RUN, _RUN_US = 5, 100_000  # stamps that follow and agree with each other, and the time they span
_AGREE_US = 100_000  # agreement within a run
_SAME_BOOT_US = 500_000  # agreement of two kinds of message
_WITNESSES = 2  # frames of another kind
_PATIENCE_US = 3_000_000  # a run this long needs no witness: the vehicle sends nothing else any more
_BOUND_SLACK_US = 1_000
_MOVED_US = 5_000  # a line farther below the bound is older than a stop of the clock; else the bound corrects it
_UNKNOWN_RATE_US = 200_000  # the same while no rate is known
_TURN_US = 2**32 * 1000  # after which `time_boot_ms` begins again
_TURNED_US = 2_000_000  # by which it may then differ from what is expected: later frames wait in links
_LOOP_US = 4_000  # time an autopilot's loop may take to answer, of what is left between the bounds
_QUESTIONS = 8  # requests remembered: a second and a half, in which a delay that creeps up gains little

Point = tuple[float, float]  # stamp, arrival - stamp [us]


@dataclass(slots=True)
class _Run:
    """A run of consecutive stamps that do not fit the line but agree with each other."""

    began_us: int  # host time
    late_us: int  # arrival minus stamp of the first one
    count: int = 1

    def takes(self, late_us: int, arrived_us: int) -> bool:
        """Count another stamp if it agrees, and return whether it does."""
        agrees = abs(late_us - self.late_us) < _AGREE_US + _EARLY_01 * (arrived_us - self.began_us)
        self.count += agrees
        return agrees


class VehicleClock:
    """Maps vehicle time stamps to monotonic host time.

    Args:
        rate_limit: largest believed difference of the clock rates; 0 follows the offset only.

    Attributes:
        boots: number of reboots of the vehicle.
        restarts: number of restarts of its clock, for that or another reason.
        refused: number of refused stamps.
        answered: number of round trips used.
        rate: relative rate by which the host clock is faster than the vehicle's.
    """

    def __init__(self, rate_limit: float = 0.2) -> None:
        self._limit = rate_limit
        self.boots = self.restarts = self.refused = self.answered = 0
        self.rate = 0.0
        self._offset_us = 0.0  # at stamp 0, along the line
        self._points: deque[Point] = deque(maxlen=_BUCKETS)
        self._is_fitted = False  # since the points have changed
        self._floor: Point | None = None  # stamp of the newest answered TIMESYNC, and the lower bound of the line there
        self._newest_us: int | None = None
        self._arrived_us = 0  # arrival of that stamp
        self._taken = 0  # stamps since the clock began
        self._run: _Run | None = None
        # kind of message -> arrival, arrival - stamp of its newest frames
        self._witnesses: dict[Hashable, deque[tuple[int, int]]] = {}
        self._asked: deque[Point] = deque(maxlen=_QUESTIONS)  # stamp of an answer, request - stamp
        self._left_us: float | None = None  # least distance of these from the line; None since one of both has changed
        self._least_left_us = math.inf  # the least of those since the clock began

    @property
    def offset_us(self) -> float | None:
        """Host time minus vehicle time at the newest stamp; None before the first."""
        if self._newest_us is None:
            return None
        return self._line(self._newest_us) - self._one_way_delay_us

    def boot_us(self, boot_ms: int, arrived_us: int) -> int:
        """Return the time since boot [us] of a `time_boot_ms`, with the turns that it has made."""
        vehicle_us = boot_ms * 1000
        if self._newest_us is None:
            return vehicle_us
        since_us = arrived_us - self._arrived_us
        expected_us = self._newest_us + since_us
        turned_us = vehicle_us + max(0, round((expected_us - vehicle_us) / _TURN_US)) * _TURN_US
        is_expected = abs(turned_us - expected_us) < _TURNED_US + _EARLY_01 * max(0, since_us)
        return turned_us if is_expected else vehicle_us

    def to_local(self, vehicle_us: int, arrived_us: int) -> int | None:
        """Return the host time of a vehicle stamp that arrived at `arrived_us`; None for a refused stamp."""
        late_us = arrived_us - vehicle_us
        if self._newest_us is None:
            self._begin_again(vehicle_us, late_us)
        line_us = self._line(vehicle_us)
        if self._fits(vehicle_us, arrived_us, line_us):
            self._run = None
        elif self._has_begun_again(vehicle_us, arrived_us):
            line_us = self._line(vehicle_us)
        else:
            self.refused += 1
            return None
        assert self._newest_us is not None
        rolled = self._keep(float(vehicle_us), float(late_us))
        self._newest_us, self._arrived_us = max(self._newest_us, vehicle_us), max(self._arrived_us, arrived_us)
        self._taken += 1
        if rolled or late_us < line_us:
            self._fit()
            line_us = self._line(vehicle_us)
        return vehicle_us + round(line_us - self._one_way_delay_us)

    def witness(self, kind: Hashable, vehicle_us: int, arrived_us: int) -> None:
        """Note the boot time that a message of another kind reports."""
        told = self._witnesses.get(kind)
        if told is None:
            told = self._witnesses[kind] = deque(maxlen=_WITNESSES)
        told.append((arrived_us, arrived_us - vehicle_us))

    def round_trip(self, asked_us: int, vehicle_us: int, arrived_us: int) -> None:
        """Take an answered TIMESYNC: the vehicle read `vehicle_us` between host times `asked_us` and `arrived_us`."""
        if self._newest_us is not None:  # turns before the first stamp are in no other message
            turned_us = vehicle_us - round((vehicle_us - self._newest_us) / _TURN_US) * _TURN_US
            vehicle_us = turned_us if abs(turned_us - self._newest_us) <= _PAST_US else vehicle_us
        self.witness("TIMESYNC", vehicle_us, arrived_us)
        if self._newest_us is None or abs(vehicle_us - self._newest_us) > _PAST_US or arrived_us < asked_us:
            return  # another time base than the stamps of the state
        self.answered += 1
        least_us = float(asked_us - vehicle_us - _BOUND_SLACK_US)
        if least_us > self._offset_us + self.rate * vehicle_us:
            self._fit()
        missing_us = least_us - (self._offset_us + self.rate * vehicle_us)
        self._floor = (float(vehicle_us), least_us)
        if missing_us > (_MOVED_US if self._spans() else _UNKNOWN_RATE_US):
            fresh = [(x, y) for x, y in self._points if y + self.rate * (vehicle_us - x) >= least_us]
            self._points.clear()  # the others are older than the stop of the vehicle's clock
            self._points.extend(fresh or [(float(vehicle_us), float(arrived_us - vehicle_us))])
            self._is_fitted = False
            self._fit()
        self._asked.append((float(vehicle_us), float(asked_us - vehicle_us)))
        self._left_us = None

    @property
    def _one_way_delay_us(self) -> float:
        """Shortest one-way delay of late, which the line can't show.

        The bounds are the shortest delay of stamps, and the shortest delay of the remembered requests. Half of the
        least that they have ever left between them is the delay of one way; which way has become slower since is
        unknown, so all of what was added counts.
        """
        if not self._asked or not self._spans():  # until the rate is known the line may be far too low
            return 0.0
        if self._left_us is None:
            offset_us, rate = self._offset_us, self.rate
            self._left_us = max(0.0, min([offset_us + rate * x - y for x, y in self._asked]))
            self._least_left_us = min(self._least_left_us, self._left_us)
        grown_us = max(0.0, self._left_us - self._least_left_us - _LOOP_US)
        return 0.5 * max(0.0, self._least_left_us - _LOOP_US) + grown_us

    def _line(self, vehicle_us: float) -> float:
        """Host time minus vehicle time at a stamp, including the shortest delay."""
        line = self._offset_us + self.rate * vehicle_us
        if self._floor is None:
            return line
        stamp_us, least_us = self._floor
        return max(line, least_us + self.rate * (vehicle_us - stamp_us))

    def _spans(self) -> bool:
        return len(self._points) > 1 and self._points[-1][0] - self._points[0][0] >= _RATE_AFTER_US

    def _fits(self, vehicle_us: int, arrived_us: int, line_us: float) -> bool:
        """Return whether the clock can have read this: any delay is possible, an arrival before the line hardly."""
        assert self._newest_us is not None
        allowed_us = _EARLY_US if self._spans() else _UNKNOWN_RATE_US
        allowed_us += round(_EARLY_01 * max(0, arrived_us - self._arrived_us))
        early_us = line_us - (arrived_us - vehicle_us)
        return vehicle_us >= self._newest_us - _PAST_US and early_us <= allowed_us

    def _has_begun_again(self, vehicle_us: int, arrived_us: int) -> bool:
        """Return whether stamps that do not fit show a restart of the clock; then it restarts with this one."""
        late_us, run = arrived_us - vehicle_us, self._run
        if run is None or not run.takes(late_us, arrived_us):
            self._run = run = _Run(arrived_us, late_us)
        lasted_us = arrived_us - run.began_us
        if run.count < _RUN or lasted_us < _RUN_US:
            return False
        assert self._newest_us is not None
        back = vehicle_us < self._newest_us and self._taken >= _SETTLED
        if back and lasted_us < _PATIENCE_US and not self._borne_out(run):
            return False
        self.boots += back
        self.restarts += 1
        self._begin_again(vehicle_us, late_us)
        return True

    def _borne_out(self, run: _Run) -> bool:
        """Return whether another kind of message gives the same moment of boot since the run began."""
        return any(
            len(told) == _WITNESSES
            and all(at >= run.began_us and abs(late - run.late_us) < _SAME_BOOT_US for at, late in told)
            for told in self._witnesses.values()
        )

    def _begin_again(self, vehicle_us: int, late_us: int) -> None:
        self._run, self._taken = None, 0
        self._points.clear()
        self._asked.clear()
        self._floor, self._left_us, self._least_left_us = None, None, math.inf
        self._newest_us, self.rate, self._offset_us = vehicle_us, 0.0, float(late_us)

    def _keep(self, x: float, y: float) -> bool:
        """Keep a point if it is the earliest in its bucket; return whether it began a new bucket."""
        if self._points and x // _BUCKET_US <= self._points[-1][0] // _BUCKET_US:
            last_x, last_y = self._points[-1]
            if y - self.rate * x < last_y - self.rate * last_x:
                self._points[-1], self._is_fitted = (x, y), False
            return False
        self._points.append((x, y))
        self._is_fitted = False
        return True

    def _fit(self) -> None:
        """Lay the line under the points, unless it is."""
        if self._is_fitted:
            return
        self._is_fitted = True
        if self._spans():
            first, last = self._points[0][0], self._points[-1][0]
            rate = _slope_under(self._points, first + _KNEE_01 * (last - first))
            self.rate = max(-self._limit, min(self._limit, rate))
        self._offset_us = min(y - self.rate * x for x, y in self._points)
        self._left_us = None


def _slope_under(points: deque[Point], at: float) -> float:
    """Return the slope of the lower convex hull of points (ascending x) at `at`."""
    hull: list[Point] = []
    for x, y in points:
        while len(hull) > 1 and _turns_down(hull[-2], hull[-1], (x, y)):
            hull.pop()
        hull.append((x, y))
    for left, right in pairwise(hull):
        if right[0] >= at:
            return (right[1] - left[1]) / (right[0] - left[0])
    return 0.0


def _turns_down(a: Point, b: Point, c: Point) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
