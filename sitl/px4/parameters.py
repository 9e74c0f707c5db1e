"""PX4 parameters of one vehicle: names, defaults, and the bytewise encoding of integers in a float field.

The table holds what this simulator uses and what clients commonly request of a multicopter. Values out of the
documented range are accepted, as by PX4.
"""

from __future__ import annotations

import math
import struct
import zlib

from sitl.parameter_values import UnknownParameterError, WireValue

INT32 = 6  # MAV_PARAM_TYPE
REAL32 = 9
_INT = struct.Struct("<i")
_FLOAT = struct.Struct("<f")

_TABLE = """
BAT1_CAPACITY=-1.0 BAT1_N_CELLS=4 BAT1_R_INTERNAL=-1.0 BAT1_SOURCE=0 BAT1_V_CHARGED=4.05 BAT1_V_EMPTY=3.6
BAT_AVRG_CURRENT=15.0 BAT_CRIT_THR=0.07 BAT_EMERGEN_THR=0.05 BAT_LOW_THR=0.15 CAL_ACC0_PRIO=50 CAL_GYRO0_PRIO=50
CAL_MAG0_PRIO=75 CAL_MAG_SIDES=63 CBRK_BUZZER=0 CBRK_FLIGHTTERM=121212 CBRK_IO_SAFETY=22027 CBRK_SUPPLY_CHK=0
CBRK_USB_CHK=197848 COM_ARM_BAT_MIN=0.0 COM_ARM_EKF_HGT=1.0 COM_ARM_EKF_POS=0.5 COM_ARM_EKF_VEL=0.5
COM_ARM_EKF_YAW=0.5 COM_ARM_IMU_ACC=0.7 COM_ARM_IMU_GYR=0.25 COM_ARM_MAG_ANG=60 COM_ARM_MIS_REQ=0 COM_ARM_ODID=0
COM_ARM_SDCARD=1 COM_ARM_SWISBTN=0 COM_ARM_WO_GPS=1 COM_CPU_MAX=-1.0 COM_DISARM_LAND=2.0 COM_DISARM_MAN=1
COM_DISARM_PRFLT=10.0 COM_DL_LOSS_T=10 COM_FAIL_ACT_T=5.0 COM_FLIGHT_UUID=0 COM_FLTMODE1=-1 COM_FLTMODE2=-1
COM_FLTMODE3=-1 COM_FLTMODE4=-1 COM_FLTMODE5=-1 COM_FLTMODE6=-1 COM_FLT_TIME_MAX=-1 COM_FORCE_SAFETY=0
COM_HLDL_LOSS_T=120 COM_HLDL_REG_T=0 COM_HOME_EN=1 COM_HOME_IN_AIR=0 COM_IMB_PROP_ACT=0 COM_KILL_DISARM=5.0
COM_LKDOWN_TKO=3.0 COM_LOW_BAT_ACT=0 COM_MOT_TEST_EN=1 COM_OBC_LOSS_T=5.0 COM_OBL_RC_ACT=0 COM_OBS_AVOID=0
COM_OF_LOSS_T=1.0 COM_PARACHUTE=0 COM_POSCTL_NAVL=0 COM_POS_FS_EPH=5.0 COM_POS_LOW_ACT=3 COM_POS_LOW_EPH=-1.0
COM_POWER_COUNT=1 COM_PREARM_MODE=0 COM_QC_ACT=0 COM_RCL_EXCEPT=0 COM_RC_IN_MODE=1 COM_RC_LOSS_T=0.5
COM_RC_OVERRIDE=1 COM_RC_STICK_OV=30.0 COM_SPOOLUP_TIME=1.0 COM_TAKEOFF_ACT=0 COM_THROW_EN=0 COM_VEL_FS_EVH=1.0
COM_WIND_MAX=-1.0 COM_WIND_MAX_ACT=0 COM_WIND_WARN=-1.0 EKF2_AID_MASK=1 EKF2_ASP_DELAY=100.0 EKF2_BARO_CTRL=1
EKF2_BARO_NOISE=3.5 EKF2_DELAY_MAX=200.0 EKF2_DRAG_CTRL=0 EKF2_EN=1 EKF2_EV_CTRL=0 EKF2_EV_DELAY=5.0
EKF2_EV_NOISE_MD=0 EKF2_GPS_CHECK=1023 EKF2_GPS_CTRL=7 EKF2_GPS_DELAY=110.0 EKF2_GPS_P_NOISE=0.5
EKF2_GPS_V_NOISE=0.3 EKF2_HGT_REF=1 EKF2_MAG_DECL=0.0 EKF2_MAG_TYPE=0 EKF2_NOAID_TOUT=5000000 EKF2_OF_CTRL=1
EKF2_REQ_EPH=3.0 EKF2_REQ_EPV=5.0 EKF2_REQ_NSATS=6 EKF2_RNG_CTRL=1 EKF2_TAU_POS=0.25 EKF2_TAU_VEL=0.25 FD_ESCS_EN=0
FD_FAIL_P=60 FD_FAIL_P_TTRI=0.3 FD_FAIL_R=60 FD_FAIL_R_TTRI=0.3 FD_IMB_PROP_THR=30 GF_ACTION=2 GF_MAX_HOR_DIST=0.0
GF_MAX_VER_DIST=0.0 GF_PREDICT=0 GF_SOURCE=0 IMU_ACCEL_CUTOFF=30.0 IMU_DGYRO_CUTOFF=30.0 IMU_GYRO_CUTOFF=40.0
IMU_GYRO_RATEMAX=400 IMU_INTEG_RATE=250 LNDMC_ALT_GND=2.0 LNDMC_ROT_MAX=20.0 LNDMC_TRIG_TIME=1.0
LNDMC_XY_VEL_MAX=1.5 LNDMC_Z_VEL_MAX=0.25 MAV_0_BROADCAST=0 MAV_0_CONFIG=101 MAV_0_FORWARD=1 MAV_0_MODE=0
MAV_0_RATE=1200 MAV_COMP_ID=1 MAV_FWDEXTSP=1 MAV_HASH_CHK_EN=1 MAV_HB_FORW_EN=1 MAV_PROTO_VER=0 MAV_SIK_RADIO_ID=0
MAV_SYS_ID=1 MAV_TYPE=2 MAV_USEHILGPS=0 MC_ACRO_P_MAX=100.0 MC_ACRO_R_MAX=100.0 MC_ACRO_Y_MAX=100.0 MC_AIRMODE=0
MC_BAT_SCALE_EN=0 MC_MAN_TILT_TAU=0.0 MC_ORBIT_RAD_MAX=1000.0 MC_PITCHRATE_D=0.003 MC_PITCHRATE_FF=0.0
MC_PITCHRATE_I=0.2 MC_PITCHRATE_K=1.0 MC_PITCHRATE_MAX=220.0 MC_PITCHRATE_P=0.15 MC_PITCH_P=4.0 MC_PR_INT_LIM=0.3
MC_REF_W_N=50.0 MC_ROLLRATE_D=0.003 MC_ROLLRATE_FF=0.0 MC_ROLLRATE_I=0.2 MC_ROLLRATE_K=1.0 MC_ROLLRATE_MAX=220.0
MC_ROLLRATE_P=0.15 MC_ROLL_P=4.0 MC_RR_INT_LIM=0.3 MC_YAWRATE_D=0.0 MC_YAWRATE_FF=0.0 MC_YAWRATE_I=0.1
MC_YAWRATE_K=1.0 MC_YAWRATE_MAX=200.0 MC_YAWRATE_P=0.2 MC_YAW_P=2.8 MC_YAW_WEIGHT=0.4 MC_YR_INT_LIM=0.3
MIS_DIST_1WP=10000.0 MIS_LKDOWN_ENABLE=0 MIS_MNT_YAW_CTL=0 MIS_TAKEOFF_ALT=2.5 MIS_TAKEOFF_REQ=0 MIS_TKO_LAND_REQ=0
MIS_YAW_ERR=12.0 MIS_YAW_TMT=-1.0 MPC_ACC_DOWN_MAX=3.0 MPC_ACC_HOR=3.0 MPC_ACC_HOR_MAX=5.0 MPC_ACC_UP_MAX=4.0
MPC_ALT_MODE=2 MPC_HOLD_DZ=0.1 MPC_HOLD_MAX_XY=0.8 MPC_HOLD_MAX_Z=0.6 MPC_JERK_AUTO=4.0 MPC_JERK_MAX=8.0
MPC_LAND_ALT1=10.0 MPC_LAND_ALT2=5.0 MPC_LAND_ALT3=1.0 MPC_LAND_CRWL=0.3 MPC_LAND_RC_HELP=0 MPC_LAND_SPEED=0.7
MPC_MANTHR_MIN=0.08 MPC_MAN_TILT_MAX=35.0 MPC_MAN_Y_MAX=150.0 MPC_POS_MODE=4 MPC_THR_CURVE=0 MPC_THR_HOVER=0.5
MPC_THR_MAX=1.0 MPC_THR_MIN=0.12 MPC_THR_XY_MARG=0.3 MPC_TILTMAX_AIR=45.0 MPC_TILTMAX_LND=12.0 MPC_TKO_RAMP_T=3.0
MPC_TKO_SPEED=1.5 MPC_USE_HTE=1 MPC_VELD_LP=5.0 MPC_VEL_MANUAL=10.0 MPC_XY_CRUISE=5.0 MPC_XY_ERR_MAX=2.0
MPC_XY_P=0.95 MPC_XY_TRAJ_P=0.5 MPC_XY_VEL_ALL=-10.0 MPC_XY_VEL_D_ACC=0.2 MPC_XY_VEL_I_ACC=0.4 MPC_XY_VEL_MAX=12.0
MPC_XY_VEL_P_ACC=1.8 MPC_YAWRAUTO_MAX=60.0 MPC_YAW_EXPO=0.6 MPC_YAW_MODE=0 MPC_Z_P=1.0 MPC_Z_VEL_ALL=-3.0
MPC_Z_VEL_D_ACC=0.0 MPC_Z_VEL_I_ACC=2.0 MPC_Z_VEL_MAX_DN=1.5 MPC_Z_VEL_MAX_UP=3.0 MPC_Z_VEL_P_ACC=4.0
MPC_Z_V_AUTO_DN=1.5 MPC_Z_V_AUTO_UP=3.0 NAV_ACC_RAD=2.0 NAV_DLL_ACT=0 NAV_FORCE_VT=1 NAV_LOITER_RAD=80.0
NAV_MC_ALT_RAD=0.8 NAV_RCL_ACT=2 NAV_TRAFF_AVOID=1 RC_CHAN_CNT=0 RC_MAP_PITCH=0 RC_MAP_ROLL=0 RC_MAP_THROTTLE=0
RC_MAP_YAW=0 RTL_APPR_FORCE=0 RTL_CONE_ANG=45 RTL_DESCEND_ALT=30.0 RTL_LAND_DELAY=0.0 RTL_MIN_DIST=10.0 RTL_PLD_MD=0
RTL_RETURN_ALT=30.0 RTL_TIME_FACTOR=1.1 RTL_TYPE=0 SDLOG_BOOT_BAT=0 SDLOG_DIRS_MAX=0 SDLOG_MISSION=0 SDLOG_MODE=0
SDLOG_PROFILE=131 SDLOG_UTC_OFFSET=0 SDLOG_UUID=1 SENS_BARO_QNH=1013.25 SENS_BOARD_ROT=0 SENS_BOARD_X_OFF=0.0
SENS_BOARD_Y_OFF=0.0 SENS_BOARD_Z_OFF=0.0 SENS_GPS_MASK=7 SENS_IMU_MODE=1 SENS_MAG_MODE=1 SIH_DISTSNSR_MAX=100.0
SIH_DISTSNSR_MIN=0.0 SIH_DISTSNSR_OVR=-1.0 SIH_IXX=0.025 SIH_IXY=0.0 SIH_IXZ=0.0 SIH_IYY=0.025 SIH_IYZ=0.0
SIH_IZZ=0.03 SIH_KDV=1.0 SIH_KDW=0.025 SIH_LOC_H0=489.4 SIH_LOC_LAT0=47.397742 SIH_LOC_LON0=8.545594 SIH_L_PITCH=0.2
SIH_L_ROLL=0.2 SIH_MASS=1.0 SIH_Q_MAX=0.1 SIH_T_MAX=5.0 SIH_T_TAU=0.05 SIH_VEHICLE_TYPE=0 SYS_AUTOCONFIG=0
SYS_AUTOSTART=10040 SYS_CAL_ACCEL=0 SYS_CAL_BARO=0 SYS_CAL_GYRO=0 SYS_CAL_TDEL=24 SYS_FAILURE_EN=0 SYS_HAS_BARO=1
SYS_HAS_GPS=1 SYS_HAS_MAG=1 SYS_HAS_NUM_ASPD=0 SYS_HITL=0 SYS_MC_EST_GROUP=2 SYS_STCK_EN=1 SYS_VEHICLE_RESP=-0.4
THR_MDL_FAC=0.0
"""


