"""Reports of one vehicle about its flight: state, mode, targets. Every builder returns fields in wire order.

`sitl.px4.link.streams_health` reports sensors, power and estimator; its `STREAMS` lists all messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.plant.sensors import Estimate, LocalOrigin
from sitl.px4.autopilot import Autopilot
from sitl.px4.modes import STANDARD_MODES, Px4Mode
from sitl.vehicle_parts import IDLE

FRAME_LOCAL_NED = 1
PROTOCOL_VERSION = 300
Fields = tuple[Any, ...]
NAN = math.nan
_NO_COVARIANCES = (NAN,) * 42
_NO_TARGET = (NAN,) * 11
_TARGET_BITS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 1024, 2048)
_NO_OFFSET = (0.0,) * 4
_LEVEL = (1.0, 0.0, 0.0, 0.0)
_NO_SERVOS = (0,) * 8
_ATTITUDE_GAINS = ("MC_ROLL_P", "MC_PITCH_P", "MC_YAW_P")
_PWM_OFF, _PWM_IDLE, _PWM_SPAN = 900, 1000, 1000
_INT32 = 2**31 - 1


@dataclass(slots=True, kw_only=True)
class LinkCounts:
    """Traffic counters of one link."""

    sent: int = 0
    sent_bytes: int = 0
    received: int = 0
    received_bytes: int = 0
    not_decoded: int = 0
    pings: int = 0


@dataclass(slots=True, kw_only=True)
class Report:
    """Everything a message can be built from, at one instant."""

    estimate: Estimate
    autopilot: Autopilot
    origin: LocalOrigin
    rotor_01: Callable[[], Sequence[float]]  # (4,) forces; called only for messages with them
    force_frd_m_s2: Callable[[], Sequence[float]]  # (3,) specific force, body axes
    simulation_us: int = -1  # the instant, on the simulation's clock
    counts: LinkCounts | None = None


def heartbeat(r: Report) -> Fields:
    pilot = r.autopilot
    return pilot.mode, 2, 12, pilot.base_mode(), pilot.system_status(r.estimate.t_us), 3


def current_mode(r: Report) -> Fields:
    pilot = r.autopilot
    return pilot.mode, pilot.intended, STANDARD_MODES.get(pilot.mode, 0)


def system_time(r: Report) -> Fields:
    return r.autopilot.boot_utc_us + r.estimate.t_us, ms(r)


def attitude(r: Report) -> Fields:
    e = r.estimate
    return ms(r), *e.euler_rad, *e.rate_frd_rad_s


def attitude_quaternion(r: Report) -> Fields:
    e = r.estimate
    return ms(r), *e.q_nb, *e.rate_frd_rad_s, *_NO_OFFSET


def local_position(r: Report) -> Fields:
    e = r.estimate
    return ms(r), *e.pos_ned_m, *e.vel_ned_m_s


def odometry(r: Report) -> Fields:
    e = r.estimate
    velocity_frame = FRAME_LOCAL_NED  # NED too, as PX4 sends it
    return (
        e.t_us,
        *e.pos_ned_m,
        *e.q_nb,
        *e.vel_ned_m_s,
        *e.rate_frd_rad_s,
        *_NO_COVARIANCES,
        FRAME_LOCAL_NED,
        velocity_frame,
        0,
        0,
        100,
    )


def global_position(r: Report) -> Fields:
    e, origin = r.estimate, r.origin
    x_m, y_m, z_m = e.pos_ned_m
    lat_e7, lon_e7 = origin.to_geo_e7(x_m, y_m)
    vx, vy, vz = e.vel_ned_m_s
    return (
        ms(r),
        int32(lat_e7),
        int32(lon_e7),
        int32(origin.alt_mm - z_m * 1e3),
        int32((home_z_m(r) - z_m) * 1e3),
        _int16(vx * 100),
        _int16(vy * 100),
        _int16(vz * 100),
        round(math.degrees(e.euler_rad[2]) % 360.0 * 100) % 36000,
    )


def gps_global_origin(r: Report) -> Fields:
    return r.origin.lat_e7, r.origin.lon_e7, r.origin.alt_mm, r.estimate.t_us


def home_position(r: Report) -> Fields:
    x_m, y_m, z_m = r.autopilot.home_ned_m or (0.0, 0.0, 0.0)
    lat_e7, lon_e7 = r.origin.to_geo_e7(x_m, y_m)
    alt_mm = int32(r.origin.alt_mm - z_m * 1e3)
    return int32(lat_e7), int32(lon_e7), alt_mm, x_m, y_m, z_m, *_LEVEL, NAN, NAN, NAN, r.estimate.t_us


def altitude(r: Report) -> Fields:
    up_m = -r.estimate.pos_ned_m[2]
    amsl_m = r.origin.alt_mm / 1e3 + up_m
    return r.estimate.t_us, amsl_m, amsl_m, up_m, up_m + home_z_m(r), NAN, NAN


def vfr_hud(r: Report) -> Fields:
    e = r.estimate
    north, east, down = e.vel_ned_m_s
    throttle = round(100 * r.autopilot.output.thrust_01)
    heading_deg = int(math.degrees(e.euler_rad[2]) % 360.0)
    return NAN, math.hypot(north, east), r.origin.alt_mm / 1e3 - e.pos_ned_m[2], -down, heading_deg, throttle


def attitude_target(r: Report) -> Fields:
    """Build ATTITUDE_TARGET: the target that is followed; a stream's setpoint as sent. type_mask is always 0."""
    pilot, output = r.autopilot, r.autopilot.output
    rates: tuple[float, ...] = (0.0, 0.0, 0.0)
    if pilot.stream.poisoned:
        rates = NAN, NAN, NAN
    q_nb, thrust = output.q_nb.tolist(), output.thrust_01
    if pilot.mode == Px4Mode.OFFBOARD and pilot.stream.command is not IDLE:
        output = pilot.stream.command
        q_nb, thrust, echoed = pilot.stream.echo
        rates = rates if pilot.stream.poisoned and output.rate_frd_rad_s is None else echoed
    if output.rate_frd_rad_s is None and not output.loose:
        gains = [pilot.parameters.real(name) for name in _ATTITUDE_GAINS]
        rates = tuple(g * e for g, e in zip(gains, _turn_rad(r.estimate.q_nb, output.q_nb.tolist()), strict=True))
    return ms(r), *q_nb, *rates, thrust, 0


