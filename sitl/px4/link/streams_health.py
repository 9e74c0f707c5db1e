"""Reports of one vehicle about its sensors, power, estimator and link, and the table of all messages."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import development as mav

from sitl.px4.link.schedule import CURRENT_EVENT_SEQUENCE, ESC_INFO, ESC_STATUS, LINK_NODE_STATUS, SENSOR_FUSION
from sitl.px4.link.streams import FLIGHT_STREAMS, NAN, Fields, LinkCounts, Report, Stream, home_z_m, int32, ms
from sitl.px4.settling import claimed, unaided_m
from swarmctl.core.ordered_sums import ordered_sum

_SENSORS_PRESENT = 0x0300C02F
_SENSORS_ENABLED = 0x0301C02F
_SENSORS_HEALTHY = 0x0320C83F
_SENSOR_GPS = 0x20
_SENSOR_BATTERY = 0x02000000
_PREARM_CHECK = 0x10000000
_CELLS = 4
_POSITION_ESTIMATED = 0x0008 | 0x0010 | 0x0100 | 0x0200  # horizontal relative, absolute, and both predicted
_EARTH_FIELD_NED_GAUSS = (0.214, 0.011, 0.430)  # central Europe
_SEA_LEVEL_HPA, _SEA_LEVEL_K, _LAPSE_K_M, _EXPONENT = 1013.25, 288.15, 0.0065, 5.25588
_ALL_IMU_FIELDS = 0x1FFF
_LIDAR_MIN_CM, _LIDAR_MAX_CM, _DOWNWARD = 10, 5000, 25
_DSHOT = 5
_ROTOR_MAX_RPM = 2900  # of the presets' 5 N rotor: sqrt(5 / 54.2e-6) rad/s
_ESC_CDEG_C = 2500
_NO_ID = (0,) * 20
_UNKNOWN = 255
_FUSED = (0, 4, 6)  # GPS, barometer, magnetometer of nine sources


def sys_status(r: Report) -> Fields:
    pilot = r.autopilot
    health = _SENSORS_HEALTHY
    if pilot.armed or pilot.armable(r.estimate.t_us):
        health |= _PREARM_CHECK
    if not (pilot.has_position and r.estimate.gps_ok):
        health &= ~_SENSOR_GPS
    if pilot.battery_01 <= pilot.parameters.real("BAT_CRIT_THR"):
        health &= ~_SENSOR_BATTERY
    volts_mv, amps_ca = _uint16(pilot.battery_v * 1e3), _centiamperes(pilot.battery_a)
    return (
        _SENSORS_PRESENT,
        _SENSORS_ENABLED,
        health,
        100,
        volts_mv,
        amps_ca,
        *(0,) * 6,
        _percent(pilot.battery_01),
        0,
        0,
        0,
    )


def battery_status(r: Report) -> Fields:
    pilot = r.autopilot
    cell_mv = _uint16(pilot.battery_v * 1e3 / _CELLS)
    cells = (cell_mv,) * _CELLS + (65535,) * (10 - _CELLS)
    level = pilot.battery_warning + 1  # MAV_BATTERY_CHARGE_STATE: 1 ok, 2 low, 3 critical, 4 emergency
    percent = _percent(pilot.battery_01)
    return -1, -1, 32767, *cells, _centiamperes(pilot.battery_a), 0, 0, 0, percent, 0, level, 0, 0, 0, 0, 0, 0


def gps_raw(r: Report) -> Fields:
    e, origin = r.estimate, r.origin
    if not (r.autopilot.has_position and e.gps_ok):
        return e.t_us, 0, 0, 0, 9999, 9999, 0, 65535, 0, 0, 0, 0, 0, 0, 0, 0
    lat_e7, lon_e7 = origin.to_geo_e7(e.pos_ned_m[0], e.pos_ned_m[1])
    alt_mm = int32(origin.alt_mm - e.pos_ned_m[2] * 1e3)
    north, east, _ = e.vel_ned_m_s
    speed_cm_s = min(65534, round(100 * math.hypot(north, east)))
    course_cdeg = round(math.degrees(math.atan2(east, north)) % 360.0 * 100) % 36000
    accuracy = 900, 900, 250, 0, 0  # mm, mm, mm/s
    return e.t_us, int32(lat_e7), int32(lon_e7), alt_mm, 90, 90, speed_cm_s, course_cdeg, 3, 10, alt_mm, *accuracy


def highres_imu(r: Report) -> Fields:
    e = r.estimate
    altitude_m = r.origin.alt_mm / 1e3 - e.pos_ned_m[2]
    pressure_hpa, celsius = _air(altitude_m)
    return (
        e.t_us,
        *r.force_frd_m_s2(),
        *e.rate_frd_rad_s,
        *_in_body(e.q_nb, _EARTH_FIELD_NED_GAUSS),
        pressure_hpa,
        0.0,
        altitude_m,
        celsius,
        _ALL_IMU_FIELDS,
        0,
    )


def scaled_pressure(r: Report) -> Fields:
    pressure_hpa, celsius = _air(r.origin.alt_mm / 1e3 - r.estimate.pos_ned_m[2])
    return ms(r), pressure_hpa, 0.0, round(celsius * 100), 0


def distance_sensor(r: Report) -> Fields:
    """Build the message of a lidar that looks down: height over the vehicle's own ground along its body axis."""
    height_m = (home_z_m(r) - r.estimate.pos_ned_m[2]) / max(0.1, r.estimate.down_axis_ned[2])
    range_cm = max(_LIDAR_MIN_CM, min(_LIDAR_MAX_CM, round(height_m * 100)))
    fields = _LIDAR_MIN_CM, _LIDAR_MAX_CM, range_cm, 0, 0, _DOWNWARD, 0
    return ms(r), *fields, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 100


