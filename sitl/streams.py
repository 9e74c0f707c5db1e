"""What one vehicle reports: a builder and a default rate per message, and the schedule that says which are due.

Rates are those PX4 1.18 uses on its offboard link. Every builder takes the same `Report` and returns a dialect message.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.autopilot import Autopilot
from sitl.sensors import Estimate, LocalOrigin

FRAME_LOCAL_NED = 1
_NAN = math.nan
_NO_COVARIANCE = [_NAN] * 21
_LEVEL = [1.0, 0.0, 0.0, 0.0]
_SENSORS_PRESENT = 0x0200C02F
_SENSORS_ENABLED = 0x0201C02F
_SENSORS_HEALTHY = 0x0320C83F
_PREARM_CHECK = 0x10000000
_BATTERY_MV = 16200
_ESTIMATOR_FLAGS = 1023
_PWM_OFF, _PWM_IDLE, _PWM_SPAN = 900, 1000, 1000


@dataclass(frozen=True, slots=True)
class Report:
    """Everything a message can be built from, at one instant."""

    estimate: Estimate
    autopilot: Autopilot
    origin: LocalOrigin
    rotor_01: tuple[float, float, float, float]


def heartbeat(r: Report) -> Any:
    pilot = r.autopilot
    return mav.MAVLink_heartbeat_message(2, 12, pilot.base_mode(), pilot.mode, pilot.system_status(r.estimate.t_us), 3)


def current_mode(r: Report) -> Any:
    return mav.MAVLink_current_mode_message(0, r.autopilot.mode, r.autopilot.intended)


def sys_status(r: Report) -> Any:
    health = _SENSORS_HEALTHY | (_PREARM_CHECK if r.autopilot.armable(r.estimate.t_us) or r.autopilot.armed else 0)
    return mav.MAVLink_sys_status_message(
        _SENSORS_PRESENT, _SENSORS_ENABLED, health, 100, _BATTERY_MV, -1, 100, 0, 0, 0, 0, 0, 0
    )


def system_time(r: Report) -> Any:
    return mav.MAVLink_system_time_message(0, r.estimate.t_us // 1000)


def attitude(r: Report) -> Any:
    e = r.estimate
    return mav.MAVLink_attitude_message(e.t_us // 1000, *e.euler_rad, *e.rate_frd_rad_s)


def attitude_quaternion(r: Report) -> Any:
    e = r.estimate
    return mav.MAVLink_attitude_quaternion_message(e.t_us // 1000, *e.q_nb, *e.rate_frd_rad_s, [0.0] * 4)


def local_position(r: Report) -> Any:
    e = r.estimate
    return mav.MAVLink_local_position_ned_message(e.t_us // 1000, *e.pos_ned_m, *e.vel_ned_m_s)


def odometry(r: Report) -> Any:
    e = r.estimate
    return mav.MAVLink_odometry_message(
        e.t_us,
        FRAME_LOCAL_NED,
        FRAME_LOCAL_NED,  # velocity NED too, as PX4 sends it
        *e.pos_ned_m,
        e.q_nb,
        *e.vel_ned_m_s,
        *e.rate_frd_rad_s,
        _NO_COVARIANCE,
        _NO_COVARIANCE,
        0,
        0,
        100,
    )


def global_position(r: Report) -> Any:
    e, origin = r.estimate, r.origin
    x_m, y_m, z_m = e.pos_ned_m
    lat_e7, lon_e7 = origin.to_geo_e7(x_m, y_m)
    home_z_m = r.autopilot.home_ned_m[2] if r.autopilot.home_ned_m else 0.0
    return mav.MAVLink_global_position_int_message(
        e.t_us // 1000,
        lat_e7,
        lon_e7,
        origin.alt_mm - round(z_m * 1e3),
        round((home_z_m - z_m) * 1e3),
        *(_int16(v * 100) for v in e.vel_ned_m_s),
        round(math.degrees(e.yaw_rad) % 360.0 * 100) % 36000,
    )


def gps_raw(r: Report) -> Any:
    e, origin = r.estimate, r.origin
    lat_e7, lon_e7 = origin.to_geo_e7(e.pos_ned_m[0], e.pos_ned_m[1])
    alt_mm = origin.alt_mm - round(e.pos_ned_m[2] * 1e3)
    speed_cm_s = min(65534, round(100 * math.hypot(*e.vel_ned_m_s[:2])))
    return mav.MAVLink_gps_raw_int_message(e.t_us, 3, lat_e7, lon_e7, alt_mm, 90, 90, speed_cm_s, 65535, 10, alt_mm)


def gps_global_origin(r: Report) -> Any:
    return mav.MAVLink_gps_global_origin_message(r.origin.lat_e7, r.origin.lon_e7, r.origin.alt_mm, r.estimate.t_us)


def home_position(r: Report) -> Any:
    x_m, y_m, z_m = r.autopilot.home_ned_m or (0.0, 0.0, 0.0)
    lat_e7, lon_e7 = r.origin.to_geo_e7(x_m, y_m)
    return mav.MAVLink_home_position_message(
        lat_e7, lon_e7, r.origin.alt_mm - round(z_m * 1e3), x_m, y_m, z_m, _LEVEL, _NAN, _NAN, _NAN, r.estimate.t_us
    )


def altitude(r: Report) -> Any:
    up_m = -r.estimate.pos_ned_m[2]
    amsl_m = r.origin.alt_mm / 1e3 + up_m
    home_up_m = -r.autopilot.home_ned_m[2] if r.autopilot.home_ned_m else 0.0
    return mav.MAVLink_altitude_message(r.estimate.t_us, amsl_m, amsl_m, up_m, up_m - home_up_m, _NAN, _NAN)


def vfr_hud(r: Report) -> Any:
    e = r.estimate
    north, east, down = e.vel_ned_m_s
    heading_deg = int(math.degrees(e.yaw_rad) % 360.0)
    throttle = round(100 * r.autopilot.output.thrust_01)
    amsl_m = r.origin.alt_mm / 1e3 - e.pos_ned_m[2]
    return mav.MAVLink_vfr_hud_message(_NAN, math.hypot(north, east), heading_deg, throttle, amsl_m, -down)


def attitude_target(r: Report) -> Any:
    out = r.autopilot.output
    return mav.MAVLink_attitude_target_message(
        r.estimate.t_us // 1000, 0, out.q_nb.tolist(), 0.0, 0.0, 0.0, out.thrust_01
    )


def servo_output(r: Report) -> Any:
    running = r.autopilot.armed and not r.autopilot.terminated
    pwm = [_PWM_IDLE + round(_PWM_SPAN * f) if running else _PWM_OFF for f in r.rotor_01]
    return mav.MAVLink_servo_output_raw_message(r.estimate.t_us & 0xFFFFFFFF, 0, *pwm, 0, 0, 0, 0)


def extended_sys_state(r: Report) -> Any:
    return mav.MAVLink_extended_sys_state_message(0, r.autopilot.landed)


def battery_status(r: Report) -> Any:
    cells = [_BATTERY_MV // 4] * 4 + [65535] * 6
    return mav.MAVLink_battery_status_message(0, 0, 0, 32767, cells, -1, -1, -1, 100)


def estimator_status(r: Report) -> Any:
    return mav.MAVLink_estimator_status_message(r.estimate.t_us, _ESTIMATOR_FLAGS, 0, 0, 0, 0, 0, 0, 0.01, 0.01)


def autopilot_version(r: Report) -> Any:
    version, none = 0x01120000, [0] * 8
    return mav.MAVLink_autopilot_version_message(59647, version, version, 0, 1, none, none, none, 0, 0, r.origin.lat_e7)


def _int16(value: float) -> int:
    return max(-32767, min(32767, round(value)))


@dataclass(frozen=True, slots=True)
class Stream:
    """One message this vehicle can send; rate 0: only when asked."""

    build: Callable[[Report], Any]
    rate_hz: float
    needs_position: bool = False  # not before the estimator is ready


STREAMS: dict[int, Stream] = {
    mav.MAVLINK_MSG_ID_HEARTBEAT: Stream(heartbeat, 1.0),
    mav.MAVLINK_MSG_ID_SYS_STATUS: Stream(sys_status, 5.0),
    mav.MAVLINK_MSG_ID_SYSTEM_TIME: Stream(system_time, 1.0),
    mav.MAVLINK_MSG_ID_ATTITUDE: Stream(attitude, 100.0),
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: Stream(attitude_quaternion, 50.0),
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: Stream(local_position, 30.0, True),
    mav.MAVLINK_MSG_ID_ODOMETRY: Stream(odometry, 30.0, True),
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Stream(global_position, 50.0, True),
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: Stream(gps_raw, 8.0),
    mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: Stream(gps_global_origin, 0.0, True),
    mav.MAVLINK_MSG_ID_HOME_POSITION: Stream(home_position, 0.5, True),
    mav.MAVLINK_MSG_ID_ALTITUDE: Stream(altitude, 10.0, True),
    mav.MAVLINK_MSG_ID_VFR_HUD: Stream(vfr_hud, 10.0, True),
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: Stream(attitude_target, 10.0),
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: Stream(servo_output, 10.0),
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Stream(extended_sys_state, 5.0),
    mav.MAVLINK_MSG_ID_CURRENT_MODE: Stream(current_mode, 0.5),
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: Stream(battery_status, 0.5),
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Stream(estimator_status, 1.0),
    mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION: Stream(autopilot_version, 0.0),
}
_ON_THE_GRID = frozenset({mav.MAVLINK_MSG_ID_ODOMETRY, mav.MAVLINK_MSG_ID_HEARTBEAT})
_NEVER_US = 1 << 62


class Schedule:
    """Which messages are due. Times are since boot; intervals lie on a grid from boot, so samples repeat exactly.

    All but odometry and heartbeat are shifted by their id, so that one step never has to send everything.
    """

    def __init__(self, step_us: int) -> None:
        self._step_us = step_us
        self._interval_us: dict[int, int] = {}
        self._next_us: dict[int, int] = {}
        self._earliest_us = 0
        for message, stream in STREAMS.items():
            if stream.rate_hz > 0:
                self.set_interval(message, round(1e6 / stream.rate_hz), 0)

    def set_interval(self, message: int, interval_us: int, now_us: int) -> None:
        """Interval of a message [us]; 0 its default, negative off. Never faster than one physics step."""
        if interval_us == 0:
            rate_hz = STREAMS[message].rate_hz
            interval_us = round(1e6 / rate_hz) if rate_hz > 0 else -1
        if interval_us < 0:
            self._interval_us.pop(message, None)
            self._next_us.pop(message, None)
        else:
            interval_us = max(interval_us, self._step_us)
            shift_us = 0 if message in _ON_THE_GRID else message * self._step_us % interval_us
            self._interval_us[message] = interval_us
            self._next_us[message] = now_us + (shift_us - now_us) % interval_us
        self._earliest_us = min(self._next_us.values(), default=_NEVER_US)

    def interval_us(self, message: int) -> int:
        """Interval of a message, -1 when it is off."""
        return self._interval_us.get(message, -1)

    def take_due(self, now_us: int) -> list[int]:
        """Ids due at `now_us`; missed ones are sent once, not made up for."""
        if now_us < self._earliest_us:
            return []
        due = [message for message, at_us in self._next_us.items() if at_us <= now_us]
        for message in due:
            interval_us = self._interval_us[message]
            late_us = now_us - self._next_us[message]
            self._next_us[message] += interval_us * (1 + late_us // interval_us)
        self._earliest_us = min(self._next_us.values(), default=_NEVER_US)
        return due