def _turn_rad(q_nb: Sequence[float], wanted: Sequence[float]) -> tuple[float, float, float]:
    """Return the small rotation from one attitude to another, body axes."""
    w, x, y, z = q_nb
    a, b, c, d = wanted
    two = 2.0 if w * a + x * b + y * c + z * d >= 0 else -2.0
    return (
        two * (w * b - x * a - y * d + z * c),
        two * (w * c - y * a - z * b + x * d),
        two * (w * d - z * a - x * c + y * b),
    )


def position_target(r: Report) -> Fields:
    """Build the setpoints of AUTO flight; NaN, and ignored in the mask, where there are none."""
    pilot = r.autopilot
    auto = pilot.armed and pilot.mode != Px4Mode.OFFBOARD and pilot.output is not IDLE
    target = pilot.flight.target() if auto else _NO_TARGET
    mask = sum(bit for bit, value in zip(_TARGET_BITS, target, strict=True) if math.isnan(value))
    return ms(r), *target, mask, FRAME_LOCAL_NED


def servo_output(r: Report) -> Fields:
    running = r.autopilot.motors_on
    pwm = [_PWM_IDLE + round(_PWM_SPAN * f) if running else _PWM_OFF for f in r.rotor_01()]
    return r.estimate.t_us & 0xFFFFFFFF, *pwm, 0, 0, 0, 0, 0, *_NO_SERVOS


