"""The data types that all modules share: frozen, with unit and frame in the name and shape in the comment.

NED is the world frame of one *shared* origin, FRD the body frame. Quaternions are (w, x, y, z), body -> NED.
`t_us` is monotonic time of this process, `utc_us` disciplined UTC.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.ordered_sums import dot

Array = NDArray[np.float64]
NO_AGE_US = -1  # of what there is none yet
MAX_MARGIN_M = 10.0  # limit of the margin in a path, so that one peer cannot ground all others
MIN_STEP_US, MAX_STEP_US = 1_000, 500_000  # between points of what a peer says to fly; as `dt_s` of controllers
MAX_SPEED_M_S = 500.0  # along each axis, of what a peer says to fly: what is looked at grows with it
Sampled = Callable[[Array], tuple[Array, Array]]  # offsets (K,) [s] from now -> positions, velocities, (K, 3) each


class FlightMode(enum.IntEnum):
    """The autopilot's flight mode, independent of its dialect."""

    UNKNOWN = 0
    MANUAL = 1
    HOLD = 2
    TAKEOFF = 3
    LAND = 4
    RTL = 5
    MISSION = 6
    EXTERNAL = 7  # PX4 OFFBOARD, ArduCopter GUIDED: it follows setpoints


class Landed(enum.IntEnum):
    """The landed state, with the values of MAV_LANDED_STATE."""

    UNKNOWN = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class Phase(enum.IntEnum):
    """The phase of an agent's mission.

    It moves forward, but for a vehicle that an operator resumes in the air in LAND: that goes back to GOTO_LAND.
    """

    CONNECT = 0  # no vehicle state yet, or its link is not set up
    STANDBY = 1  # vehicle seen, waiting for health and for every peer
    ARM = 2
    TAKEOFF = 3
    GOTO_START = 4
    READY = 5  # on its start position, waiting for every peer
    TRACK = 6
    GOTO_LAND = 7  # brake and separate under MPC before the autopilot takes over
    LAND = 8
    DONE = 9


class Mode(enum.IntEnum):
    """Mode of the agent in a tick, decided by `control.failsafe.decision` from `Health`."""

    IDLE = 0  # nothing is sent: before take-off, after landing
    PRIMING = 1  # setpoints flow but the autopilot still flies
    TRACKING = 2  # the plan of this tick is flown
    REPLAY = 3  # no certified plan: the one before, or a refused one that comes less close, is flown
    BRAKE = 4  # no valid plan: bring the vehicle to rest
    HOLD = 5  # at rest, keep position
    LAND = 6  # the autopilot lands
    PILOT_OVERRIDE = 7  # pilot or autopilot took over: nothing is sent, nothing is commanded
    STATE_STALE = 8  # own state too old: nothing is sent, the autopilot's failsafe acts


FLOWN_BY_AGENT = frozenset((Mode.TRACKING, Mode.REPLAY, Mode.BRAKE, Mode.HOLD))  # modes with setpoints of its own


class ControlMode(enum.IntEnum):
    """What an operator is shown that a vehicle is doing, as `control.phases.control_mode` decides it.

    Where the failsafe decides, its modes have their own names.
    """

    AUTO = 0  # its autopilot flies it at the agent's request, or it stands
    PRIMING = 1
    TRACKING = 2
    REPLAY = 3
    BRAKE = 4
    HOLD = 5  # an operator holds it, or the failsafe does
    GOTO = 6  # at a point of the operator's, or on the way there
    WAIT = 7  # it rests because a peer is silent or deadlines are missed
    RETURN = 8  # on its way to its landing place, after a mission that is complete
    RTL = 9  # the same because an operator, the battery, the link or the loss of a peer has ended the mission
    LANDING = 10
    PILOT = 11  # its pilot or its autopilot has taken over
    FAILSAFE = 12  # its autopilot has, because our setpoints had stopped
    LOST = 13  # no vehicle state that is new enough


