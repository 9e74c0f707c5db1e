"""Values of MAVLink's enums, by which also those parts judge a vehicle that must not load its codec."""

from __future__ import annotations

AUTOPILOT_COMPID = 1  # MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a companion, a ground station
GROUND_STATION = 6  # MAV_TYPE_GCS
ONBOARD_CONTROLLER = 18  # MAV_TYPE_ONBOARD_CONTROLLER
ACTIVE = 4  # MAV_STATE_ACTIVE
CRITICAL = 5  # MAV_STATE_CRITICAL: in this state and later ones a failsafe acts
ARMED_FLAG = 128  # MAV_MODE_FLAG_SAFETY_ARMED
RC_RECEIVER = 1 << 16  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER
PREARM_CHECK = 1 << 28  # MAV_SYS_STATUS_PREARM_CHECK
GPS_FIX_3D = 3  # GPS_FIX_TYPE_3D_FIX: this and more is a position
