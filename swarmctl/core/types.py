"""The nouns every module speaks in. Frozen; unit and frame in the name; shape in the comment.

NED is the world of one *shared* origin, FRD the body. Quaternions are (w, x, y, z), body -> NED.
`t_us` is monotonic time of this process, `utc_us` disciplined UTC.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MAX_RADIUS_M = 10.0  # of what a path claims round itself: one peer must not ground all others
Sampled = Callable[[Array], tuple[Array, Array]]  # offsets [s] from now (K,) -> positions, velocities (K, 3)


class FlightMode(enum.IntEnum):
    """What the autopilot is doing, independent of its dialect."""

    UNKNOWN = 0
    MANUAL = 1
    HOLD = 2
    TAKEOFF = 3
    LAND = 4
    RTL = 5
    MISSION = 6
    EXTERNAL = 7  # PX4 OFFBOARD, ArduCopter GUIDED: the tick's setpoints fly the vehicle


class Landed(enum.IntEnum):
    """MAV_LANDED_STATE."""

    UNKNOWN = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class Phase(enum.IntEnum):
    """Where an agent is in its mission; moves forward only."""

    CONNECT = 0  # no vehicle state yet, or its link is not set up
    STANDBY = 1  # vehicle seen, waiting for health and for every peer
    ARM = 2
    TAKEOFF = 3
    GOTO_START = 4
    READY = 5  # on its start position, waiting for every peer
    TRACK = 6
    GOTO_LAND = 7  # brake and spread under MPC before the autopilot takes over
    LAND = 8
    DONE = 9


class Mode(enum.IntEnum):
    """Mode of the agent in a tick, decided by `control.phases.failsafe` from `Health`."""

    IDLE = 0  # nothing is sent: before take-off, after landing
    PRIMING = 1  # setpoints flow but the autopilot still flies
    TRACKING = 2  # the plan of this tick is flown
    REPLAY = 3  # solver failed: the shifted last certified plan is flown
    BRAKE = 4  # no valid plan: bring the vehicle to rest
    HOLD = 5  # at rest, keep position
    LAND = 6  # the autopilot lands
    PILOT_OVERRIDE = 7  # pilot or autopilot took over: nothing is sent, nothing is commanded
    STATE_STALE = 8  # own state too old: nothing is sent, the autopilot's failsafe acts


class Verb(enum.Enum):
    """What can be asked of an autopilot."""

    ARM = "arm"
    DISARM = "disarm"  # refused in the air by the autopilot
    TAKEOFF = "takeoff"  # value: height above the take-off place [m]
    EXTERNAL = "external"  # PX4 OFFBOARD, ArduCopter GUIDED
    HOLD = "hold"
    LAND = "land"
    RATE = "rate"  # number: message id; value: Hz
    MESSAGE = "message"  # number: message id to be sent once
    PARAM_INT = "param_int"  # name, number
    PARAM_FLOAT = "param_float"  # name, value
    PARAM_GET = "param_get"  # name


@dataclass(frozen=True, slots=True)
class Command:
    """One request to an autopilot."""

    verb: Verb
    value: float = 0.0
    number: int = 0
    name: str = ""


class PlanStatus(enum.IntEnum):
    """Whether a plan may be flown, and if not, why."""

    OK = 0
    SOLVER_FAILED = 1
    RESIDUAL = 2  # the solver said solved, its residual in metres says otherwise
    NOT_CERTIFIED = 3  # true distances over the horizon would be violated
    NONE = 4  # nothing was planned


@dataclass(frozen=True, slots=True)
class GeoOrigin:
    """WGS-84 origin of a local frame; heights above mean sea level and above the ellipsoid are taken as one."""

    lat_deg: float
    lon_deg: float
    alt_m: float


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Newest estimate of the own vehicle, in the shared frame."""

    t_us: int  # monotonic time the sample is valid for
    pos_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    q_nb: Array  # (4,)
    rate_frd_rad_s: Array  # (3,)
    armed: bool
    mode: FlightMode
    landed: Landed
    failsafe: bool  # the autopilot reports a failsafe (MAV_STATE_CRITICAL)


