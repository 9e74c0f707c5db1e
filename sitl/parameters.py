"""PX4 parameters of one vehicle: names, defaults, and the bytewise encoding that puts integers into a float field.

Only what this simulator uses, or clients commonly ask for. Values out of the documented range are accepted, as by PX4.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

INT32 = 6  # MAV_PARAM_TYPE
REAL32 = 9
_INT = struct.Struct("<i")
_FLOAT = struct.Struct("<f")

DEFAULTS: dict[str, int | float] = {
    "BAT1_N_CELLS": 4,
    "CBRK_SUPPLY_CHK": 894281,
    "COM_ARM_WO_GPS": 1,
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_DL_LOSS_T": 10,
    "COM_FAIL_ACT_T": 5.0,
    "COM_HOME_EN": 1,
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "COM_RCL_EXCEPT": 0,
    "COM_RC_IN_MODE": 1,
    "COM_SPOOLUP_TIME": 1.0,
    "IMU_INTEG_RATE": 250,
    "MAV_COMP_ID": 1,
    "MAV_FWDEXTSP": 1,
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "MC_PITCHRATE_MAX": 220.0,
    "MC_PITCH_P": 4.0,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_ROLL_P": 4.0,
    "MC_YAWRATE_MAX": 200.0,
    "MC_YAW_P": 2.8,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_LAND_SPEED": 0.7,
    "MPC_THR_HOVER": 0.5,
    "MPC_THR_MAX": 1.0,
    "MPC_THR_MIN": 0.12,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_XY_CRUISE": 5.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "NAV_ACC_RAD": 10.0,
    "NAV_DLL_ACT": 0,
    "NAV_RCL_ACT": 2,
    "RTL_RETURN_ALT": 30.0,
    "SYS_AUTOSTART": 10040,
    "THR_MDL_FAC": 0.0,
}


@dataclass(frozen=True, slots=True)
class WireValue:
    """A parameter as PARAM_VALUE carries it."""

    name: str
    value: float
    kind: int
    index: int


class UnknownParameterError(KeyError):
    """No parameter of that name."""


class WrongTypeError(TypeError):
    """PARAM_SET with another MAV_PARAM_TYPE than the parameter has."""


def int_to_wire(value: int) -> float:
    """Float whose bits are those of the int32."""
    wire: float = _FLOAT.unpack(_INT.pack(value))[0]
    return wire


def int_from_wire(value: float) -> int:
    """The int32 in a float's bits. A signalling NaN pattern does not survive Python's float; PX4 has none."""
    number: int = _INT.unpack(_FLOAT.pack(value))[0]
    return number


class Parameters:
    """The table of one vehicle; types are those of the defaults."""

    def __init__(self, sysid: int) -> None:
        self._values = dict(DEFAULTS)
        self._values["MAV_SYS_ID"] = sysid
        self._names = sorted(self._values)

    def __len__(self) -> int:
        return len(self._names)

    def real(self, name: str) -> float:
        """Value of a parameter as a number."""
        return float(self._values[name])

    def integer(self, name: str) -> int:
        """Value of an integer parameter."""
        return int(self._values[name])

    def assign(self, name: str, value: float) -> None:
        """Set a parameter in this process, without the wire.

        Raises:
            UnknownParameterError: no such name.
        """
        kind = type(self._values[self._known(name)])
        self._values[name] = kind(value)

    def by_name(self, name: str) -> WireValue:
        """Raises `UnknownParameterError`."""
        return self.by_index(self._names.index(self._known(name)))

    def by_index(self, index: int) -> WireValue:
        """Raises `UnknownParameterError` outside the table."""
        if not 0 <= index < len(self._names):
            raise UnknownParameterError(str(index))
        name = self._names[index]
        value = self._values[name]
        if isinstance(value, int):
            return WireValue(name, int_to_wire(value), INT32, index)
        return WireValue(name, value, REAL32, index)

    def set_from_wire(self, name: str, value: float, kind: int) -> WireValue:
        """Apply a PARAM_SET and return what is stored now; a non-finite float is not stored.

        Raises:
            UnknownParameterError: no such name.
            WrongTypeError: `kind` is not the parameter's type.
        """
        is_int = isinstance(self._values[self._known(name)], int)
        if kind != (INT32 if is_int else REAL32):
            raise WrongTypeError(name)
        if is_int:
            self._values[name] = int_from_wire(value)
        elif math.isfinite(value):
            self._values[name] = value
        return self.by_name(name)

    def _known(self, name: str) -> str:
        if name not in self._values:
            raise UnknownParameterError(name)
        return name
