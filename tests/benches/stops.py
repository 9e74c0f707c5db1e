"""Courses at whose ends vehicles are left to their autopilots, how they are flown, and what peers expect then.

One controller for real autopilots and for the simulated ones: it is told the true state, and gives attitude and thrust.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from swarmctl.control.estimation.flown_by_others import predict_after_setpoints, predict_flown_by_others
from swarmctl.core.autopilot_stop import BRAKE_M_S2
from swarmctl.core.frames import GRAVITY_M_S2, quat_of_tilt
from swarmctl.core.types import FlightMode, Plan, PlanStatus
from tests import builders

Array = NDArray[np.float64]

RAMP_M_S2 = 1.0  # of the speed along the way, on average
STEADY_S = 2.5  # at full speed, before the vehicle is left
POS_1_S2, VEL_1_S = 1.2, 1.8  # gains in the plane
Z_POS_1_S2, Z_VEL_1_S = 3.0, 3.0
MOST_M_S2 = 9.0  # of level acceleration
MOST_Z_M_S2 = 3.0
WATCHED_S = 4.0  # after the vehicle has been left
STEP_S, POINTS = 0.05, 41  # of the plan that it flew
_LEVEL = np.array([1.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Airframe:
    """What the controller knows of a vehicle, and peers of what it does without them."""

    lead_s: float  # from a setpoint until it is flown: dead time and lag
    lag_s: float  # in it
    drag_1_s: float
    hover_01: float


AIRFRAMES = {
    "px4": Airframe(lead_s=0.28, lag_s=0.2, drag_1_s=1.0, hover_01=0.49),
    "arducopter": Airframe(lead_s=0.172, lag_s=0.17, drag_1_s=0.33, hover_01=0.366),
    "simulated_px4": Airframe(lead_s=0.28, lag_s=0.2, drag_1_s=1.0, hover_01=0.4905),
    "simulated_arducopter": Airframe(lead_s=0.172, lag_s=0.17, drag_1_s=0.05, hover_01=0.3645),
}
PARAMETERS: dict[str, dict[str, float]] = {  # as the configurations of real vehicles set them
    "px4": {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 4},
    "arducopter": {
        "GUID_OPTIONS": 8,
        "GUID_TIMEOUT": 1.0,
        "FS_GCS_ENABLE": 5,
        "FS_GCS_TIMEOUT": 2.0,
        "ANGLE_MAX": 4500,
        "ATC_ANGLE_BOOST": 0,
    },
}
KEPT_S = {"px4": {"keeps_s": 0.5, "coasts_s": 0.5}, "arducopter": {"keeps_s": 1.0, "coasts_s": 2.0}}
SILENCE = "silence"  # its agent is gone: no setpoint, and no heartbeat


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """A way that is flown faster and faster, then steadily, from where it begins.

    Attributes:
        speed_m_s: at its end.
        radius_m: of the circle; infinite: a straight line.
        heading_rad: at its beginning.
    """

    speed_m_s: float
    radius_m: float = math.inf
    heading_rad: float = 0.0

    @property
    def ramp_s(self) -> float:
        return max(2.0, self.speed_m_s / RAMP_M_S2)

    @property
    def duration_s(self) -> float:
        return self.ramp_s + STEADY_S

    @property
    def accel_m_s2(self) -> float:
        return self.speed_m_s**2 / self.radius_m

    def at(self, t_s: float) -> tuple[Array, Array, Array]:
        """Return displacement, velocity and acceleration (3,), NED, at a time from its beginning."""
        share = min(1.0, max(0.0, t_s / self.ramp_s))
        speed = self.speed_m_s * share**2 * (3.0 - 2.0 * share)
        along = self.speed_m_s * 6.0 * share * (1.0 - share) / self.ramp_s
        way = self.speed_m_s * (self.ramp_s * (share**3 - 0.5 * share**4) + max(0.0, t_s - self.ramp_s))
        turned = way / self.radius_m
        heading = self.heading_rad + turned
        ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
        aside = np.array([-ahead[1], ahead[0], 0.0])
        if math.isinf(self.radius_m):
            return way * ahead, speed * ahead, along * ahead
        middle = self.radius_m * np.array([-math.sin(self.heading_rad), math.cos(self.heading_rad), 0.0])
        return middle - self.radius_m * aside, speed * ahead, along * ahead + speed**2 / self.radius_m * aside


def transfer(from_ned_m: Array, to_ned_m: Array, t_s: float, duration_s: float) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration (3,) of a smooth way between two points, at rest at both."""
    s = min(1.0, max(0.0, t_s / duration_s))
    way = to_ned_m - from_ned_m
    share, rate = s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 30.0 * s**2 * (1.0 - s) ** 2 / duration_s
    return from_ned_m + share * way, rate * way, 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / duration_s**2 * way


Reference = Callable[[float], tuple[Array, Array, Array]]