@dataclass(frozen=True, slots=True)
class PredictedPath:
    """One agent's predicted positions, as they travel over the bus."""

    agent: int
    boot_id: int
    seq: int
    t0_utc_us: int  # the time the first point is valid for
    dt_us: int
    radius_m: float  # extra keep-out of this agent beyond the swarm's constraint radius
    pos_ned_m: Array  # (N+1, 3)


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A sphere or an upright column to keep out of, visible only from closer than `visibility_m`."""

    center_ned_m: Array  # (3,)
    radius_m: float  # physical radius
    keep_out_m: float  # constraint radius, measured from the centre
    visibility_m: float
    vel_ned_m_s: Array  # (3,)
    column: bool = False  # of any height, round its centre

    def distance_m(self, pos_ned_m: Array) -> float:
        """From its centre, of a column from its axis."""
        axes = 2 if self.column else 3
        return math.dist(self.center_ned_m[:axes], pos_ned_m[:axes])


@dataclass(frozen=True, slots=True)
class Reference:
    """Where to be over the horizon."""

    pos_ned_m: Array  # (N+1, 3)
    vel_ned_m_s: Array  # (N+1, 3)
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class PlanTimes:
    """Where the time of planning went; measured, and of no influence."""

    setup_us: float  # matrices
    solve_us: float  # inside the QP solver
    certify_us: float
    spaces_us: float = 0.0  # half-spaces


NO_TIMES = PlanTimes(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Plan:
    """Answer of one MPC step: predicted motion and the virtual controls that produce it."""

    status: PlanStatus
    t0_us: int  # monotonic time of the first point
    dt_us: int
    pos_ned_m: Array  # (N+1, 3)
    vel_ned_m_s: Array  # (N+1, 3)
    virtual_control: Array  # (N, 3): virtual controls u_x, u_y [-] and thrust over mass [m/s2], held over each step
    times: PlanTimes
    iterations: int
    slack_m: float  # largest separation slack used
    residual_m: float  # largest primal residual, in metres of position
    terminal_gap_m: float  # how far the softened terminal condition is from met


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """The one command of a tick."""

    q_nb: Array  # (4,) unit
    thrust_01: float  # [0, 1]
    valid_until_us: int

    def problem(self, now_us: int) -> str:
        """Why this must not leave now, or "".

        A zero or non-finite quaternion corrupts PX4's attitude controller until reboot, a NaN thrust stops its motors.
        """
        q = self.q_nb
        if q.shape != (4,) or not np.isfinite(q).all():
            return f"quaternion {q.tolist()} is not finite"
        if abs(float(q @ q) - 1.0) > 2e-3:
            return f"quaternion {q.tolist()} is not of unit length"
        if not (math.isfinite(self.thrust_01) and 0.0 <= self.thrust_01 <= 1.0):
            return f"thrust {self.thrust_01} is outside 0..1"
        if now_us > self.valid_until_us:
            return f"{(now_us - self.valid_until_us) / 1e3:.0f} ms past its time"
        return ""


@dataclass(frozen=True, slots=True)
class Health:
    """What the failsafe judges; ages are -1 before the first sample."""

    state_age_us: int
    armed: bool
    mode: FlightMode
    landed: Landed
    autopilot_failsafe: bool
    plan_status: PlanStatus
    last_good_plan_age_us: int  # of the newest certified plan that what is known now still allows
    planless_us: int  # since a plan was last certified
    speed_m_s: float
    phase: Phase
    had_control: bool  # the autopilot has followed our setpoints and we have not given it back
    pilot_override: bool  # pilot or autopilot took over; lasts until an operator resumes


@dataclass(frozen=True, slots=True)
class TickRecord:
    """Everything worth keeping of one tick; `core.records` lays it out as bytes."""

    t_us: int
    utc_us: int
    seq: int
    mission_t_s: float  # NaN outside TRACK
    phase: Phase
    mode: Mode
    flight_mode: FlightMode
    armed: bool
    state_age_ms: float
    pos_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    q_nb: Array  # (4,)
    ref_pos_ned_m: Array  # (3,)
    setpoint_q_nb: Array  # (4,), NaN when none was sent
    setpoint_thrust_01: float  # NaN when none was sent
    hover_thrust_01: float
    disturbance_ned_m_s2: Array  # (3,)
    nearest_peer_m: float  # to the newest prediction of any peer, now; inf without peers
    nearest_obstacle_m: float  # centre distance of the nearest visible obstacle; inf without
    plan_staleness_ms: float  # oldest of the newest paths; NaN without peers
    peers: int  # paths in use
    rejected: int  # bus messages refused so far
    plan_status: PlanStatus
    slack_m: float
    residual_m: float
    iterations: int
    solve_ms: float
    tick_ms: float  # listen to send
    deadline_misses: int  # so far, skipped ones included
    plan_pos_ned_m: Array  # (N+1, 3), empty when there is no plan
    barrier_acted: bool = False  # the last layer has changed what was flown
