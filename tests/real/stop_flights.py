"""Flies real vehicles along courses, leaves each to its autopilot at their ends, and keeps what they truly did then."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence

import numpy as np
from pymavlink.dialects.v20 import development as mav

from swarmctl.process_priority import request_realtime_for_this_thread
from tests.benches.stops import (
    AIRFRAMES,
    SILENCE,
    WATCHED_S,
    Array,
    Course,
    Reference,
    Stop,
    Track,
    setpoint,
    transfer,
)
from tests.real.autopilots import ARDUCOPTER, PX4, SPACING_M, north_m
from tests.real.conftest import Field

PERIOD_S = 0.02
BEAT_S = 1.0  # as agents send heartbeats
HEIGHT_M = 14.0  # from which landings do not reach the ground meanwhile
APART_M = 45.0
TRANSFER_M_S = 2.5
RESTS_S = 1.5  # before a course
ATTITUDE = 7  # type_mask
NAMES = {PX4.variable: "px4", ARDUCOPTER.variable: "arducopter"}
MODES: dict[str, dict[str, tuple[int, ...]]] = {
    PX4.variable: {"guided": (6,), "hold": (4, 3), "land": (4, 6)},
    ARDUCOPTER.variable: {"guided": (4,), "brake": (17,), "loiter": (5,), "land": (9,)},
}

Case = tuple[Course, str]


class StopFlight:
    """Flies cases with every vehicle of a field, each one its own, all at the same time."""

    def __init__(self, here: Field, cases: Sequence[Sequence[Case]]) -> None:
        self._here, self._kind, self._cases = here, here.fleet.kind, cases
        self._airframe = AIRFRAMES[NAMES[self._kind.variable]]
        self.tracks = [Track() for _ in cases]
        self.stops: list[list[Stop]] = [[] for _ in cases]
        self._beat_s = [0.0 for _ in cases]

    # --- what a vehicle is told ---

    def _mode(self, index: int, name: str) -> None:
        self._here.witness.command(index, mav.MAV_CMD_DO_SET_MODE, 1, *MODES[self._kind.variable][name])

    def _aim(self, index: int, reference: Reference, t_s: float) -> None:
        pos, vel = self.tracks[index].newest()
        q_nb, thrust_01 = setpoint(reference, t_s, pos, vel, self._airframe)
        numbers = 0, index + 1, 1, ATTITUDE, [float(c) for c in q_nb], 0.0, 0.0, 0.0, thrust_01
        self._here.witness.say(index, mav.MAVLink_set_attitude_target_message(*numbers))
        self._beat(index)

    def _beat(self, index: int) -> None:
        now_s = time.monotonic()
        if now_s - self._beat_s[index] >= BEAT_S:
            self._beat_s[index] = now_s
            beat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
            self._here.witness.say(index, beat)

    # --- the flight of one vehicle, a step of 20 ms at a time ---

    def _follow(self, index: int, reference: Reference, duration_s: float) -> Iterator[None]:
        began_s = time.monotonic()
        while (t_s := time.monotonic() - began_s) < duration_s:
            self._aim(index, reference, t_s)
            yield

    def _go(self, index: int, to_ned_m: Array) -> Iterator[None]:
        start, _ = self.tracks[index].newest()
        lasts_s = max(3.0, 1.9 * float(np.linalg.norm(to_ned_m - start)) / TRANSFER_M_S)
        yield from self._follow(index, lambda t_s: transfer(start, to_ned_m, t_s, lasts_s), lasts_s + RESTS_S)

    def _wait(self, lasts_s: float) -> Iterator[None]:
        until_s = time.monotonic() + lasts_s
        while time.monotonic() < until_s:
            yield

    def _take_off(self, index: int) -> Iterator[None]:
        seen = self._here.witness.vehicles[index]
        place, _ = self.tracks[index].newest()
        sunk, low = place + np.array([0.0, 0.0, 3.0]), place - np.array([0.0, 0.0, 3.0])
        if self._kind is PX4:
            while not seen.armed:
                self._mode(index, "guided")
                self._here.witness.command(index, mav.MAV_CMD_COMPONENT_ARM_DISARM, 1)
                yield from self._follow(index, lambda t_s: (sunk, np.zeros(3), np.zeros(3)), 1.2)
        else:
            while not seen.armed:
                self._beat(index)
                self._mode(index, "guided")
                self._here.witness.command(index, mav.MAV_CMD_COMPONENT_ARM_DISARM, 1)
                yield from self._wait(1.2)
            self._here.witness.command(index, mav.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 3.0)
            while seen.height_m() < 2.5:
                self._beat(index)
                yield
        yield from self._go(index, low)

    def _flight(self, index: int) -> Iterator[None]:
        yield from self._take_off(index)
        base = np.array([north_m(index, len(self._cases)) / SPACING_M * APART_M, 0.0, 0.0])
        base[2] = self.tracks[index].newest()[0][2] + 3.0 - HEIGHT_M
        yield from self._go(index, np.array([*self.tracks[index].newest()[0][:2], base[2]]))
        for course, how in self._cases[index]:
            last, _, _ = course.at(course.duration_s)
            if math.isinf(course.radius_m):
                middle = 0.5 * last
            else:
                side = [-math.sin(course.heading_rad), math.cos(course.heading_rad), 0.0]
                middle = course.radius_m * np.array(side)
            begin = base - middle
            yield from self._go(index, begin)
            yield from self._fly(index, course, begin)
            yield from self._leave(index, course, how)
        yield from self._go(index, base)
        while True:
            self._mode(index, "land")
            yield from self._wait(2.0)

    def _fly(self, index: int, course: Course, begin: Array) -> Iterator[None]:
        def reference(t_s: float) -> tuple[Array, Array, Array]:
            way, vel, accel = course.at(t_s)
            return begin + way, vel, accel

        yield from self._follow(index, reference, course.duration_s)

    def _leave(self, index: int, course: Course, how: str) -> Iterator[None]:
        left_s, track = time.monotonic(), self.tracks[index]
        if how != SILENCE:
            self._mode(index, how)
        first = next(i for i, t_s in enumerate(track.t_s) if t_s >= left_s - 1.0)
        until_s = left_s + WATCHED_S + 0.3
        while time.monotonic() < until_s:
            if how != SILENCE:
                self._beat(index)
            yield
        beat_s = self._beat_s[index]
        stop = Stop(course=course, how=how, left_s=left_s, beat_s=beat_s, track=track.since(first))
        self.stops[index].append(stop)
        place, _ = track.newest()
        self._beat_s[index] = 0.0
        stays = lambda t_s: (place, np.zeros(3), np.zeros(3))  # noqa: E731
        yield from self._follow(index, stays, 0.1)
        self._mode(index, "guided")
        yield from self._follow(index, stays, 0.3)
        self._mode(index, "guided")
        yield from self._follow(index, stays, 2.0)

    def fly(self, limit_s: float) -> None:
        """Fly all cases, until every vehicle is told to land."""
        request_realtime_for_this_thread()
        flights = [self._flight(i) for i in range(len(self._cases))]
        began_s = due_s = time.monotonic()
        while any(len(stops) < len(cases) for stops, cases in zip(self.stops, self._cases, strict=True)):
            assert time.monotonic() - began_s < limit_s, "the flight takes too long"
            for flight in flights:
                next(flight)
            due_s = max(due_s + PERIOD_S, time.monotonic())
            time.sleep(max(0.0, due_s - time.monotonic()))
