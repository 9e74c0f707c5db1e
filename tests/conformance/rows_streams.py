"""Section 1 of the sheet: default messages of each link without traffic to it, and their rates [Hz]."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StreamRow:
    """A message's default rates; None: not on that link."""

    name: str
    number: int
    offboard_hz: float | None
    gcs_hz: float | None


STREAMS = (
    StreamRow("ATTITUDE", 30, 99.0, 49.5),
    StreamRow("ATTITUDE_QUATERNION", 31, 49.4, 49.5),
    StreamRow("GLOBAL_POSITION_INT", 33, 49.4, 49.5),
    StreamRow("HIGHRES_IMU", 105, 49.5, None),
    StreamRow("LOCAL_POSITION_NED", 32, 29.7, 49.4),
    StreamRow("ODOMETRY", 331, 29.7, None),
    StreamRow("ATTITUDE_TARGET", 83, 9.85, 49.4),
    StreamRow("POSITION_TARGET_LOCAL_NED", 85, 9.85, 49.4),
    StreamRow("SERVO_OUTPUT_RAW", 36, 9.85, 49.4),
    StreamRow("TIMESYNC", 111, 9.85, None),
    StreamRow("ALTITUDE", 141, 9.85, 1.0),
    StreamRow("ESC_INFO", 290, 9.85, 1.0),
    StreamRow("ESC_STATUS", 291, 9.85, 1.0),
    StreamRow("VFR_HUD", 74, 9.85, 3.95),
    StreamRow("DISTANCE_SENSOR", 132, 9.85, 0.5),
    StreamRow("GPS_RAW_INT", 24, 7.9, 4.95),
    StreamRow("EXTENDED_SYS_STATE", 245, 4.95, 1.0),
    StreamRow("SYS_STATUS", 1, 4.95, 1.0),
    StreamRow("HEARTBEAT", 0, 1.0, 1.0),
    StreamRow("LINK_NODE_STATUS", 8, 1.0, 1.0),
    StreamRow("SCALED_PRESSURE", 29, 1.0, 1.0),
    StreamRow("MISSION_CURRENT", 42, 1.0, 1.0),
    StreamRow("GNSS_INTEGRITY", 441, 1.0, 1.0),
    StreamRow("OPEN_DRONE_ID_LOCATION", 12901, 1.0, 1.0),
    StreamRow("OPEN_DRONE_ID_SYSTEM", 12904, 1.0, 1.0),
    StreamRow("ESTIMATOR_STATUS", 230, 1.0, 0.5),
    StreamRow("ESTIMATOR_SENSOR_FUSION_STATUS", 514, 1.0, 0.5),
    StreamRow("SYSTEM_TIME", 2, 1.0, None),
    StreamRow("PING", 4, 1.0, 0.1),
    StreamRow("BATTERY_STATUS", 147, 0.5, 0.5),
    StreamRow("HOME_POSITION", 242, 0.5, 0.5),
    StreamRow("TIME_ESTIMATE_TO_TARGET", 380, 0.5, 0.5),
    StreamRow("CURRENT_MODE", 436, 0.5, 0.5),
    StreamRow("VIBRATION", 241, 0.5, 0.1),
    StreamRow("CURRENT_EVENT_SEQUENCE", 411, 0.3, 0.35),
)
SILENT = {"STATUSTEXT": 253, "GPS_GLOBAL_ORIGIN": 49, "AUTOPILOT_VERSION": 148, "PARAM_VALUE": 22, "EVENT": 410}
ALL_PER_S = {"offboard": 427.0, "gcs": 371.0}
