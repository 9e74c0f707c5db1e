"""Leaves simulated vehicles to their autopilots at the ends of courses, as `tests/real` does real ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from tests.benches import arducopter_bench, px4_bench
from tests.benches.stops import AIRFRAMES, PARAMETERS, SILENCE, WATCHED_S, Array, Course, Stop, Track, setpoint

PERIOD_S = 0.02
HEIGHT_M = 14.0
BEAT_S = 1.0
MODES: dict[str, dict[str, tuple[int, ...]]] = {
    "px4": {"hold": (4, 3), "land": (4, 6)},
    "arducopter": {"brake": (17,), "loiter": (5,), "land": (9,)},
}


def stopped(kind: str, course: Course, how: str, **sitl: Any) -> Stop:
    """Fly a course with a simulated vehicle of a kind, leave it there, and return what it does."""
    bench: Any
    if kind == "px4":
        bench = px4_bench.Bench("x500", **sitl)
        for name, value in PARAMETERS[kind].items():
            bench.pilot.parameters.assign(name, value)
        bench.in_offboard(height_m=HEIGHT_M)
    else:
        bench = arducopter_bench.Bench(parameters=PARAMETERS[kind], **sitl).airborne(HEIGHT_M)
    return _Flight(kind, bench).fly(course, how)


class _Flight:
    def __init__(self, kind: str, bench: Any) -> None:
        self._kind, self._bench, self._t_s, self._beat_s = kind, bench, 0.0, 0.0
        self._track = Track()

    def _state(self) -> tuple[Array, Array, Array]:
        plant = self._bench.world.plant
        return plant.pos_ned_m[:, 0].copy(), plant.vel_ned_m_s[:, 0].copy(), plant.q_nb[:, 0].copy()

    def _step(self) -> None:
        self._bench.run(PERIOD_S)
        self._t_s += PERIOD_S
        pos, vel, q_nb = (part.tolist() for part in self._state())
        self._track.add(self._t_s, pos, vel, q_nb)

    def _beat(self) -> None:
        if self._kind == "arducopter" and self._t_s >= self._beat_s + BEAT_S:
            self._beat_s = self._t_s
            self._bench.ask(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))

    def fly(self, course: Course, how: str) -> Stop:
        start, _, _ = self._state()
        began_s = self._t_s
        while (t_s := self._t_s - began_s - 2.0) < course.duration_s:
            pos, vel, _ = self._state()

            def reference(t_s: float) -> tuple[Array, Array, Array]:
                way, wanted, accel = course.at(t_s)
                return start + way, wanted, accel

            q_nb, thrust_01 = setpoint(reference, t_s, pos, vel, AIRFRAMES[f"simulated_{self._kind}"])
            self._bench.setpoint(q=[float(c) for c in q_nb], thrust=thrust_01)
            self._beat()
            self._step()
        left_s = self._t_s - PERIOD_S
        if how != SILENCE:
            self._bench.mode(*MODES[self._kind][how])
        while self._t_s < left_s + WATCHED_S + 0.1:
            if how != SILENCE:
                self._beat()
            self._step()
        first = int(np.searchsorted(self._track.t_s, left_s - 1.0))
        return Stop(course=course, how=how, left_s=left_s, beat_s=self._beat_s, track=self._track.since(first))
