"""The dialect of ArduCopter. Figures and rules are measured or read in its sources."""

from __future__ import annotations

import math

from swarmctl.core.types import FlightMode
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.dialect import (
    ATTITUDE_QUATERNION,
    ATTITUDE_TARGET,
    CUSTOM_MODE,
    EXTENDED_SYS_STATE,
    GLOBAL_POSITION_INT,
    GPS_RAW_INT,
    LOCAL_POSITION_NED,
    SET_MODE,
    SYS_STATUS,
    Dialect,
    LongCommand,
    Rule,
)
from swarmctl.mavlink.dialects.parameter_check import (
    Opinion,
    ParameterCheck,
    ParameterContext,
    assess_hover,
    assess_own_sysid,
    ok,
)

_GUIDED_SILENCE_S = 1.0
_LAND_WITHOUT_STATION = 5  # FS_GCS_ENABLE


def _guided_options(value: float, seen: ParameterContext) -> Opinion:
    if int(value) & 8:
        return ok("bit 3, thrust as thrust")
    advice = "thrust would be flown as a climb rate; set bit 3"
    return Opinion(verdict=Verdict.FIX, wanted="bit 3, thrust as thrust", advice=advice, to_set=int(value) | 8)


def _guided_timeout(value: float, seen: ParameterContext) -> Opinion:
    wanted = f"at most {_GUIDED_SILENCE_S:g} s"
    if 0 < value <= _GUIDED_SILENCE_S:
        return ok(wanted)
    why = "for that long the last attitude is flown when setpoints stop"
    return Opinion(
        verdict=Verdict.NOTE, wanted=wanted, advice=f"{why}; set {_GUIDED_SILENCE_S:g}", to_set=_GUIDED_SILENCE_S
    )


def _ground_station_failsafe(value: float, seen: ParameterContext) -> Opinion:
    if value == _LAND_WITHOUT_STATION:
        return ok("5, land")
    return Opinion(
        verdict=Verdict.FIX,
        wanted="5, land",
        advice="without its agent it would drift on for ever",
        to_set=_LAND_WITHOUT_STATION,
    )


def _throttle_failsafe(value: float, seen: ParameterContext) -> Opinion:
    if value == 0 or seen.has_radio:
        return ok("0, or a radio")
    return Opinion(
        verdict=Verdict.NOTE,
        wanted="0, or a radio",
        advice="no radio is seen: arming is refused, or its loss ends GUIDED",
    )


def _ekf_failsafe(value: float, seen: ParameterContext) -> Opinion:
    if value in (1, 3):
        return ok("1 or 3, land")
    return Opinion(
        verdict=Verdict.NOTE, wanted="1 or 3, land", advice="a diverging estimator does not land the vehicle"
    )


def _arming_check(value: float, seen: ParameterContext) -> Opinion:
    if value != 0:
        return ok("1, all")
    return Opinion(verdict=Verdict.NOTE, wanted="1, all", advice="nothing is checked before arming")


def _angle_max(value: float, seen: ParameterContext) -> Opinion:
    least = math.degrees(seen.tilt_max_rad) * 100
    wanted = f"at least {least:.0f} ({seen.model_key}.tilt_max_rad)"
    if value >= least - 1:
        return ok(wanted)
    lower = math.floor(math.radians(value / 100) * 100) / 100
    return Opinion(
        verdict=Verdict.NOTE,
        wanted=wanted,
        advice=f"the autopilot clips; set {seen.model_key}.tilt_max_rad = {lower:g} or raise it",
    )


ARDUCOPTER = Dialect(
    name="ArduCopter",
    number=3,
    measured_version=(4, 6),
    sysid_parameter="SYSID_THISMAV",
    mavlink2_setting="SERIALx_PROTOCOL = 2",
    modes={
        3: FlightMode.MISSION,
        4: FlightMode.EXTERNAL,
        5: FlightMode.HOLD,  # LOITER
        6: FlightMode.RTL,
        9: FlightMode.LAND,
        17: FlightMode.HOLD,  # BRAKE
        21: FlightMode.RTL,  # SMART_RTL
    },
    external=(4.0, 0.0),
    hold=(17.0, 0.0),  # BRAKE; in LOITER a throttle stick that is down lands the vehicle
    land=LongCommand(SET_MODE, (CUSTOM_MODE, 9.0)),
    takeoff_parameter="",
    arm_in=FlightMode.EXTERNAL,
    integers_bytewise=False,
    state=(LOCAL_POSITION_NED, ATTITUDE_QUATERNION),
    rates_hz={
        SYS_STATUS: 5.0,
        EXTENDED_SYS_STATE: 10.0,
        ATTITUDE_TARGET: 5.0,
        GPS_RAW_INT: 5.0,  # a missing fix is seen by it first: its EKF lands 8 s later
        GLOBAL_POSITION_INT: 2.0,
    },
    rules=(
        Rule(
            "GUID_OPTIONS",
            lambda v: bool(int(v) & 8),
            "thrust would be flown as a climb rate; set agent.autopilot_params.GUID_OPTIONS = 8 (bit 3)",
        ),
        Rule(
            "GUID_TIMEOUT",
            lambda v: 0.0 < v <= 5.0,
            "so long the last attitude is flown when setpoints stop; set agent.autopilot_params.GUID_TIMEOUT = 1.0",
        ),
        Rule(
            "FS_GCS_ENABLE",
            lambda v: v == 5,
            "without its agent it would drift on for ever; set agent.autopilot_params.FS_GCS_ENABLE = 5 (land)",
        ),
        Rule(
            "FS_GCS_TIMEOUT",
            lambda v: 0.0 < v <= 5.0,
            "so long it drifts before it lands without its agent; set agent.autopilot_params.FS_GCS_TIMEOUT = 2.0",
        ),
        Rule(
            "ATC_ANGLE_BOOST",
            lambda v: v == 0,
            "thrust is planned for the tilt already; set agent.autopilot_params.ATC_ANGLE_BOOST = 0",
        ),
    ),
    given={},
    hover_parameter="MOT_THST_HOVER",
    thrust_parameters=("MOT_THST_EXPO", "MOT_SPIN_ARM", "MOT_SPIN_MIN", "MOT_SPIN_MAX"),
    horizontal_accuracy="GPS_RAW_INT",  # its EKF reports test ratios, not metres
    checks=(
        ParameterCheck("GUID_OPTIONS", "what thrust means", _guided_options),
        ParameterCheck("GUID_TIMEOUT", "how long the last attitude is flown when setpoints stop", _guided_timeout),
        ParameterCheck("FS_GCS_ENABLE", "what happens when the agent's heartbeats stop", _ground_station_failsafe),
        ParameterCheck("FS_THR_ENABLE", "whether a lost radio ends GUIDED", _throttle_failsafe),
        ParameterCheck("FS_EKF_ACTION", "what happens when the estimator diverges", _ekf_failsafe),
        ParameterCheck("ARMING_CHECK", "what is checked before arming", _arming_check),
        ParameterCheck("ANGLE_MAX", "how far it tilts", _angle_max),
        ParameterCheck("MOT_THST_HOVER", "what hovers", assess_hover),
        ParameterCheck("SYSID_THISMAV", "its system id after the next boot", assess_own_sysid),
    ),
    also_read=(),
    fence_checks=(),
    log_suffix=".bin",
    loss_parameter="GUID_TIMEOUT",
    landing_parameter="FS_GCS_TIMEOUT",
    heeds_parameter="SYSID_MYGCS",
)