def esc_info(r: Report) -> Fields:
    running = 0x0F if r.autopilot.motors_on else 0
    counter = r.estimate.t_us // 100_000 & 0xFFFF
    return r.estimate.t_us, 0, 0, 0, 0, counter, 0, 0, 0, 0, *(_ESC_CDEG_C,) * 4, 0, 4, _DSHOT, running


def esc_status(r: Report) -> Fields:
    rpm = [round(_ROTOR_MAX_RPM * math.sqrt(max(0.0, f))) for f in r.rotor_01()]
    each_a = max(0.0, r.autopilot.battery_a) / 4.0
    return r.estimate.t_us, *rpm, *(r.autopilot.battery_v,) * 4, *(each_a,) * 4, 0


def vibration(r: Report) -> Fields:
    shake = 0.01 + 0.02 * ordered_sum(r.rotor_01())
    return r.estimate.t_us, shake, shake, shake, 0, 0, 0


def estimator_status(r: Report) -> Fields:
    e, pilot = r.estimate, r.autopilot
    horizontal_m, vertical_m = e.pos_accuracy_m
    horizontal_m, flags = claimed(horizontal_m, pilot.settled_share(e.t_us))
    horizontal_m += unaided_m(pilot.unaided_us * 1e-6)
    if not pilot.has_position:
        flags &= ~_POSITION_ESTIMATED
    return e.t_us, 0.02, 0.02, 0.02, 0.01, 0.0, NAN, horizontal_m, vertical_m, flags


def sensor_fusion(r: Report) -> Fields:
    ratios = [0.02 if source in _FUSED else NAN for source in range(9)]
    intended = [int(source in _FUSED) for source in range(9)]
    active = [intended[0] & int(r.autopilot.has_position), *intended[1:]]
    return *ratios, *intended, *active


def gnss_integrity(r: Report) -> Fields:
    return 0, 65535, 65535, 0, 0, 0, 0, 0, _UNKNOWN, _UNKNOWN, _UNKNOWN, _UNKNOWN


def drone_id_location(r: Report) -> Fields:
    e, origin = r.estimate, r.origin
    lat_e7, lon_e7 = origin.to_geo_e7(e.pos_ned_m[0], e.pos_ned_m[1])
    north, east, down = e.vel_ned_m_s
    up_m = origin.alt_mm / 1e3 - e.pos_ned_m[2]
    course_cdeg = round(math.degrees(math.atan2(east, north)) % 360.0 * 100) % 36000
    status = 2 if r.autopilot.landed != 1 else 1
    hour_s = (r.autopilot.boot_utc_us + e.t_us) / 1e6 % 3600.0
    speeds = min(25425, round(math.hypot(north, east) * 100)), max(-6200, min(6200, round(-down * 100)))
    height_m = home_z_m(r) - e.pos_ned_m[2]
    return (
        int32(lat_e7),
        int32(lon_e7),
        up_m,
        up_m,
        height_m,
        hour_s,
        course_cdeg,
        *speeds,
        0,
        0,
        *_NO_ID,
        status,
        0,
        11,
        5,
        4,
        3,
        1,
    )