def _default(text: str) -> int | float:
    return float(text) if "." in text else int(text)  # the notation gives the type


DEFAULTS = {name: _default(text) for name, _, text in (entry.partition("=") for entry in _TABLE.split())}
HASH_NAME = "_HASH_CHECK"
HASH_INDEX = 65535
UINT32 = 5


class WrongTypeError(TypeError):
    """PARAM_SET has another MAV_PARAM_TYPE than the parameter."""


def int_to_wire(value: int) -> float:
    """Return the float whose bits are those of the int32."""
    wire: float = _FLOAT.unpack(_INT.pack(value))[0]
    return wire


def int_from_wire(value: float) -> int:
    """Return the int32 in a float's bits. A signalling NaN does not survive Python's float; PX4 has none."""
    number: int = _INT.unpack(_FLOAT.pack(value))[0]
    return number


class Parameters:
    """The parameters of one vehicle; types are those of the defaults."""

    def __init__(self, sysid: int) -> None:
        self._values = dict(DEFAULTS)
        self._values["MAV_SYS_ID"] = sysid
        self._names = sorted(self._values)
        self._index = {name: i for i, name in enumerate(self._names)}

    def __len__(self) -> int:
        return len(self._names)

    def real(self, name: str) -> float:
        """Return a parameter as a real number."""
        return float(self._values[name])

    def integer(self, name: str) -> int:
        """Return an integer parameter."""
        return int(self._values[name])

    def assign(self, name: str, value: float) -> None:
        """Set a parameter in this process, without MAVLink.

        Raises:
            UnknownParameterError: no such name.
        """
        kind = type(self._values[self._known(name)])
        self._values[name] = kind(value)

    def by_name(self, name: str) -> WireValue:
        """Return a parameter by name; raises `UnknownParameterError`."""
        return self.by_index(self._index[self._known(name)])

    def by_index(self, index: int) -> WireValue:
        """Return a parameter by index; raises `UnknownParameterError` outside the table."""
        if not 0 <= index < len(self._names):
            raise UnknownParameterError(str(index))
        name = self._names[index]
        value = self._values[name]
        if isinstance(value, int):
            return WireValue(name=name, value=int_to_wire(value), kind=INT32, index=index)
        return WireValue(name=name, value=value, kind=REAL32, index=index)

    def checksum(self) -> WireValue:
        """Return `_HASH_CHECK`: a client that knows it can skip the list."""
        crc = 0
        for name in self._names:
            wire = self.by_name(name)
            crc = zlib.crc32(name.encode() + _FLOAT.pack(wire.value), crc)
        value: float = _FLOAT.unpack(struct.pack("<I", crc))[0]
        return WireValue(name=HASH_NAME, value=value, kind=UINT32, index=HASH_INDEX)

    def set_from_wire(self, name: str, value: float, kind: int) -> WireValue:
        """Apply a PARAM_SET and return the stored value; a non-finite float is not stored.

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
