"""The safety filter: a control barrier function on the acceleration that is about to be commanded.

It knows nothing of horizons, rows or certificates, and shares no code with them. From the predicted states of all
vehicles when the command acts, it changes the command as little as possible such that bodies can still be kept apart
by braking. For a pair with distance r, rate r' and D the distance of touching bodies plus a margin, the approach may
be no faster than

    v(d) = k d                          for d = r + react r' - D below a / k^2,
           sqrt(2 a (d - a / 2 k^2))    beyond,

which leaves room to stop at D with the braking `a` of both; h = r' + v(d) >= 0 is made a barrier by h' >= -gain h.
That is a half-plane of accelerations for each pair, of which each vehicle takes half (U. Borrmann, L. Wang, A. Ames,
M. Egerstedt 2015; L. Wang, A. Ames, M. Egerstedt 2017). Against what does not filter itself (an obstacle, a stale peer,
or one that its autopilot flies) the own vehicle takes all of it. The command is the acceleration nearest to the wanted
one within all half-planes and the airframe's bounds; if there is none, the one of least slack.

Two that fly past each other part, but only as long as both fly straight on. That counts fully from d = a / k^2 on, and
not at all where they are too close already: there the command itself has to part them, by `escape_m_s` at most.

Guarantee: bodies that are apart stay apart, as long as both of a pair brake with `brake_m_s2`, `margin_m` covers the
errors of positions, velocities and the prediction over dead time and lag, and h >= 0 to begin with. Several neighbours
at once may ask for more than the airframe has; then the largest slack is minimal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from pydantic import Field

from swarmctl.control.collision.projection import Row, Vector, project_or_violate_least
from swarmctl.control.lag import Lag
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import Params
from swarmctl.core.types import Array, PredictedPath

_TINY = 1e-6
_SLACK_WEIGHT = 100.0  # a larger one would trade all of the thrust for a trace of distance
_LAG_STEP_S = 1e-3
_THRUST_CHANGE_M_S2 = 2.5  # largest change of vertical thrust: without thrust there is no braking either
_THRUSTS, _SAME_THRUST_M_S2 = 4, 0.05  # how often, and until when, bounds are computed for the thrust that results
_FARTHEST_M_S2 = 40.0  # rows that ask for less than minus this are met by any acceleration


class BarrierParams(Params):
    """When the safety filter acts, and how hard."""

    enabled: bool = True  # false: setpoints of the controller are sent unfiltered
    margin_m: float = Field(0.05, ge=0, le=10)  # distance kept beyond touching bodies
    brake_m_s2: float = Field(4.0, gt=0, le=20)  # level braking of one vehicle; the rest of its thrust is reserve
    near_1_s: float = Field(6.0, gt=0, le=50)  # k: approach speed allowed per metre left, close by
    gain_1_s: float = Field(6.0, gt=0, le=50)  # how fast the allowed approach speed may be reached
    react_s: float = Field(0.045, ge=0, le=1)  # time the approach continues while the airframe tilts to brake
    escape_m_s: float = Field(0.5, ge=0, le=10)  # separating speed asked for when closer than allowed
    slew_1_s: float = Field(2.5, gt=0, le=50)  # of (u_x, u_y); faster attitude changes would saturate rotors


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """Describes one thing not to touch, at the time the command acts."""

    pos_ned_m: Vector  # (3,)
    vel_ned_m_s: Vector  # (3,)
    apart_m: float  # distance of centres to keep
    responsibility_01: float  # share of the avoidance that is the own vehicle's
    column: bool = False  # unbounded in height
    solid: bool = False  # has no downwash


def body_of_peer(
    path: PredictedPath,
    act_utc_us: int,
    ahead_s: float,
    apart_m: float,
    *,
    filters: bool,
    brake_m_s2: float,
) -> Body:
    """Return the body of a peer, predicted on its newest path.

    Args:
        path: positions; beyond its end the peer is assumed to brake.
        act_utc_us: UTC at which the own command arrives at the vehicle.
        ahead_s: time after that at which the command takes effect.
        apart_m: distance of centres to keep, with all margins.
        filters: whether the peer takes its half.
        brake_m_s2: assumed braking, the same as in plans: no plan avoids what only the filter sees.
    """
    points, dt_s = path.pos_ned_m, path.dt_us * 1e-6
    at = ((act_utc_us - path.t0_utc_us) * 1e-6 + ahead_s) / dt_s
    last = len(points) - 1
    low = max(0, min(int(at), last - 1))
    (ax, ay, az), (bx, by, bz) = points[low : low + 2].tolist()
    rise = (bx - ax, by - ay, bz - az)
    vel: Vector = (rise[0] / dt_s, rise[1] / dt_s, rise[2] / dt_s)
    if at >= last:
        pos, vel = _braked((bx, by, bz), vel, (at - last) * dt_s, brake_m_s2)
    else:
        part = at - low
        pos = (ax + part * rise[0], ay + part * rise[1], az + part * rise[2])
    return Body(pos_ned_m=pos, vel_ned_m_s=vel, apart_m=apart_m, responsibility_01=0.5 if filters else 1.0)


def _braked(pos: Vector, vel: Vector, t_s: float, brake_m_s2: float) -> tuple[Vector, Vector]:
    stop_s = math.sqrt(_dot(vel, vel)) / brake_m_s2
    done_01 = t_s / stop_s if t_s < stop_s else 1.0
    moved_s = stop_s * done_01 * (1.0 - 0.5 * done_01)  # seconds at the first speed
    return tuple(p + moved_s * v for p, v in zip(pos, vel, strict=True)), tuple((1.0 - done_01) * v for v in vel)


def body_of_obstacle(obstacle: Obstacle, ahead_s: float, apart_m: float) -> Body:
    """Return an obstacle `ahead_s` from now, at constant velocity; `apart_m` is from its surface to the own centre."""
    vel = obstacle.vel_ned_m_s
    pos = tuple(p + ahead_s * v for p, v in zip(obstacle.center_ned_m, vel, strict=True))
    return Body(
        pos_ned_m=pos,
        vel_ned_m_s=vel,
        apart_m=obstacle.radius_m + apart_m,
        responsibility_01=1.0,
        column=obstacle.column,
        solid=True,
    )


class Barrier:
    """Filters the commands of one vehicle.

    Args:
        params: limits of the approach.
        vehicle: bounds, lag and drag.
        dt_s: time between two commands.
        downwash: divisor of vertical distances to peers.
    """

    def __init__(self, params: BarrierParams, vehicle: VehicleModelParams, dt_s: float, downwash: float = 1.0) -> None:
        self._params, self._vehicle, self._down_01 = params, vehicle, 1.0 / downwash
        self._slew = params.slew_1_s * dt_s
        lag = vehicle.lag()
        self.ahead_s = 0.0 if lag is None else lag.ramp_delay_s  # from acting to taking effect
        self._responses = _responses(lag, vehicle.drag_1_s, self.ahead_s)

    def filtered(
        self,
        virtual_control: Array,
        start: Start,
        disturbance_ned_m_s2: Array,
        hover_thrust_01: float,
        *,
        bodies: Sequence[Body],
    ) -> Array | None:
        """Return the virtual controls (3,) to fly in place of `virtual_control`; None when those are safe.

        Args:
            virtual_control: (3,) wanted u_x, u_y and thrust over mass [m/s2].
            start: own state when they act.
            disturbance_ned_m_s2: (3,) estimate.
            hover_thrust_01: scales the bounds of thrust.
            bodies: predicted bodies when the command takes effect.
        """
        ux, uy, thrust = virtual_control.tolist()
        if not bodies or not (math.isfinite(ux) and math.isfinite(uy) and math.isfinite(thrust)):
            return None
        pos, vel = self._predicted_state(start, disturbance_ned_m_s2)
        cos_tilt = math.sqrt(max(0.0, 1.0 - ux * ux - uy * uy))
        wanted = (thrust * ux, thrust * uy, thrust * cos_tilt)  # thrust vector over mass, up positive
        dx, dy, dz = disturbance_ned_m_s2.tolist()
        drag = self._vehicle.drag_1_s
        # acceleration without thrust
        rest = (dx - drag * vel[0], dy - drag * vel[1], GRAVITY_M_S2 + dz - drag * vel[2])
        rows = [row for body in bodies if (row := self._row(body, pos, vel, rest)) is not None]
        if not rows or all(_dot(normal, wanted) >= offset for normal, offset in rows):
            return None
        rows.sort(key=lambda row: _dot(row[0], wanted) - row[1])  # most violated rows first: fewer become active after
        slew_bounds = [
            self._slew_bounds(u, held) for u, held in zip((ux, uy), start.virtual_control.tolist(), strict=False)
        ]
        thrust_vector, size = self._nearest(wanted, rows, slew_bounds, thrust, hover_thrust_01)
        if size < _TINY:
            return None
        flown = [min(most, max(least, f / size)) for f, (least, most) in zip(thrust_vector, slew_bounds, strict=False)]
        return np.array([*flown, size])

    def eased(self, virtual_control: Array, start: Start) -> Array:
        """Return the controls (3,) on the way from those held now to these; the same array where they are near enough.

        What this filter commands may be far beyond what a controller may ask for. Taken back in one command, it
        saturates rotors as much as an attitude that comes at once.
        """
        ux, uy, thrust = virtual_control.tolist()
        if not (math.isfinite(ux) and math.isfinite(uy)):
            return virtual_control  # for others to refuse
        spans = ((held - self._slew, held + self._slew) for held in start.virtual_control.tolist()[:2])
        near = [min(most, max(least, u)) for u, (least, most) in zip((ux, uy), spans, strict=True)]
        return virtual_control if near == [ux, uy] else np.array([*near, thrust])

    def _nearest(
        self,
        wanted: Vector,
        rows: Sequence[Row],
        slew_bounds: Sequence[tuple[float, float]],
        thrust_m_s2: float,
        hover_thrust_01: float,
    ) -> tuple[Vector, float]:
        """Return the thrust vector nearest to the wanted one within all rows and bounds, and its size.

        What u_x and u_y may be bounds forces by the thrust that results: with less of it than was wanted, the same
        force is more tilt. Bounded by the wanted one, a vehicle that has to brake leaned on towards what it brakes for.
        """
        for _ in range(_THRUSTS):
            bounds = self._bounds(wanted, thrust_m_s2, slew_bounds, hover_thrust_01)
            vector = project_or_violate_least(wanted, rows, bounds, _SLACK_WEIGHT)
            before, thrust_m_s2 = thrust_m_s2, math.sqrt(_dot(vector, vector))
            if thrust_m_s2 < _TINY or abs(thrust_m_s2 - before) < _SAME_THRUST_M_S2:
                break
        return vector, thrust_m_s2

    def _predicted_state(self, start: Start, disturbance_ned_m_s2: Array) -> tuple[Vector, Vector]:
        """Predict the own position and velocity (3,) to when a command of now takes effect, under the one now held."""
        pos, vel = start.pos_ned_m.tolist(), start.vel_ned_m_s.tolist()
        if not self.ahead_s:
            return tuple(pos), tuple(vel)
        r, held, d = self._responses, start.virtual_control.tolist(), disturbance_ned_m_s2.tolist()
        pushed = [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]
        for i in (0, 1):
            tilt, rate = float(start.tilt[i]), float(start.tilt_rate_1_s[i])
            for k in (0, 1):
                acts = tilt * r.of_tilt[k] + rate * r.of_rate[k] + held[i] * r.of_command[k]
                pushed[i][k] = d[i] * r.of_accel[k] - held[2] * acts
        down_m_s2 = GRAVITY_M_S2 + d[2] - held[2] * start.cos_tilt
        pushed[2] = [down_m_s2 * r.of_accel[0], down_m_s2 * r.of_accel[1]]
        return (
            tuple(p + r.of_velocity[0] * v + x[0] for p, v, x in zip(pos, vel, pushed, strict=True)),
            tuple(r.of_velocity[1] * v + x[1] for v, x in zip(vel, pushed, strict=True)),
        )

    def _row(self, body: Body, pos: Vector, vel: Vector, rest: Vector) -> Row | None:
        """Return the row `normal . thrust vector >= offset` of one body; None when it is too far to matter."""
        p, (bx, by, bz), (bu, bv, bw) = self._params, body.pos_ned_m, body.vel_ned_m_s
        down_01 = 0.0 if body.column else 1.0 if body.solid else self._down_01
        x, y, z = pos[0] - bx, pos[1] - by, down_01 * (pos[2] - bz)
        u, v, w = vel[0] - bu, vel[1] - bv, down_01 * (vel[2] - bw)
        speed2 = u * u + v * v + w * w
        distance = math.sqrt(x * x + y * y + z * z)
        if distance > _TINY:
            nx, ny, nz = x / distance, y / distance, z / distance
        else:  # centres coincide: back along the relative velocity
            size = math.sqrt(speed2) + _TINY
            nx, ny, nz = -u / size, -v / size, -w / size
        rate = nx * u + ny * v + nz * w
        react_s = p.react_s if rate < 0.0 else 0.0
        left, brake = distance + react_s * rate - body.apart_m, p.brake_m_s2 / body.responsibility_01
        bend = brake / p.near_1_s**2
        if left > bend:
            allowed = math.sqrt(2.0 * brake * (left - 0.5 * bend))
            slope = brake / allowed
        else:
            allowed, slope = p.near_1_s * left, p.near_1_s
            if allowed < -p.escape_m_s:
                allowed, slope = -p.escape_m_s, 0.0
        straight_01 = min(1.0, max(0.0, left / bend))
        # r'' due to the transverse velocity
        transverse = straight_01 * (speed2 - rate * rate) / max(distance, 0.5 * body.apart_m)
        # least r'' that keeps h' >= -gain h
        need = -(slope * rate + p.gain_1_s * (rate + allowed)) / (1.0 + slope * react_s) - transverse
        if need < -_FARTHEST_M_S2:
            return None
        nz *= down_01
        return (-nx, -ny, -nz), body.responsibility_01 * need - (nx * rest[0] + ny * rest[1] + nz * rest[2])

    def _slew_bounds(self, wanted: float, held: float) -> tuple[float, float]:
        """Return the least and largest u of an axis from the held one on; the wanted u is always within them."""
        most = self._vehicle.u_max()
        return min(wanted, max(-most, held - self._slew)), max(wanted, min(most, held + self._slew))

    def _bounds(
        self,
        wanted: Vector,
        thrust_m_s2: float,
        slew_bounds: Sequence[tuple[float, float]],
        hover_thrust_01: float,
    ) -> list[Row]:
        """Return rows of the bounds of the airframe: u_x, u_y and vertical thrust."""
        model, full = self._vehicle, GRAVITY_M_S2 / hover_thrust_01
        least = max(wanted[2] - _THRUST_CHANGE_M_S2, min(wanted[2], model.thrust_min_01 * full))
        most = min(wanted[2] + _THRUST_CHANGE_M_S2, max(wanted[2], model.thrust_max_01 * full))
        spans = [*((thrust_m_s2 * low, thrust_m_s2 * high) for low, high in slew_bounds), (least, most)]
        rows: list[Row] = []
        for i, (low, high) in enumerate(spans):
            axis = tuple(1.0 if k == i else 0.0 for k in range(3))
            rows.append((axis, low))
            rows.append((tuple(-c for c in axis), -high))
        return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class _Responses:
    """Holds displacement and velocity after a fixed time, due to unit initial values and a unit acceleration."""

    of_velocity: tuple[float, float]
    of_accel: tuple[float, float]
    of_tilt: tuple[float, float]  # initial tilt alone, thrust over mass 1
    of_rate: tuple[float, float]
    of_command: tuple[float, float]


def _responses(lag: Lag | None, drag_1_s: float, for_s: float) -> _Responses:
    after = partial(_moved, lag, drag_1_s, for_s)
    return _Responses(
        of_velocity=after(vel=1.0),
        of_accel=after(accel=1.0),
        of_tilt=after(tilt=1.0),
        of_rate=after(rate=1.0),
        of_command=after(command=1.0),
    )


def _moved(
    lag: Lag | None,
    drag_1_s: float,
    for_s: float,
    *,
    tilt: float = 0.0,
    rate: float = 0.0,
    command: float = 0.0,
    vel: float = 0.0,
    accel: float = 0.0,
) -> tuple[float, float]:
    """Return displacement and velocity along one axis after a time, from these initial values and held inputs."""
    pos = 0.0
    if lag is None:
        return pos, vel
    steps = max(1, round(for_s / _LAG_STEP_S))
    dt_s = for_s / steps
    for _ in range(steps):
        tilt, rate, integral = lag.advance(tilt, rate, command, dt_s)
        gained = vel + integral + dt_s * (accel - drag_1_s * vel)
        pos += 0.5 * dt_s * (vel + gained)
        vel = gained
    return pos, vel


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
