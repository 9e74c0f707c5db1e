"""ArduCopter parameters of one vehicle: names, defaults, and integers cast to float in MAVLink (C-cast).

Only what this simulator uses, or clients commonly request. Decoding them bytewise, as for PX4, reads 1 as 1065353216.
"""

from __future__ import annotations

import math

from sitl.parameter_values import UnknownParameterError, WireValue

INT8, INT16, INT32, REAL32 = 2, 4, 6, 9  # MAV_PARAM_TYPE
_RANGES = {INT8: 1 << 7, INT16: 1 << 15, INT32: 1 << 31}
INDEX_NOT_TOLD = 65535  # param_index of answers to a name

DEFAULTS: dict[str, tuple[int, float]] = {  # name -> MAV_PARAM_TYPE, value
    "ANGLE_MAX": (INT16, 3000),  # cdeg
    "ARMING_CHECK": (INT32, 1),
    "ATC_ACCEL_P_MAX": (REAL32, 110000.0),  # cdeg/s2
    "ATC_ACCEL_R_MAX": (REAL32, 110000.0),
    "ATC_ACCEL_Y_MAX": (REAL32, 27000.0),
    "ATC_ANGLE_BOOST": (INT8, 1),
    "ATC_ANG_PIT_P": (REAL32, 4.5),
    "ATC_ANG_RLL_P": (REAL32, 4.5),
    "ATC_ANG_YAW_P": (REAL32, 4.5),
    "ATC_INPUT_TC": (REAL32, 0.15),
    "BATT_CAPACITY": (INT32, 3300),
    "BATT_MONITOR": (INT8, 4),
    "BRD_BOOT_DELAY": (INT16, 0),
    "DISARM_DELAY": (INT8, 10),  # s
    "EK3_ENABLE": (INT8, 1),
    "FENCE_ENABLE": (INT8, 0),
    "FRAME_CLASS": (INT8, 1),
    "FRAME_TYPE": (INT8, 0),
    "FS_EKF_ACTION": (INT8, 1),
    "FS_EKF_THRESH": (REAL32, 0.8),
    "FS_GCS_ENABLE": (INT8, 0),
    "FS_GCS_TIMEOUT": (REAL32, 5.0),  # s
    "FS_THR_ENABLE": (INT8, 1),
    "GUID_OPTIONS": (INT32, 0),
    "GUID_TIMEOUT": (REAL32, 3.0),  # s
    "LAND_ALT_LOW": (REAL32, 1000.0),  # cm
    "LAND_SPEED": (INT16, 50),  # cm/s
    "LAND_SPEED_HIGH": (INT16, 0),  # 0: WPNAV_SPEED_DN
    "LOIT_BRK_ACCEL": (REAL32, 250.0),  # cm/s2
    "MOT_SPIN_ARM": (REAL32, 0.1),
    "MOT_SPIN_MAX": (REAL32, 0.95),
    "MOT_SPIN_MIN": (REAL32, 0.15),
    "MOT_SPOOL_TIME": (REAL32, 0.5),  # s
    "MOT_THST_EXPO": (REAL32, 0.65),
    "MOT_THST_HOVER": (REAL32, 0.39),
    "PSC_POSXY_P": (REAL32, 1.0),
    "PSC_POSZ_P": (REAL32, 1.0),
    "PSC_VELXY_I": (REAL32, 1.0),
    "PSC_VELXY_P": (REAL32, 2.0),
    "PSC_VELZ_P": (REAL32, 5.0),
    "RTL_ALT": (INT32, 1500),  # cm
    "RTL_CONE_SLOPE": (REAL32, 3.0),
    "RTL_LOIT_TIME": (INT32, 5000),  # ms
    "SCHED_LOOP_RATE": (INT16, 400),
    "SERIAL0_PROTOCOL": (INT8, 2),
    "SR0_EXTRA1": (INT16, 0),
    "SR0_EXTRA2": (INT16, 0),
    "SR0_EXTRA3": (INT16, 0),
    "SR0_EXT_STAT": (INT16, 0),
    "SR0_POSITION": (INT16, 0),
    "SR0_RAW_SENS": (INT16, 0),
    "SR0_RC_CHAN": (INT16, 0),
    "SYSID_MYGCS": (INT16, 255),
    "SYSID_THISMAV": (INT16, 1),
    "WPNAV_ACCEL": (REAL32, 250.0),  # cm/s2
    "WPNAV_ACCEL_Z": (REAL32, 100.0),
    "WPNAV_SPEED": (REAL32, 1000.0),  # cm/s
    "WPNAV_SPEED_DN": (REAL32, 150.0),
    "WPNAV_SPEED_UP": (REAL32, 250.0),
}


class CopterParameters:
    """The parameters of one vehicle. Values out of the documented range are stored, as by ArduCopter."""

    def __init__(self, sysid: int) -> None:
        self._values = {name: value for name, (_, value) in DEFAULTS.items()}
        self._values["SYSID_THISMAV"] = sysid
        self._names = sorted(self._values)

    def __len__(self) -> int:
        return len(self._names)

    def real(self, name: str) -> float:
        """Return a parameter as a real number."""
        return float(self._values[name])

    def metres(self, name: str) -> float:
        """Return a parameter in cm, cm/s or cm/s2 in metres."""
        return 0.01 * float(self._values[name])

    def integer(self, name: str) -> int:
        """Return an integer parameter."""
        return int(self._values[name])

    def assign(self, name: str, value: float) -> None:
        """Set a parameter, rounded and limited to its type; a value that is not finite is not stored.

        Raises:
            UnknownParameterError: no such name.
        """
        if name not in self._values:
            raise UnknownParameterError(name)
        if not math.isfinite(value):
            return
        kind = DEFAULTS[name][0]
        if kind == REAL32:
            self._values[name] = value
        else:
            limit = _RANGES[kind]
            self._values[name] = max(-limit, min(limit - 1, round(value)))

    def by_name(self, name: str) -> WireValue:
        """Return a parameter by name; raises `UnknownParameterError`."""
        if name not in self._values:
            raise UnknownParameterError(name)
        return WireValue(name=name, value=float(self._values[name]), kind=DEFAULTS[name][0], index=INDEX_NOT_TOLD)

    def by_index(self, index: int) -> WireValue:
        """Return a parameter by index; raises `UnknownParameterError` outside the table."""
        if not 0 <= index < len(self._names):
            raise UnknownParameterError(str(index))
        name = self._names[index]
        return WireValue(name=name, value=float(self._values[name]), kind=DEFAULTS[name][0], index=index)
