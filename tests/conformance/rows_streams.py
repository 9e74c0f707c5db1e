"""Section 1 of the sheet: default messages of each link without traffic to it, and their rates [Hz]."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamRow:
    """A message's default rates; None: not on that link."""

    name: str
    number: int
    offboard_hz: float | None
    gcs_hz: float | None


STREAMS = (
    StreamRow(name="ATTITUDE", number=30, offboard_hz=99.0, gcs_hz=49.5),
    StreamRow(name="ATTITUDE_QUATERNION", number=31, offboard_hz=49.4, gcs_hz=49.5),
    StreamRow(name="GLOBAL_POSITION_INT", number=33, offboard_hz=49.4, gcs_hz=49.5),
    StreamRow(name="HIGHRES_IMU", number=105, offboard_hz=49.5, gcs_hz=None),
    StreamRow(name="LOCAL_POSITION_NED", number=32, offboard_hz=29.7, gcs_hz=49.4),
    StreamRow(name="ODOMETRY", number=331, offboard_hz=29.7, gcs_hz=None),
    StreamRow(name="ATTITUDE_TARGET", number=83, offboard_hz=9.85, gcs_hz=49.4),
    StreamRow(name="POSITION_TARGET_LOCAL_NED", number=85, offboard_hz=9.85, gcs_hz=49.4),
    StreamRow(name="SERVO_OUTPUT_RAW", number=36, offboard_hz=9.85, gcs_hz=49.4),
    StreamRow(name="TIMESYNC", number=111, offboard_hz=9.85, gcs_hz=None),
    StreamRow(name="ALTITUDE", number=141, offboard_hz=9.85, gcs_hz=1.0),
    StreamRow(name="ESC_INFO", number=290, offboard_hz=9.85, gcs_hz=1.0),
    StreamRow(name="ESC_STATUS", number=291, offboard_hz=9.85, gcs_hz=1.0),
    StreamRow(name="VFR_HUD", number=74, offboard_hz=9.85, gcs_hz=3.95),
    StreamRow(name="DISTANCE_SENSOR", number=132, offboard_hz=9.85, gcs_hz=0.5),
    StreamRow(name="GPS_RAW_INT", number=24, offboard_hz=7.9, gcs_hz=4.95),
    StreamRow(name="EXTENDED_SYS_STATE", number=245, offboard_hz=4.95, gcs_hz=1.0),
    StreamRow(name="SYS_STATUS", number=1, offboard_hz=4.95, gcs_hz=1.0),
    StreamRow(name="HEARTBEAT", number=0, offboard_hz=1.0, gcs_hz=1.0),
    StreamRow(name="LINK_NODE_STATUS", number=8, offboard_hz=1.0, gcs_hz=1.0),
    StreamRow(name="SCALED_PRESSURE", number=29, offboard_hz=1.0, gcs_hz=1.0),
    StreamRow(name="MISSION_CURRENT", number=42, offboard_hz=1.0, gcs_hz=1.0),
    StreamRow(name="GNSS_INTEGRITY", number=441, offboard_hz=1.0, gcs_hz=1.0),
    StreamRow(name="OPEN_DRONE_ID_LOCATION", number=12901, offboard_hz=1.0, gcs_hz=1.0),
    StreamRow(name="OPEN_DRONE_ID_SYSTEM", number=12904, offboard_hz=1.0, gcs_hz=1.0),
    StreamRow(name="ESTIMATOR_STATUS", number=230, offboard_hz=1.0, gcs_hz=0.5),
    StreamRow(name="ESTIMATOR_SENSOR_FUSION_STATUS", number=514, offboard_hz=1.0, gcs_hz=0.5),
    StreamRow(name="SYSTEM_TIME", number=2, offboard_hz=1.0, gcs_hz=None),
    StreamRow(name="PING", number=4, offboard_hz=1.0, gcs_hz=0.1),
    StreamRow(name="BATTERY_STATUS", number=147, offboard_hz=0.5, gcs_hz=0.5),
    StreamRow(name="HOME_POSITION", number=242, offboard_hz=0.5, gcs_hz=0.5),
    StreamRow(name="TIME_ESTIMATE_TO_TARGET", number=380, offboard_hz=0.5, gcs_hz=0.5),
    StreamRow(name="CURRENT_MODE", number=436, offboard_hz=0.5, gcs_hz=0.5),
    StreamRow(name="VIBRATION", number=241, offboard_hz=0.5, gcs_hz=0.1),
    StreamRow(name="CURRENT_EVENT_SEQUENCE", number=411, offboard_hz=0.3, gcs_hz=0.35),
)
SILENT = {"STATUSTEXT": 253, "GPS_GLOBAL_ORIGIN": 49, "AUTOPILOT_VERSION": 148, "PARAM_VALUE": 22, "EVENT": 410}
ALL_PER_S = {"offboard": 427.0, "gcs": 371.0}