class Verb(enum.Enum):
    """The kinds of requests to an autopilot."""

    ARM = "arm"
    DISARM = "disarm"  # the autopilot refuses it in the air
    TAKEOFF = "takeoff"  # value: height above the take-off place [m]
    EXTERNAL = "external"  # PX4 OFFBOARD, ArduCopter GUIDED
    HOLD = "hold"
    LAND = "land"
    RATE = "rate"  # number: message id; value: Hz
    MESSAGE = "message"  # number: message id to be sent once
    PARAM_INT = "param_int"  # name, number
    PARAM_FLOAT = "param_float"  # name, value
    PARAM_GET = "param_get"  # name


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Holds one request to an autopilot."""

    verb: Verb
    value: float = 0.0
    number: int = 0
    name: str = ""


class PlanStatus(enum.IntEnum):
    """The reason why a plan may or may not be flown."""

    OK = 0
    SOLVER_FAILED = 1
    RESIDUAL = 2  # the solver reports success, but its residual in metres is too large
    NOT_CERTIFIED = 3  # it would violate true distances over the horizon
    NONE = 4  # there was no plan


@dataclass(frozen=True, slots=True)
class GeoOrigin:
    """Holds the WGS-84 origin of a local frame; sea level and ellipsoid are taken as one height."""

    lat_deg: float
    lon_deg: float
    alt_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """Holds the newest estimate of the own vehicle, in the shared frame."""

    t_us: int  # monotonic time of validity
    pos_ned_m: Array  # (3,)
    vel_ned_m_s: Array  # (3,)
    q_nb: Array  # (4,)
    rate_frd_rad_s: Array  # (3,)
    armed: bool
    mode: FlightMode
    landed: Landed
    failsafe: bool  # the autopilot reports a failsafe (MAV_STATE_CRITICAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedPath:
    """Holds predicted positions of one agent, as sent over the bus."""

    agent: int
    boot_id: int
    seq: int
    t0_utc_us: int  # time of the first point
    dt_us: int
    margin_m: float  # what peers keep on top of the swarm's required separation
    pos_ned_m: Array  # (N+1, 3)
    setpoint_accel_ned_m_s2: Array | None = None  # (3,) that its last setpoint asks for, drag aside; None: it gets none


@dataclass(frozen=True, slots=True)
class Reference:
    """Holds the desired motion over the horizon."""

    pos_ned_m: Array  # (N+1, 3)
    vel_ned_m_s: Array  # (N+1, 3)
    yaw_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanTimes:
    """Holds measured times of planning, which have no influence."""

    solve_us: float  # inside the QP solver
    certify_us: float
    spaces_us: float = 0.0  # half-spaces


NO_TIMES = PlanTimes(solve_us=0.0, certify_us=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Holds the result of one MPC step: the predicted motion and the virtual controls that produce it."""

    status: PlanStatus
    t0_us: int  # monotonic time of the first point
    dt_us: int
    pos_ned_m: Array  # (N+1, 3)
    vel_ned_m_s: Array  # (N+1, 3)
    virtual_control: Array  # (N, 3): virtual controls u_x, u_y [-] and thrust over mass [m/s2], held over each step
    times: PlanTimes = NO_TIMES  # these five tell of a solver; a plan made without one has the defaults
    iterations: int = 0
    slack_m: float = 0.0  # largest separation slack used
    residual_m: float = 0.0  # largest primal residual, in metres of position
    terminal_gap_m: float = 0.0  # violation of the softened terminal condition
    failure: str = ""  # why the controller that was to make it did not, and another one did
    suspended: bool = False  # that controller is not asked any more
    traceback: str = ""  # of what it has raised, where that is not yet told
    by_own: bool = False  # an own controller has made it


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """Holds the attitude command of a tick."""

    q_nb: Array  # (4,) unit
    thrust_01: float  # [0, 1]
    valid_until_us: int

    def problem(self, now_us: int) -> str:
        """Say why the setpoint must not be sent now, or "".

        A zero or non-finite quaternion corrupts PX4's attitude controller until reboot, a NaN thrust stops its motors.
        """
        q = self.q_nb.tolist()
        if self.q_nb.shape != (4,) or not all(map(math.isfinite, q)):
            return f"quaternion {q} is not finite"
        if abs(dot(q, q) - 1.0) > 2e-3:
            return f"quaternion {q} is not of unit length"
        if not (math.isfinite(self.thrust_01) and 0.0 <= self.thrust_01 <= 1.0):
            return f"thrust {self.thrust_01} is outside 0..1"
        if now_us > self.valid_until_us:
            return f"{(now_us - self.valid_until_us) / 1e3:.0f} ms past its time"
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Holds the inputs of the failsafe; ages are `NO_AGE_US` before the first sample."""

    state_age_us: int
    armed: bool
    mode: FlightMode
    autopilot_failsafe: bool
    plan_status: PlanStatus
    last_good_plan_age_us: int  # of the newest certified plan that is still safe
    last_good_plan_lasts_us: int  # from its begin to its end, after which it has no input
    planless_us: int  # time since a plan was last certified
    speed_m_s: float
    phase: Phase
    had_control: bool  # the autopilot follows setpoints and has not been released
    battery_01: float  # charge that remains; negative: unknown
    link_lost_01: float  # share of the newest seconds in which the state was stale
    dead_reckoning_s: float  # for how long the estimate has been going on without GPS
    pilot_override: bool  # a pilot or the autopilot has taken over, until an operator resumes
