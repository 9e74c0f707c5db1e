"""Sections 2 and 7 of the sheet: parameters bytewise, origin and home."""

from __future__ import annotations

from tests.conformance.dialogue import wire_value
from tests.conformance.fields import Between, near
from tests.conformance.vocabulary import (
    INT32,
    OWN,
    REAL32,
    REQUEST_MESSAGE,
    Command,
    Row,
    Send,
    SetParam,
    State,
    Step,
    message,
    never,
    sees,
)

PARAMS, ORIGIN = "2 parameters", "7"
LAT_E7, LON_E7, ALT_MM = 473977420, 85455940, 489400
MICRODEGREES = 30.0  # of 1e-7 deg, 0.33 m: the measured origin was 0.12 m off the spawn point


def read(name: str = "", index: int = -1) -> Send:
    return Send(
        what=message("PARAM_REQUEST_READ", target_system=OWN, target_component=1, param_id=name, param_index=index)
    )


def write(name: str, value: float, kind: int) -> Send:
    return Send(
        what=message(
            "PARAM_SET", target_system=OWN, target_component=1, param_id=name, param_value=value, param_type=kind
        )
    )


def has(name: str, value: int | float) -> tuple[Step, ...]:
    """A parameter has this value, encoded as PX4 does."""
    kind = INT32 if isinstance(value, int) else REAL32
    exact = near(wire_value(value), abs(value) * 1e-6 if isinstance(value, float) else 0.0)
    return read(name), sees("PARAM_VALUE", 0.2, param_id=name, param_type=kind, param_value=exact)


def defaults(title: str, **values: int | float) -> Row:
    return Row(
        name=f"defaults: {title}",
        section=PARAMS,
        start=State.ARMABLE,
        steps=tuple(step for n, v in values.items() for step in has(n, v)),
    )


def refused(name: str, error: int) -> tuple[Step, ...]:
    return (
        sees("PARAM_ERROR", 0.2, param_id=name, error=error, target_system=Between(1, 255), target_component=191),
        never("PARAM_VALUE", 0.3, param_id=name),
    )


PARAM_ROWS = (
    defaults(
        "COM",
        COM_OF_LOSS_T=1.0,
        COM_OBL_RC_ACT=0,
        COM_RC_IN_MODE=1,
        COM_FAIL_ACT_T=5.0,
        COM_DISARM_PRFLT=10.0,
        COM_DISARM_LAND=2.0,
        COM_SPOOLUP_TIME=1.0,
        COM_DL_LOSS_T=10,
        COM_HOME_EN=1,
    ),
    defaults("NAV, MAV", NAV_RCL_ACT=2, NAV_DLL_ACT=0, MAV_FWDEXTSP=1, MAV_SYS_ID=1),
    defaults(
        "MPC",
        MPC_THR_HOVER=0.5,
        MPC_THR_MIN=0.12,
        MPC_THR_MAX=1.0,
        MPC_TILTMAX_AIR=45.0,
        MPC_Z_VEL_MAX_UP=3.0,
        MPC_Z_VEL_MAX_DN=1.5,
        MPC_LAND_SPEED=0.7,
        THR_MDL_FAC=0.0,
        MIS_TAKEOFF_ALT=2.5,
        RTL_RETURN_ALT=30.0,
    ),
    defaults(
        "MC",
        MC_ROLL_P=4.0,
        MC_PITCH_P=4.0,
        MC_YAW_P=2.8,
        MC_YAW_WEIGHT=0.4,
        MC_ROLLRATE_P=0.15,
        MC_ROLLRATE_I=0.2,
        MC_ROLLRATE_D=0.003,
        MC_PITCHRATE_P=0.15,
        MC_ROLLRATE_MAX=220.0,
        MC_YAWRATE_MAX=200.0,
    ),
    defaults(
        "SIH, IMU",
        SIH_MASS=1.0,
        SIH_T_MAX=5.0,
        SIH_IXX=0.025,
        SIH_IZZ=0.03,
        SIH_T_TAU=0.05,
        SIH_KDV=1.0,
        IMU_INTEG_RATE=250,
    ),
    Row(
        name="integers travel bytewise, there and back",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(SetParam("COM_OBL_RC_ACT", 5), *has("COM_OBL_RC_ACT", 5), SetParam("COM_OBL_RC_ACT", 0)),
    ),
    Row(
        name="a value out of range is accepted",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(SetParam("COM_OF_LOSS_T", 100.0), *has("COM_OF_LOSS_T", 100.0), SetParam("COM_OF_LOSS_T", 1.0)),
    ),
    Row(
        name="reading an unknown name",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(read("NO_SUCH_PARAM"), *refused("NO_SUCH_PARAM", 1)),
    ),
    Row(
        name="writing an unknown name",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(write("NO_SUCH_PARAM", 1.0, REAL32), *refused("NO_SUCH_PARAM", 1)),
    ),
    *(
        Row(
            name=f"writing {name} with the wrong type",
            section=PARAMS,
            start=State.ARMABLE,
            steps=(write(name, 0.25, kind), *refused(name, 7), *has(name, default)),
        )
        for name, kind, default in (("COM_OF_LOSS_T", INT32, 1.0), ("COM_OBL_RC_ACT", REAL32, 0))
    ),
    Row(
        name="the list is whole and has _HASH_CHECK",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(
            Send(what=message("PARAM_REQUEST_LIST", target_system=OWN, target_component=1)),
            sees("PARAM_VALUE", 2.0, param_index=0),
            sees("PARAM_VALUE", 2.0, param_id="MAV_SYS_ID", param_type=INT32),
            sees("PARAM_VALUE", 2.0, param_id="_HASH_CHECK", param_type=5, param_index=65535),
        ),
    ),
    Row(
        name="_HASH_CHECK alone",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(read("_HASH_CHECK"), sees("PARAM_VALUE", 0.2, param_id="_HASH_CHECK", param_type=5)),
    ),
    Row(
        name="by index",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(read(index=3), sees("PARAM_VALUE", 0.2, param_index=3, param_count=Between(30, 3000))),
    ),
    Row(
        name="parameters of another system are not ours to set",
        section=PARAMS,
        start=State.ARMABLE,
        steps=(
            Send(
                what=message(
                    "PARAM_SET",
                    target_system=77,
                    target_component=1,
                    param_id="COM_OF_LOSS_T",
                    param_value=9.0,
                    param_type=REAL32,
                )
            ),
            never("PARAM_VALUE"),
            *has("COM_OF_LOSS_T", 1.0),
        ),
    ),
)

