"""Dialects of PX4 and ArduCopter: one table each of all their differences, selected by the HEARTBEAT.

Figures and rules are measured or read in their sources. Commands are COMMAND_LONG unless they are parameters.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from swarmctl.core.types import Command, FlightMode, Verb

_INT32, _REAL32 = 6, 9  # MAV_PARAM_TYPE
_CUSTOM_MODE = 1.0  # DO_SET_MODE p1: MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
LAST_INTEGER_TYPE = 8  # MAV_PARAM_TYPE_INT64; larger types are floats
_ARM, _TAKEOFF, _LAND, _SET_MODE, _INTERVAL, _REQUEST = 400, 22, 21, 176, 511, 512
_NAN = math.nan

SYS_STATUS, GPS_RAW_INT, ATTITUDE, ATTITUDE_QUATERNION, LOCAL_POSITION_NED, GLOBAL_POSITION_INT = 1, 24, 30, 31, 32, 33
GPS_GLOBAL_ORIGIN, ATTITUDE_TARGET, HIGHRES_IMU = 49, 83, 105
ESTIMATOR_STATUS, EXTENDED_SYS_STATE, ODOMETRY, CURRENT_MODE = 230, 245, 331, 436


@dataclass(frozen=True, slots=True)
class LongCommand:
    """A COMMAND_LONG: its id and first parameters; the remaining parameters are 0."""

    command: int
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Rule:
    """A parameter that must have a safe value before arming."""

    name: str
    holds: Callable[[float], bool]
    otherwise: str  # effect of a wrong value, and the fix

    def problem(self, value: float | None) -> str:
        """Return why this value forbids flight (None: the value could not be read), or ""."""
        if value is None:
            return f"{self.name} can't be read, and it decides what happens when setpoints stop or what they mean"
        return "" if self.holds(value) else f"{self.name} = {value:g}: {self.otherwise}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """The differences between autopilots."""

    name: str
    modes: Mapping[int, FlightMode]  # HEARTBEAT.custom_mode -> mode; an unlisted mode is flown by a pilot
    external: tuple[float, ...]  # DO_SET_MODE p2, p3 of the mode that follows setpoints
    hold: tuple[float, ...]
    land: LongCommand
    takeoff_parameter: str  # parameter of the take-off height; "": the height is NAV_TAKEOFF's p7
    arm_in: FlightMode | None  # mode required before arming and take-off; None: any mode that can be armed
    integers_bytewise: bool  # PARAM_* carries the bits of an int32 in its float; else the value
    state: tuple[int, ...]  # messages that carry the state, at the state rate
    rates_hz: Mapping[int, float]  # the other required messages
    rules: tuple[Rule, ...]
    given: Mapping[str, int | float]  # parameters that every flight sets unless configured otherwise
    hover_parameter: str
    thrust_parameters: tuple[str, ...]  # read and recorded: they define the meaning of thrust
    horizontal_accuracy: str  # message that reports it
    loss_parameter: str  # parameter of the setpoint timeout [s]
    heeds_parameter: str = ""  # system id whose heartbeats its link-loss failsafe counts; "": any

    def mode(self, custom_mode: int) -> FlightMode:
        """Return the mode of a HEARTBEAT or CURRENT_MODE."""
        return self.modes.get(custom_mode, FlightMode.MANUAL)

    def to_read(self) -> tuple[str, ...]:
        """Return the names of the parameters to read before flight."""
        return tuple(dict.fromkeys([*(r.name for r in self.rules), self.hover_parameter, *self.thrust_parameters]))

    def steps(self, command: Command) -> tuple[Command, ...]:
        """Return the commands that make up one request."""
        if command.verb is Verb.TAKEOFF and self.takeoff_parameter:
            return Command(verb=Verb.PARAM_FLOAT, value=command.value, name=self.takeoff_parameter), command
        return (command,)

    def long_command(self, command: Command) -> LongCommand | None:
        """Return the COMMAND_LONG of a command, or None for a parameter."""
        interval_us = 1e6 / command.value if command.value > 0 else -1.0
        height = (_NAN,) * 7 if self.takeoff_parameter else (0.0,) * 6 + (command.value,)
        table: dict[Verb, LongCommand] = {
            Verb.ARM: LongCommand(_ARM, (1.0,)),
            Verb.DISARM: LongCommand(_ARM, (0.0,)),
            Verb.TAKEOFF: LongCommand(_TAKEOFF, height),
            Verb.EXTERNAL: LongCommand(_SET_MODE, (_CUSTOM_MODE, *self.external)),
            Verb.HOLD: LongCommand(_SET_MODE, (_CUSTOM_MODE, *self.hold)),
            Verb.LAND: self.land,
            Verb.RATE: LongCommand(_INTERVAL, (float(command.number), interval_us)),
            Verb.MESSAGE: LongCommand(_REQUEST, (float(command.number),)),
        }
        return table.get(command.verb)

    def to_wire(self, command: Command) -> tuple[float, int]:
        """Return the value and MAV_PARAM_TYPE that PARAM_SET carries for PARAM_INT and PARAM_FLOAT."""
        if command.verb is not Verb.PARAM_INT:
            return float(struct.unpack("<f", struct.pack("<f", command.value))[0]), _REAL32
        if self.integers_bytewise:
            return float(struct.unpack("<f", struct.pack("<i", command.number))[0]), _INT32
        return float(struct.unpack("<f", struct.pack("<f", command.number))[0]), _INT32

    def from_wire(self, value: float, kind: int) -> float:
        """Return the number that a PARAM_VALUE carries."""
        if self.integers_bytewise and kind <= LAST_INTEGER_TYPE:
            return float(struct.unpack("<i", struct.pack("<f", value))[0])
        return value


def _px4(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


PX4 = Dialect(
    name="PX4",
    modes={
        _px4(4, 2): FlightMode.TAKEOFF,
        _px4(4, 3): FlightMode.HOLD,
        _px4(4, 4): FlightMode.MISSION,
        _px4(4, 5): FlightMode.RTL,
        _px4(4, 6): FlightMode.LAND,
        _px4(6): FlightMode.EXTERNAL,
    },
    external=(6.0, 0.0),
    hold=(4.0, 3.0),
    land=LongCommand(_LAND, (_NAN,) * 7),
    takeoff_parameter="MIS_TAKEOFF_ALT",
    arm_in=None,
    integers_bytewise=True,
    state=(ODOMETRY,),
    rates_hz={
        ATTITUDE_TARGET: 5.0,
        EXTENDED_SYS_STATE: 10.0,
        CURRENT_MODE: 50.0,  # interval at which PX4 looks for a change; it is sent at 2 Hz and on change
        ESTIMATOR_STATUS: 1.0,
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
    loss_parameter="COM_OF_LOSS_T",
)
ARDUCOPTER = Dialect(
    name="ArduCopter",
    modes={
        3: FlightMode.MISSION,
        4: FlightMode.EXTERNAL,
        5: FlightMode.HOLD,
        6: FlightMode.RTL,
        9: FlightMode.LAND,
        21: FlightMode.RTL,  # SMART_RTL
    },
    external=(4.0, 0.0),
    hold=(5.0, 0.0),
    land=LongCommand(_SET_MODE, (_CUSTOM_MODE, 9.0)),
    takeoff_parameter="",
    arm_in=FlightMode.EXTERNAL,
    integers_bytewise=False,
    state=(LOCAL_POSITION_NED, ATTITUDE_QUATERNION),
    rates_hz={
        SYS_STATUS: 5.0,
        EXTENDED_SYS_STATE: 10.0,
        ATTITUDE_TARGET: 5.0,
        GPS_RAW_INT: 1.0,
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
    loss_parameter="GUID_TIMEOUT",
    heeds_parameter="SYSID_MYGCS",
)
DIALECTS: Mapping[int, Dialect] = {12: PX4, 3: ARDUCOPTER}  # by HEARTBEAT.autopilot
