"""What a dialect is: everything in which an autopilot differs from others, selected by its HEARTBEAT.

Each module of this package beside holds the one of an autopilot. Commands are COMMAND_LONG unless they are parameters.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from swarmctl.core.types import Command, FlightMode, Verb
from swarmctl.mavlink.dialects.parameter_check import ParameterCheck

_INT32, _REAL32 = 6, 9  # MAV_PARAM_TYPE
CUSTOM_MODE = 1.0  # DO_SET_MODE p1: MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
LAST_INTEGER_TYPE = 8  # MAV_PARAM_TYPE_INT64; larger types are floats
_ARM, _TAKEOFF, LAND, SET_MODE, _INTERVAL, _REQUEST = 400, 22, 21, 176, 511, 512  # MAV_CMD
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
    """The differences between autopilots: a field without a default is one that nothing can be assumed for."""

    name: str
    number: int  # MAV_AUTOPILOT, as in HEARTBEAT.autopilot
    measured_version: tuple[int, int]  # version whose behaviour was measured
    sysid_parameter: str  # parameter of the system id
    mavlink2_setting: str  # what makes it send MAVLink 2
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
    checks: tuple[ParameterCheck, ...]  # what a check before the flight thinks of its parameters
    also_read: tuple[str, ...]  # parameters that these checks refer to
    fence_checks: tuple[ParameterCheck, ...]  # what it thinks besides with a geofence; empty: none is uploaded to it
    log_suffix: str  # of the logs that it writes itself
    loss_parameter: str  # parameter of the setpoint timeout [s]: until then the last attitude is flown
    landing_parameter: str  # parameter of the time [s] after which it brakes and lands when nothing comes any more
    restore_after_s: float = 0.0  # from a disarm that is heard; until then it may be saving its parameters
    heeds_parameter: str = ""  # system id whose heartbeats its link-loss failsafe counts; "": any

    def mode(self, custom_mode: int) -> FlightMode:
        """Return the mode of a HEARTBEAT or CURRENT_MODE."""
        return self.modes.get(custom_mode, FlightMode.MANUAL)

    def to_read(self) -> tuple[str, ...]:
        """Return the names of the parameters that an agent reads before flight."""
        takeoff = [self.takeoff_parameter] if self.takeoff_parameter else []
        rules, timeouts = [rule.name for rule in self.rules], (self.loss_parameter, self.landing_parameter)
        return tuple(dict.fromkeys([*rules, self.hover_parameter, *self.thrust_parameters, *takeoff, *timeouts]))

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
            Verb.EXTERNAL: LongCommand(SET_MODE, (CUSTOM_MODE, *self.external)),
            Verb.HOLD: LongCommand(SET_MODE, (CUSTOM_MODE, *self.hold)),
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