ORIGIN_ROWS = (
    Row(
        name="GPS_GLOBAL_ORIGIN on request, the default place",
        section=ORIGIN,
        start=State.ARMABLE,
        steps=(
            Command(number=REQUEST_MESSAGE, params=(49,)),
            sees(
                "GPS_GLOBAL_ORIGIN",
                0.2,
                latitude=near(LAT_E7, MICRODEGREES),
                longitude=near(LON_E7, MICRODEGREES),
                altitude=near(ALT_MM, 500),
            ),
        ),
    ),
    Row(
        name="GPS_GLOBAL_ORIGIN is not streamed",
        section=ORIGIN,
        start=State.ARMABLE,
        steps=(
            never("GPS_GLOBAL_ORIGIN", 3.0),
            Command(number=REQUEST_MESSAGE, params=(49,)),
            sees("GPS_GLOBAL_ORIGIN", 0.2),
        ),
    ),
    Row(
        name="HOME_POSITION is where it was armed",
        section=ORIGIN,
        start=State.ARMED,
        steps=(
            Command(number=REQUEST_MESSAGE, params=(242,)),
            sees(
                "HOME_POSITION",
                0.2,
                latitude=near(LAT_E7, MICRODEGREES),
                longitude=near(LON_E7, MICRODEGREES),
                altitude=near(ALT_MM, 500),
                x=near(0.0, 0.5),
                y=near(0.0, 0.5),
                z=near(0.0, 0.5),
            ),
        ),
        untouched=True,  # after flights the height that it believes to stand at is up to a metre off
    ),
    Row(
        name="GLOBAL_POSITION_INT is relative to home",
        section=ORIGIN,
        start=State.ARMED,
        steps=(sees("GLOBAL_POSITION_INT", 0.3, lat=near(LAT_E7, MICRODEGREES), relative_alt=near(0, 300)),),
    ),
    Row(
        name="it is at its own origin when it starts",
        section=ORIGIN,
        start=State.ARMABLE,
        steps=(sees("LOCAL_POSITION_NED", 0.3, x=near(0.0, 0.5), y=near(0.0, 0.5), z=near(0.0, 0.5)),),
        untouched=True,
    ),
)

ROWS = (*PARAM_ROWS, *ORIGIN_ROWS)
