"""The dialect of PX4. Figures and rules are measured or read in its sources."""

from __future__ import annotations

import math

from swarmctl.core.types import FlightMode
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.dialects.dialect import (
    ATTITUDE,
    ATTITUDE_QUATERNION,
    ATTITUDE_TARGET,
    CURRENT_MODE,
    ESTIMATOR_STATUS,
    EXTENDED_SYS_STATE,
    GLOBAL_POSITION_INT,
    HIGHRES_IMU,
    LAND,
    ODOMETRY,
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

_OFFBOARD_EXCEPTED = 4  # COM_RCL_EXCEPT bit 2
_STICKS_NOT_BY_RADIO = (1, 4)  # COM_RC_IN_MODE: joystick only, disabled
_FENCE_ACTIONS = (2, 5)  # GF_ACTION


def _offboard_loss(value: float, seen: ParameterContext) -> Opinion:
    if value in (4, 5):
        return ok("4 land, 5 hold")
    meet = "the way home is not kept clear of the others"
    return Opinion(
        verdict=Verdict.NOTE,
        wanted="4 land, 5 hold",
        advice=f"when setpoints stop the vehicle returns, and {meet}; 4 lands",
    )


def _offboard_timeout(value: float, seen: ParameterContext) -> Opinion:
    wanted = "0.2 to 1.0 s"
    if value > 1.0:
        why = "for that long the last attitude is flown when setpoints stop"
        return Opinion(verdict=Verdict.FIX, wanted=wanted, advice=f"{why}; set 1.0", to_set=1.0)
    if value < 0.2:
        return Opinion(
            verdict=Verdict.FIX, wanted=wanted, advice="a few late setpoints would end offboard; set 0.5", to_set=0.5
        )
    return ok(wanted)


def _forward_setpoints(value: float, seen: ParameterContext) -> Opinion:
    if value == 1:
        return ok("1")
    return Opinion(verdict=Verdict.FIX, wanted="1", advice="setpoints over MAVLink are not flown; set 1", to_set=1)


def _radio_exception(value: float, seen: ParameterContext) -> Opinion:
    source = seen.number("COM_RC_IN_MODE")
    if source is None or source in _STICKS_NOT_BY_RADIO:
        return ok("any, no radio is expected")
    if seen.has_radio:
        return ok("any, the radio is there")
    if int(value) & _OFFBOARD_EXCEPTED:
        return ok("bit 2, offboard")
    action = seen.number("NAV_RCL_ACT")
    told = "" if action is None else f" (NAV_RCL_ACT = {action:g})"
    return Opinion(
        verdict=Verdict.FIX,
        wanted="bit 2, offboard",
        advice=f"a radio is expected (COM_RC_IN_MODE = {source:g}) and none is there: its loss ends offboard{told}; "
        "switch it on, or except offboard",
        to_set=int(value) | _OFFBOARD_EXCEPTED,
    )


def _radio_source(value: float, seen: ParameterContext) -> Opinion:
    return ok("as the pilot flies; 4 without any")


def _thrust_model(value: float, seen: ParameterContext) -> Opinion:
    if value == 0 and seen.is_board:  # simulators have no such circuit
        return Opinion(
            verdict=Verdict.NOTE,
            wanted="0.2 to 0.5",
            advice="thrust is taken as linear, real propellers are not: calibrate it to hover well",
        )
    return ok("0 simulated, 0.2 to 0.5 real")


def _fence_action(value: float, seen: ParameterContext) -> Opinion:
    if value in _FENCE_ACTIONS:
        return ok("2 hold, 5 land")
    advice = "at the fence it would warn only, return through the others, or stop its motors; set 2"
    return Opinion(verdict=Verdict.FIX, wanted="2 hold, 5 land", advice=advice, to_set=2)


def _mode(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


PX4 = Dialect(
    name="PX4",
    number=12,
    measured_version=(1, 18),
    sysid_parameter="MAV_SYS_ID",
    mavlink2_setting="MAV_PROTO_VER = 2",
    modes={
        _mode(4, 2): FlightMode.TAKEOFF,
        _mode(4, 3): FlightMode.HOLD,
        _mode(4, 4): FlightMode.MISSION,
        _mode(4, 5): FlightMode.RTL,
        _mode(4, 6): FlightMode.LAND,
        _mode(6): FlightMode.EXTERNAL,
    },
    external=(6.0, 0.0),
    hold=(4.0, 3.0),
    land=LongCommand(LAND, (math.nan,) * 7),
    takeoff_parameter="MIS_TAKEOFF_ALT",
    arm_in=None,
    integers_bytewise=True,
    state=(ODOMETRY,),
    rates_hz={
        ATTITUDE_TARGET: 5.0,
        EXTENDED_SYS_STATE: 10.0,
        CURRENT_MODE: 50.0,  # interval at which PX4 looks for a change; it is sent at 2 Hz and on change
        ESTIMATOR_STATUS: 1.0,  # flags and accuracy: by them a lost position is seen
        ATTITUDE: 2.0,  # these four default to 50 to 100 Hz, half of all decoded frames, and are not used
        ATTITUDE_QUATERNION: 2.0,
        HIGHRES_IMU: 2.0,
        GLOBAL_POSITION_INT: 2.0,
    },
    rules=(
        Rule(
            "COM_OBL_RC_ACT",
            lambda v: 0 <= v <= 5,
            "motors would stop in the air when setpoints do; set agent.autopilot_params.COM_OBL_RC_ACT = 4 (land)",
        ),
        Rule(
            "NAV_DLL_ACT",
            lambda v: v in (2, 3),
            "a vehicle whose agent dies before OFFBOARD would hover for ever; "
            "set agent.autopilot_params.NAV_DLL_ACT = 3 (land)",
        ),
        Rule(
            "COM_DL_LOSS_T",
            lambda v: 0 < v <= 30,
            "so long a vehicle whose agent died before OFFBOARD hovers; set agent.autopilot_params.COM_DL_LOSS_T = 5",
        ),
    ),
    given={"NAV_DLL_ACT": 3, "COM_DL_LOSS_T": 5},  # land when the agent's heartbeats stop before OFFBOARD
    hover_parameter="MPC_THR_HOVER",
    thrust_parameters=("THR_MDL_FAC", "MPC_THR_MIN", "MPC_THR_MAX"),
    horizontal_accuracy="ESTIMATOR_STATUS",
    checks=(
        ParameterCheck("COM_OBL_RC_ACT", "what happens when setpoints stop", _offboard_loss),
        ParameterCheck("COM_OF_LOSS_T", "how long the last attitude is flown when setpoints stop", _offboard_timeout),
        ParameterCheck("MAV_FWDEXTSP", "whether setpoints are flown", _forward_setpoints),
        ParameterCheck("COM_RCL_EXCEPT", "whether a lost radio ends offboard", _radio_exception),
        ParameterCheck("COM_RC_IN_MODE", "where sticks come from", _radio_source),
        ParameterCheck("MPC_THR_HOVER", "what hovers", assess_hover),
        ParameterCheck("THR_MDL_FAC", "how thrust becomes motor speed", _thrust_model),
        ParameterCheck("MAV_SYS_ID", "its system id after the next boot", assess_own_sysid),
    ),
    also_read=("NAV_RCL_ACT",),
    fence_checks=(ParameterCheck("GF_ACTION", "what happens at the geofence", _fence_action),),
    log_suffix=".ulg",
    loss_parameter="COM_OF_LOSS_T",
    landing_parameter="COM_OF_LOSS_T",
    restore_after_s=1.0,  # it saves 0.3 s after a disarm; one that is set while it verifies the file can stop it
)
