"""What an autopilot takes for a parameter: names as MAVLink carries them, and the kinds of those that matter in flight.

PX4 refuses a PARAM_SET of the other kind, so `COM_OF_LOSS_T = 10` would never be set where `10.0` is. ArduCopter
stores whatever kind comes in its own, and needs no table.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from swarmctl.core.text import printable

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,15}")  # PARAM_SET.param_id has 16 characters
_INT32 = range(-(2**31), 2**31)
_REAL32_MAX = 3.4028235e38
_PX4_INTEGERS = """
    CBRK_FLIGHTTERM CBRK_IO_SAFETY CBRK_SUPPLY_CHK CBRK_USB_CHK COM_ARM_WO_GPS COM_DL_LOSS_T COM_HOME_IN_AIR
    COM_LOW_BAT_ACT COM_OBL_RC_ACT COM_POSCTL_NAVL COM_RCL_EXCEPT COM_RC_IN_MODE COM_RC_OVERRIDE COM_TAKEOFF_ACT
    EKF2_EV_CTRL EKF2_GPS_CHECK EKF2_GPS_CTRL EKF2_HGT_REF EKF2_MAG_TYPE GF_ACTION MAV_FWDEXTSP MAV_PROTO_VER
    MAV_SYS_ID MAV_TYPE MPC_POS_MODE MPC_THR_CURVE MPC_USE_HTE NAV_DLL_ACT NAV_RCL_ACT RTL_TYPE SYS_AUTOSTART
"""
_PX4_FLOATS = """
    BAT_CRIT_THR BAT_EMERGEN_THR BAT_LOW_THR COM_ARM_EKF_POS COM_ARM_EKF_VEL COM_DISARM_LAND COM_DISARM_PRFLT
    COM_FAIL_ACT_T COM_KILL_DISARM COM_OBC_LOSS_T COM_OF_LOSS_T COM_POS_FS_EPH COM_RC_LOSS_T COM_RC_STICK_OV
    COM_SPOOLUP_TIME EKF2_EV_DELAY EKF2_GPS_P_NOISE EKF2_GPS_V_NOISE EKF2_REQ_EPH EKF2_REQ_EPV GF_MAX_HOR_DIST
    GF_MAX_VER_DIST MC_PITCH_P MC_ROLL_P MC_YAW_P MIS_TAKEOFF_ALT MPC_ACC_HOR MPC_ACC_HOR_MAX MPC_LAND_SPEED
    MPC_THR_HOVER MPC_THR_MAX MPC_THR_MIN MPC_TILTMAX_AIR MPC_TILTMAX_LND MPC_TKO_RAMP_T MPC_TKO_SPEED MPC_XY_P
    MPC_XY_VEL_MAX MPC_Z_P MPC_Z_VEL_MAX_DN MPC_Z_VEL_MAX_UP RTL_DESCEND_ALT RTL_RETURN_ALT THR_MDL_FAC
"""
KINDS: Mapping[str, type[int] | type[float]] = {
    **dict.fromkeys(_PX4_INTEGERS.split(), int),
    **dict.fromkeys(_PX4_FLOATS.split(), float),
}


def parameter_problems(wanted: Mapping[str, int | float]) -> Iterator[str]:
    """Why parameters of `agent.autopilot_params` could not be set, one line each."""
    for name, value in wanted.items():
        key = f"agent.autopilot_params.{printable(name, 40)}"
        if not _NAME.fullmatch(name):
            yield f"{key}: no MAVLink parameter name; allowed: 1 to 16 letters, digits and _, the first a letter"
        elif isinstance(value, int) and value not in _INT32:
            yield f"{key} = {value}: an autopilot's integers have 32 bits; allowed: {_INT32[0]} to {_INT32[-1]}"
        elif abs(value) > _REAL32_MAX:
            yield f"{key} = {value}: an autopilot's floats have 32 bits; allowed: up to {_REAL32_MAX:g}"
        elif KINDS.get(name) is float and isinstance(value, int):
            yield f"{key} = {value}: PX4's {name} is a float and would not be set; write {value}.0"
        elif KINDS.get(name) is int and isinstance(value, float):
            yield f"{key} = {value}: PX4's {name} is an integer and would not be set; write {round(value)}"
