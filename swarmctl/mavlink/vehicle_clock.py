"""The vehicle's clock against ours: offset and rate, from arrivals that are never early and round trips as bounds.

A stamp that arrives at y was true at most at y: the line under all points (stamp, arrival), touching the earliest ones,
is the clock seen through the shortest delay. An answered TIMESYNC says that it can't have been before the question, and
how long the shortest way is. Autopilots' time runs up to some percent off ours, and in simulators it also stands still.

A stamp far in the past or ahead of what that line allows is refused. Only when several of them follow each other and
agree has the clock begun again; and only when another message's boot time agrees with them has the vehicle rebooted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

_BUCKET_US = 250_000  # of vehicle time; the earliest arrival of each is kept
_BUCKETS = 32
_RATE_AFTER_US = 1_000_000  # points must span this before a rate is believed
_KNEE_01 = 0.6  # the part of the line under this share of the window is continued to now
_PAST_US = 1_000_000  # a stamp farther back is of another boot, or wrong
_EARLY_US = 30_000  # what an arrival may be too early by, once a rate is known
_EARLY_01 = 0.2  # and more for every second since the newest one: no clock's rate is farther off
_SETTLED = 10  # stamps, before which the clock may begin again without a reboot: the first of all may be wrong
_RUN, _RUN_US = 5, 100_000  # stamps that follow each other and agree, and the time they span
_AGREE_US = 100_000  # within a run
_SAME_BOOT_US = 500_000  # of two kinds of message
_WITNESSES = 2  # frames of another kind
_PATIENCE_US = 3_000_000  # a run this long needs no witness: nothing else comes from the vehicle any more
_BOUND_SLACK_US = 1_000
_MOVED_US = 5_000  # a line that misses more is of before the clock stood still; less, the bound itself corrects
_UNKNOWN_RATE_US = 200_000  # the same while no rate is known
_LOOP_US = 4_000  # of what is left between the bounds, what an autopilot's own loop may take to answer
_QUESTIONS = 32  # remembered

Point = tuple[float, float]  # stamp, arrival - stamp [us]


@dataclass(slots=True)
class _Run:
    """Stamps that follow each other, do not fit the line, and agree."""

    began_us: int  # our time
    late_us: int  # arrival - stamp of the first
    count: int = 1

    def takes(self, late_us: int, arrived_us: int) -> bool:
        """Whether another stamp agrees; then it is counted."""
        agrees = abs(late_us - self.late_us) < _AGREE_US + _EARLY_01 * (arrived_us - self.began_us)
        self.count += agrees
        return agrees


class VehicleClock:
    """Maps vehicle stamps to our monotonic time.

    Args:
        rate_limit: largest difference of the clocks' rates that is believed; 0 follows the offset only.

    Attributes:
        boots: how often the vehicle has rebooted.
        restarts: how often its clock has begun again, for that or another reason.
        refused: stamps that were not believed.
        answered: how many round trips have been taken in.
        rate: by how much our clock runs faster than the vehicle's.
    """

    def __init__(self, rate_limit: float = 0.2) -> None:
        self._limit = rate_limit
        self.boots = self.restarts = self.refused = self.answered = 0
        self.rate = 0.0
        self._offset_us = 0.0  # at stamp 0, along the line
        self._points: deque[Point] = deque(maxlen=_BUCKETS)
        self._floor: Point | None = None  # stamp of the newest answered TIMESYNC, and what the line is at least there
        self._newest_us: int | None = None
        self._arrived_us = 0  # when that came
        self._taken = 0  # stamps since the clock began
        self._run: _Run | None = None
        self._witnesses: dict[str, deque[tuple[int, int]]] = {}  # kind -> arrival, arrival - stamp of its newest
        self._asked: deque[Point] = deque(maxlen=_QUESTIONS)  # stamp of an answer, question - stamp

    @property
    def offset_us(self) -> float | None:
        """Our time minus the vehicle's, at its newest stamp; None before the first."""
        if self._newest_us is None:
            return None
        return self._line(self._newest_us) - self._way_us

    def to_local(self, vehicle_us: int, arrived_us: int) -> int | None:
        """Our time of a vehicle stamp that arrived at `arrived_us`; None for one that is not believed."""
        late_us = arrived_us - vehicle_us
        if self._newest_us is None:
            self._begin_again(vehicle_us, late_us)
        elif self._fits(vehicle_us, arrived_us):
            self._run = None
        elif not self._has_begun_again(vehicle_us, arrived_us):
            self.refused += 1
            return None
        assert self._newest_us is not None
        residual_us = late_us - self._line(vehicle_us)
        rolled = self._keep(float(vehicle_us), float(late_us))
        self._newest_us, self._arrived_us = max(self._newest_us, vehicle_us), max(self._arrived_us, arrived_us)
        self._taken += 1
        if rolled or residual_us < 0.0:
            self._fit()
        return vehicle_us + round(self._line(vehicle_us) - self._way_us)

    def witness(self, kind: str, vehicle_us: int, arrived_us: int) -> None:
        """The boot time that a message of another kind than the stamps' tells."""
        told = self._witnesses.setdefault(kind, deque(maxlen=_WITNESSES))
        told.append((arrived_us, arrived_us - vehicle_us))

    def round_trip(self, asked_us: int, vehicle_us: int, arrived_us: int) -> None:
        """An answered TIMESYNC: the vehicle's clock read `vehicle_us` between `asked_us` and `arrived_us` of ours."""
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
            self._points.clear()  # the others are of before the vehicle's clock stood still
            self._points.extend(fresh or [(float(vehicle_us), float(arrived_us - vehicle_us))])
            self._fit()
        self._asked.append((float(vehicle_us), float(asked_us - vehicle_us)))

    @property
    def _way_us(self) -> float:
        """Shortest one-way delay, which the line does not know: half of what the bounds leave between them.

        That is the shortest way here, and the shortest way there of the questions remembered.
        """
        if not self._asked or not self._spans():  # until the rate is known the line may be far too low
            return 0.0
        left_us = min(self._offset_us + self.rate * x - y for x, y in self._asked)
        return 0.5 * max(0.0, left_us - _LOOP_US)

    def _line(self, vehicle_us: float) -> float:
        """Our time minus the vehicle's at a stamp, as seen through the shortest delay."""
        line = self._offset_us + self.rate * vehicle_us
        if self._floor is None:
            return line
        stamp_us, least_us = self._floor
        return max(line, least_us + self.rate * (vehicle_us - stamp_us))

    def _spans(self) -> bool:
        return len(self._points) > 1 and self._points[-1][0] - self._points[0][0] >= _RATE_AFTER_US

    def _fits(self, vehicle_us: int, arrived_us: int) -> bool:
        """Whether the clock can have read this: any delay is possible, an arrival before the line hardly."""
        assert self._newest_us is not None
        allowed_us = _EARLY_US if self._spans() else _UNKNOWN_RATE_US
        allowed_us += round(_EARLY_01 * max(0, arrived_us - self._arrived_us))
        early_us = self._line(vehicle_us) - (arrived_us - vehicle_us)
        return vehicle_us >= self._newest_us - _PAST_US and early_us <= allowed_us

    def _has_begun_again(self, vehicle_us: int, arrived_us: int) -> bool:
        """Whether a stamp that does not fit is one too many to be merely wrong; then the clock begins with it."""
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
        """Whether another kind of message tells the same moment of boot, since the run began."""
        return any(
            len(told) == _WITNESSES
            and all(at >= run.began_us and abs(late - run.late_us) < _SAME_BOOT_US for at, late in told)
            for told in self._witnesses.values()
        )

    def _begin_again(self, vehicle_us: int, late_us: int) -> None:
        self._run, self._taken = None, 0
        self._points.clear()
        self._asked.clear()
        self._floor = None
        self._newest_us, self.rate, self._offset_us = vehicle_us, 0.0, float(late_us)

    def _keep(self, x: float, y: float) -> bool:
        """Take a point into its bucket if it is the earliest there; whether that began a new bucket."""
        if self._points and x // _BUCKET_US <= self._points[-1][0] // _BUCKET_US:
            last_x, last_y = self._points[-1]
            if y - self.rate * x < last_y - self.rate * last_x:
                self._points[-1] = (x, y)
            return False
        self._points.append((x, y))
        return True

    def _fit(self) -> None:
        if self._spans():
            first, last = self._points[0][0], self._points[-1][0]
            rate = _slope_under(self._points, first + _KNEE_01 * (last - first))
            self.rate = max(-self._limit, min(self._limit, rate))
        self._offset_us = min(y - self.rate * x for x, y in self._points)


def _slope_under(points: deque[Point], at: float) -> float:
    """Slope of the lower convex hull of points (ascending x) at `at`."""
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