def drone_id_system(r: Report) -> Fields:
    """Build the operator's position: where the vehicle took off."""
    x_m, y_m, z_m = r.autopilot.home_ned_m or (0.0, 0.0, 0.0)
    lat_e7, lon_e7 = r.origin.to_geo_e7(x_m, y_m)
    since_2019_s = max(0, (r.autopilot.boot_utc_us + r.estimate.t_us) // 1_000_000 - 1_546_300_800) & 0xFFFFFFFF
    altitude_m = r.origin.alt_mm / 1e3 - z_m
    return int32(lat_e7), int32(lon_e7), -1000.0, -1000.0, altitude_m, since_2019_s, 1, 0, 0, 0, *_NO_ID, 0, 0, 0, 0


def link_node_status(r: Report) -> Fields:
    counts = r.counts or LinkCounts()
    elapsed_s = max(1.0, r.estimate.t_us / 1e6)
    rates = round(counts.sent_bytes / elapsed_s), round(counts.received_bytes / elapsed_s)
    tally = *rates, counts.sent & 0xFFFFFFFF, counts.received & 0xFFFFFFFF, 0
    return r.estimate.t_us // 1000, *tally, counts.not_decoded & 0xFFFF, 0, 0, 0, 0


def timesync(r: Report) -> Fields:
    """Build a request of its own, which a client answers with tc1."""
    return 0, r.estimate.t_us * 1000


def ping(r: Report) -> Fields:
    counts = r.counts or LinkCounts()
    counts.pings += 1
    return r.estimate.t_us, counts.pings - 1, 0, 0


def event_sequence(_: Report) -> Fields:
    return 0, 0


def _air(altitude_m: float) -> tuple[float, float]:
    """Return pressure [hPa] and temperature [deg C] of the standard atmosphere's lowest layer."""
    kelvin = max(100.0, _SEA_LEVEL_K - _LAPSE_K_M * altitude_m)
    return _SEA_LEVEL_HPA * (kelvin / _SEA_LEVEL_K) ** _EXPONENT, kelvin - 273.15


def _in_body(q_nb: tuple[float, float, float, float], v: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a NED vector in body axes: conj(q) v q."""
    w, x, y, z = q_nb
    a, b, c = v
    tx, ty, tz = 2 * (z * b - y * c), 2 * (x * c - z * a), 2 * (y * a - x * b)
    return a + w * tx + z * ty - y * tz, b + w * ty + x * tz - z * tx, c + w * tz + y * tx - x * ty


def _percent(level_01: float) -> int:
    return max(0, min(100, round(100 * level_01)))


def _uint16(value: float) -> int:
    return max(0, min(65534, round(value)))


def _centiamperes(current_a: float) -> int:
    return max(-1, min(32767, round(current_a * 100)))


STREAMS: dict[int, Stream] = {
    **FLIGHT_STREAMS,
    mav.MAVLINK_MSG_ID_SYS_STATUS: Stream(sys_status),
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: Stream(battery_status),
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: Stream(gps_raw),
    mav.MAVLINK_MSG_ID_HIGHRES_IMU: Stream(highres_imu),
    mav.MAVLINK_MSG_ID_SCALED_PRESSURE: Stream(scaled_pressure),
    mav.MAVLINK_MSG_ID_DISTANCE_SENSOR: Stream(distance_sensor),
    ESC_INFO: Stream(esc_info),
    ESC_STATUS: Stream(esc_status),
    mav.MAVLINK_MSG_ID_VIBRATION: Stream(vibration),
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: Stream(estimator_status),
    SENSOR_FUSION: Stream(sensor_fusion),
    mav.MAVLINK_MSG_ID_GNSS_INTEGRITY: Stream(gnss_integrity),
    mav.MAVLINK_MSG_ID_OPEN_DRONE_ID_LOCATION: Stream(drone_id_location),
    mav.MAVLINK_MSG_ID_OPEN_DRONE_ID_SYSTEM: Stream(drone_id_system),
    LINK_NODE_STATUS: Stream(link_node_status),
    mav.MAVLINK_MSG_ID_TIMESYNC: Stream(timesync),
    mav.MAVLINK_MSG_ID_PING: Stream(ping),
    CURRENT_EVENT_SEQUENCE: Stream(event_sequence),
}