def setpoint(
    reference: Reference, t_s: float, pos_ned_m: Array, vel_ned_m_s: Array, airframe: Airframe
) -> tuple[Array, float]:
    """Return attitude (4,) and thrust that follow a reference, from the state at that time."""
    wanted_m, wanted_m_s, _ = reference(t_s)
    _, later_m_s, later_m_s2 = reference(t_s + airframe.lead_s)
    pos, vel = wanted_m - pos_ned_m, wanted_m_s - vel_ned_m_s
    accel = later_m_s2 + airframe.drag_1_s * later_m_s + POS_1_S2 * pos + VEL_1_S * vel
    accel[2] = later_m_s2[2] + Z_POS_1_S2 * pos[2] + Z_VEL_1_S * vel[2]
    accel[2] = max(-MOST_Z_M_S2, min(MOST_Z_M_S2, accel[2]))
    size = math.hypot(accel[0], accel[1])
    accel[:2] *= MOST_M_S2 / max(size, MOST_M_S2)
    down = np.array([-accel[0], -accel[1], GRAVITY_M_S2 - accel[2]])
    force = math.sqrt(float(down @ down))
    return quat_of_tilt(down / force, 0.0), min(1.0, airframe.hover_01 * force / GRAVITY_M_S2)


@dataclass(kw_only=True)
class Track:
    """True states of one vehicle, as they come."""

    t_s: list[float] = field(default_factory=list)
    pos_ned_m: list[Sequence[float]] = field(default_factory=list)
    vel_ned_m_s: list[Sequence[float]] = field(default_factory=list)
    q_nb: list[Sequence[float]] = field(default_factory=list)

    def add(self, t_s: float, pos: Sequence[float], vel: Sequence[float], q_nb: Sequence[float]) -> None:
        self.pos_ned_m.append(pos)
        self.vel_ned_m_s.append(vel)
        self.q_nb.append(q_nb)
        self.t_s.append(t_s)

    def newest(self) -> tuple[Array, Array]:
        return np.array(self.pos_ned_m[-1], dtype=float), np.array(self.vel_ned_m_s[-1], dtype=float)

    def since(self, first: int) -> Track:
        """Return the samples from one on."""
        kept = slice(first, len(self.t_s))  # it may be added to meanwhile
        return Track(
            t_s=self.t_s[kept],
            pos_ned_m=self.pos_ned_m[kept],
            vel_ned_m_s=self.vel_ned_m_s[kept],
            q_nb=self.q_nb[kept],
        )


@dataclass(kw_only=True)
class Stop:
    """What one vehicle did that was left.

    Attributes:
        course: what it flew before.
        how: `SILENCE`, or the mode that it was told.
        left_s: when it got its last setpoint, or the mode.
        beat_s: when it got its last heartbeat.
        track: of it, from a second before until `WATCHED_S` after.
    """

    course: Course
    how: str
    left_s: float
    beat_s: float
    track: Track

    def at(self, after_s: Array) -> Array:
        """Return the true displacements (N, 3) since the vehicle was left."""
        samples = np.array(self.track.pos_ned_m)
        t_s = np.array(self.track.t_s) - self.left_s
        axes = [np.interp(after_s, t_s, samples[:, axis]) - np.interp(0.0, t_s, samples[:, axis]) for axis in range(3)]
        return np.stack(axes, axis=-1)

    def expected(self, kind: str, after_s: Array) -> Array:
        """Return the displacements (N, 3) that peers expect, if the vehicle went on to fly its course.

        Without setpoints that is found from what was planned, in a mode that stops it from its true state then.
        """
        airframe = AIRFRAMES[kind]
        if self.how == SILENCE:
            limits = {**KEPT_S[kind], "drag_1_s": airframe.drag_1_s, "lag_s": airframe.lag_s}
            acts_s = airframe.lead_s - airframe.lag_s
            found = predict_after_setpoints(
                self._plan(), round(acts_s * 1e6), after_s - acts_s, brake_m_s2=BRAKE_M_S2, **limits
            )
            before = after_s < acts_s
            found[before] = np.array([self._ahead(float(t_s))[0] for t_s in after_s[before]]).reshape(-1, 3)
            return found
        first = int(np.searchsorted(self.track.t_s, self.left_s))
        state = builders.vehicle_state(
            pos_ned_m=np.zeros(3),
            vel_ned_m_s=np.array(self.track.vel_ned_m_s[first]) * _LEVEL,
            q_nb=np.array(self.track.q_nb[first]),
            mode=FlightMode.LAND if self.how == "land" else FlightMode.HOLD,
        )
        return predict_flown_by_others(state, after_s, BRAKE_M_S2, stops=True, drag_1_s=airframe.drag_1_s)

    def _ahead(self, after_s: float) -> tuple[Array, Array]:
        """Return displacement and velocity (3,) at a time after it was left, if it had flown on."""
        (end, _, _), (pos, vel, _) = (self.course.at(self.course.duration_s + t_s) for t_s in (0.0, after_s))
        return pos - end, vel

    def _plan(self) -> Plan:
        ahead = [self._ahead(STEP_S * k) for k in range(POINTS)]
        return Plan(
            status=PlanStatus.OK,
            t0_us=0,
            dt_us=round(STEP_S * 1e6),
            pos_ned_m=np.array([pos for pos, _ in ahead]),
            vel_ned_m_s=np.array([vel for _, vel in ahead]),
            virtual_control=np.zeros((POINTS - 1, 3)),
        )

    def heading_rad(self) -> float:
        """Return where it was flying to when it was left."""
        t_s, vel = np.array(self.track.t_s) - self.left_s, np.array(self.track.vel_ned_m_s)
        north, east = (float(np.interp(0.0, t_s, vel[:, axis])) for axis in (0, 1))
        return math.atan2(east, north)

    def off_m(self, kind: str, after_s: Array) -> Array:
        """Return how far (N,) it truly was from where peers expect it."""
        return np.asarray(np.linalg.norm((self.at(after_s) - self.expected(kind, after_s)) * _LEVEL, axis=1))
