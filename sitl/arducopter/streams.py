"""Reports of an ArduCopter: a builder per message, the groups of REQUEST_DATA_STREAM, and the send times.

Every builder takes the same `CopterReport` and returns fields in wire order. Only HEARTBEAT and TIMESYNC are sent
without a request (SR0_* = 0).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.arducopter.autopilot import ArduCopter
from sitl.plant.sensors import FULL, Estimate, LocalOrigin, Power

Fields = tuple[Any, ...]
EKF_STATUS_REPORT = 193
_PRESENT = 0x0361FC2F  # gyro, accel, mag, baro, GPS, all controllers, motors, RC, AHRS, logging, battery; no fence
_NOT_WHILE_DISARMED = 0x8000  # motor outputs are not enabled then
_AHRS, _GPS = 0x200000, 0x20
_PREARM_CHECK = 0x10000000
_CHARGED = Power(1.0, 12.6, 0.0)  # of three cells, while the simulator models no battery
_EKF_HEALTHY, _EKF_NO_POSITION = 0x033F, 0x00A5
_GATE_M = 1.5  # innovation at which the EKF's test ratio of GPS position is 1
_NO_FIX, _FIX_RTK = 1, 6
_PWM_OFF, _PWM_SPAN, _SPIN_ARMED = 1000, 1000, 0.1
_CAPABILITIES = 64495
_VERSION = 0x040603FF
_LEVEL, _NO_OFFSET, _NO_SERVOS = (1.0, 0.0, 0.0, 0.0), (0.0,) * 4, (0,) * 8
_GIT_HASH = (*b"92b0cd78",)


@dataclass(frozen=True, slots=True, kw_only=True)
class CopterReport:
    """Everything a message can be built from, at one instant."""

    estimate: Estimate
    pilot: ArduCopter
    origin: LocalOrigin
    rotor_01: Callable[[], Sequence[float]]  # (4,) forces; called only for messages with them


def heartbeat(r: CopterReport) -> Fields:
    pilot = r.pilot
    return pilot.mode, 2, 3, pilot.base_mode(), pilot.system_status(), 3


def sys_status(r: CopterReport) -> Fields:
    present = _PRESENT | _PREARM_CHECK
    enabled = present if r.pilot.armed else present & ~_NOT_WHILE_DISARMED
    passed = r.pilot.prearm_passed(r.estimate.t_us)
    health = _PRESENT & ~(0 if r.pilot.has_origin else _AHRS) & ~(0 if r.estimate.gps_ok else _GPS)
    health |= _PREARM_CHECK if passed else 0
    charge, volts, amperes = _power(r)
    sensors = present, enabled, health
    return *sensors, 100, round(1e3 * volts), round(1e2 * amperes), *(0,) * 6, round(1e2 * charge), 0, 0, 0


def _power(r: CopterReport) -> Power:
    return _CHARGED if r.estimate.battery is FULL else r.estimate.battery


def system_time(r: CopterReport) -> Fields:
    return 0, r.estimate.t_us // 1000


def attitude(r: CopterReport) -> Fields:
    e = r.estimate
    return e.t_us // 1000, *e.euler_rad, *e.rate_frd_rad_s


def attitude_quaternion(r: CopterReport) -> Fields:
    e = r.estimate
    return e.t_us // 1000, *e.q_nb, *e.rate_frd_rad_s, *_NO_OFFSET


def local_position(r: CopterReport) -> Fields:
    e = r.estimate
    return e.t_us // 1000, *e.pos_ned_m, *e.vel_ned_m_s


def global_position(r: CopterReport) -> Fields:
    e, origin = r.estimate, r.origin
    x_m, y_m, z_m = e.pos_ned_m
    home_z_m = r.pilot.home_ned_m[2] if r.pilot.home_ned_m else 0.0
    return (
        e.t_us // 1000,
        *origin.to_geo_e7(x_m, y_m),
        origin.alt_mm - round(z_m * 1e3),
        round((home_z_m - z_m) * 1e3),
        *(max(-32767, min(32767, round(v * 100))) for v in e.vel_ned_m_s),
        round(math.degrees(e.yaw_rad) % 360.0 * 100) % 36000,
    )


def gps_raw(r: CopterReport) -> Fields:
    e, origin = r.estimate, r.origin
    alt_mm = origin.alt_mm - round(e.pos_ned_m[2] * 1e3)
    speed_cm_s = min(65534, round(100 * math.hypot(*e.vel_ned_m_s[:2])))
    course_cdeg = round(math.degrees(math.atan2(e.vel_ned_m_s[1], e.vel_ned_m_s[0])) % 360.0 * 100) % 36000
    horizontal_mm, vertical_mm = (round(1e3 * m) for m in e.gps_accuracy_m)
    fix = _FIX_RTK if e.gps_ok else _NO_FIX
    place = *origin.to_geo_e7(e.pos_ned_m[0], e.pos_ned_m[1]), alt_mm
    accuracy = horizontal_mm, vertical_mm, 40, 0
    return e.t_us, *place, 121, 200, speed_cm_s, course_cdeg, fix, 10, alt_mm, *accuracy, 0


def gps_global_origin(r: CopterReport) -> Fields:
    return r.origin.lat_e7, r.origin.lon_e7, r.origin.alt_mm, r.estimate.t_us


def home_position(r: CopterReport) -> Fields:
    x_m, y_m, z_m = r.pilot.home_ned_m or (0.0, 0.0, 0.0)
    alt_mm = r.origin.alt_mm - round(z_m * 1e3)
    lat_e7, lon_e7 = r.origin.to_geo_e7(x_m, y_m)
    return lat_e7, lon_e7, alt_mm, x_m, y_m, z_m, *_LEVEL, 0.0, 0.0, 0.0, r.estimate.t_us


def vfr_hud(r: CopterReport) -> Fields:
    e = r.estimate
    ground_m_s = math.hypot(*e.vel_ned_m_s[:2])
    heading_deg = int(math.degrees(e.yaw_rad) % 360.0)
    throttle = round(100 * r.pilot.output.thrust_01)
    amsl_m = r.origin.alt_mm / 1e3 - e.pos_ned_m[2]
    return ground_m_s, ground_m_s, amsl_m, -e.vel_ned_m_s[2], heading_deg, throttle


def attitude_target(r: CopterReport) -> Fields:
    return r.estimate.t_us // 1000, *r.pilot.target_q_nb.tolist(), 0.0, 0.0, 0.0, r.pilot.throttle_in_01, 0


def servo_output(r: CopterReport) -> Fields:
    least = _SPIN_ARMED if r.pilot.armed else 0.0
    pwm = [_PWM_OFF + round(_PWM_SPAN * max(least, f)) for f in r.rotor_01()]
    return r.estimate.t_us & 0xFFFFFFFF, *pwm, 0, 0, 0, 0, 0, *_NO_SERVOS


def extended_sys_state(r: CopterReport) -> Fields:
    return 0, r.pilot.landed


def battery_status(r: CopterReport) -> Fields:
    charge, volts, amperes = _power(r)
    cells = round(1e3 * volts), *(65535,) * 9
    return -1, -1, 32767, *cells, round(1e2 * amperes), 0, 0, 0, round(1e2 * charge), 0, 0, *(0,) * 4, 0, 0


def ekf_status(r: CopterReport) -> Fields:
    """Build EKF_STATUS_REPORT; its "variances" are test ratios of innovations, not metres."""
    if not r.pilot.has_origin:
        return 0.0, 0.0, 0.0, 0.0, 0.0, _EKF_NO_POSITION
    horizontal_m, vertical_m = r.estimate.gps_accuracy_m
    ratios = min(1.0, horizontal_m / _GATE_M), min(1.0, vertical_m / _GATE_M)
    return 0.02, *ratios, 0.02, 0.0, _EKF_HEALTHY


def autopilot_version(r: CopterReport) -> Fields:
    return _CAPABILITIES, 0, _VERSION, 0, 0, 0, 0, 0, *_GIT_HASH, *(0,) * (8 + 8 + 18)


EXTENDED_STATUS, RC_CHANNELS, POSITION, EXTRA1, EXTRA2, EXTRA3 = 2, 3, 6, 10, 11, 12  # MAV_DATA_STREAM
ALL_GROUPS = 0


@dataclass(frozen=True, slots=True)
class CopterStream:
    """One message that this vehicle can send."""

    build: Callable[[CopterReport], Fields]
    group: int | None = None  # group of REQUEST_DATA_STREAM; None: by SET_MESSAGE_INTERVAL or REQUEST_MESSAGE only
    needs_position: bool = False  # only after the EKF has its origin


STREAMS: dict[int, CopterStream] = {
    mav.MAVLINK_MSG_ID_HEARTBEAT: CopterStream(heartbeat),
    mav.MAVLINK_MSG_ID_SYS_STATUS: CopterStream(sys_status, EXTENDED_STATUS),
    mav.MAVLINK_MSG_ID_SYSTEM_TIME: CopterStream(system_time, EXTRA3),
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: CopterStream(gps_raw, EXTENDED_STATUS),
    mav.MAVLINK_MSG_ID_ATTITUDE: CopterStream(attitude, EXTRA1),
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: CopterStream(attitude_quaternion),
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: CopterStream(local_position, POSITION, True),
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: CopterStream(global_position, POSITION, True),
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: CopterStream(servo_output, RC_CHANNELS),
    mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: CopterStream(gps_global_origin, None, True),
    mav.MAVLINK_MSG_ID_VFR_HUD: CopterStream(vfr_hud, EXTRA2),
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: CopterStream(attitude_target),
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: CopterStream(battery_status, EXTRA3),
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: CopterStream(autopilot_version),
    EKF_STATUS_REPORT: CopterStream(ekf_status, EXTRA3),
    mav.MAVLINK_MSG_ID_HOME_POSITION: CopterStream(home_position, None, True),
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: CopterStream(extended_sys_state),
}


class Intervals:
    """Decides which messages are due. Times since boot lie on a grid from boot, so that samples repeat exactly."""

    def __init__(self, step_us: int) -> None:
        self._step_us = step_us
        self._interval_us: dict[int, int] = {}
        self._next_us: dict[int, int] = {}
        self._earliest_us = 0

    def set_interval(self, message: int, interval_us: int, now_us: int) -> None:
        """Set the interval of a message [us], never below one physics step; 0 and less: off."""
        if interval_us <= 0:
            self._interval_us.pop(message, None)
            self._next_us.pop(message, None)
        else:
            interval_us = max(interval_us, self._step_us)
            self._interval_us[message] = interval_us
            self._next_us[message] = now_us + -now_us % interval_us
        self._earliest_us = min(self._next_us.values(), default=0)

    def take_due(self, now_us: int) -> list[int]:
        """Return the ids due at `now_us`, in ascending order (attitude before position); a missed one is sent once."""
        if now_us < self._earliest_us:
            return []
        due = sorted(message for message, at_us in self._next_us.items() if at_us <= now_us)
        for message in due:
            interval_us = self._interval_us[message]
            self._next_us[message] += interval_us * (1 + (now_us - self._next_us[message]) // interval_us)
        self._earliest_us = min(self._next_us.values(), default=0)
        return due