def extended_sys_state(r: Report) -> Fields:
    return 0, r.autopilot.landed


def mission_current(r: Report) -> Fields:
    pilot = r.autopilot
    flying = pilot.armed and pilot.mode == Px4Mode.AUTO_MISSION
    return pilot.store.progress(flying=flying, finished=pilot.flight.mission_finished)


def time_estimates(r: Report) -> Fields:
    """Build the seconds until landing if it returned now; -1: none."""
    home = r.autopilot.home_ned_m
    if not r.autopilot.armed or home is None:
        return -1, -1, -1, -1, -1
    x_m, y_m, z_m = r.estimate.pos_ned_m
    cruise_m_s = max(0.1, r.autopilot.parameters.real("MPC_XY_CRUISE"))
    sink_m_s = max(0.1, r.autopilot.parameters.real("MPC_LAND_SPEED"))
    fall_s = max(0.0, home[2] - z_m) / sink_m_s
    away_s = math.hypot(x_m - home[0], y_m - home[1]) / cruise_m_s
    return int32(away_s + fall_s), int32(fall_s), -1, -1, -1


def autopilot_version(r: Report) -> Fields:
    version, none = 0x01120080, (0,) * 8  # 1.18.0 beta
    uid = r.autopilot.parameters.integer("MAV_SYS_ID") - 1  # in simulation it is the instance's number
    return 59647, uid, version, version, 0, 1, 0, 0, *_HASH, *_HASH, *none, *(0,) * 18


def protocol_version(_: Report) -> Fields:
    return 200, 100, 203, *(0,) * 8, *_LIBRARY_HASH


_LIBRARY_HASH = tuple(bytes.fromhex("447729498e1fcbf9"))
_HASH = tuple(reversed(bytes.fromhex("83c4f4e580000000")))  # of the release that was measured


def ms(r: Report) -> int:
    """Return the time since boot [ms], as 32 bits."""
    return r.estimate.t_us // 1000 & 0xFFFFFFFF


def home_z_m(r: Report) -> float:
    """Return the local z of home; 0 before there is one."""
    return r.autopilot.home_ned_m[2] if r.autopilot.home_ned_m else 0.0


def int32(value: float) -> int:
    return max(-_INT32, min(_INT32, round(value)))


def _int16(value: float) -> int:
    return max(-32767, min(32767, round(value)))


@dataclass(frozen=True, slots=True)
class Stream:
    """One message that this vehicle can send."""

    build: Callable[[Report], Fields]
    needs_position: bool = False  # only with a ready estimator and a position


FLIGHT_STREAMS: dict[int, Stream] = {
    mav.MAVLINK_MSG_ID_HEARTBEAT: Stream(heartbeat),
    mav.MAVLINK_MSG_ID_CURRENT_MODE: Stream(current_mode),
    mav.MAVLINK_MSG_ID_SYSTEM_TIME: Stream(system_time),
    mav.MAVLINK_MSG_ID_ATTITUDE: Stream(attitude),
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: Stream(attitude_quaternion),
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: Stream(local_position, True),
    mav.MAVLINK_MSG_ID_ODOMETRY: Stream(odometry, True),
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Stream(global_position, True),
    mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: Stream(gps_global_origin, True),
    mav.MAVLINK_MSG_ID_HOME_POSITION: Stream(home_position, True),
    mav.MAVLINK_MSG_ID_ALTITUDE: Stream(altitude, True),
    mav.MAVLINK_MSG_ID_VFR_HUD: Stream(vfr_hud, True),
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: Stream(attitude_target),
    mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: Stream(position_target),
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: Stream(servo_output),
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Stream(extended_sys_state),
    mav.MAVLINK_MSG_ID_MISSION_CURRENT: Stream(mission_current),
    380: Stream(time_estimates),
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: Stream(autopilot_version),
    PROTOCOL_VERSION: Stream(protocol_version),
}
