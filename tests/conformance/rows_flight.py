"""Sections 4 and 6 of the sheet: what a setpoint's values do, and how fast thrust and attitude follow."""

from __future__ import annotations

import math

from tests.conformance.fields import Between, Each, near
from tests.conformance.rows_offboard import about, tilted
from tests.conformance.vocabulary import (
    HOVER_01,
    M_LOITER,
    NAN,
    Mark,
    Moves,
    Row,
    Send,
    State,
    Stop,
    Stream,
    Wait,
    always,
    arm,
    go,
    heartbeat,
    mode,
    sees,
    setpoint,
)

VALUES, RESPONSE = "4 values", "6"

VALUE_ROWS = (
    Row(
        name="ATTITUDE_TARGET echoes q and thrust, type_mask 0",
        section=VALUES,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(0.5, about("roll", 5.0))),
            sees(
                "ATTITUDE_TARGET", 0.05, type_mask=0, thrust=near(0.5, 1e-6), q=Each((0.9990482, near(0.0436194, 1e-6)))
            ),
        ),
    ),
    Row(
        name="thrust 1.5 is echoed, motors at their limit",
        section=VALUES,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(1.5)),
            sees("ATTITUDE_TARGET", 0.1, thrust=near(1.5, 1e-6)),
            sees("SERVO_OUTPUT_RAW", 0.5, servo1_raw=Between(1900, 2000), servo3_raw=Between(1900, 2000)),
            Stream(setpoint(HOVER_01)),
            Wait(0.1),
        ),
    ),
    Row(
        name="thrust -0.5 is echoed as 0.5, motors idle",
        section=VALUES,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(-0.5)),
            sees("ATTITUDE_TARGET", 0.1, thrust=near(0.5, 1e-6)),
            sees("SERVO_OUTPUT_RAW", 0.5, servo1_raw=Between(1000, 1010)),
            Stream(setpoint(HOVER_01)),
            Wait(0.1),
        ),
    ),
    Row(
        name="thrust NaN turns the motors off while armed, the next good one on",
        section=VALUES,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(NAN)),
            sees("SERVO_OUTPUT_RAW", 0.3, servo1_raw=900),
            Stream(setpoint(HOVER_01)),
            sees("SERVO_OUTPUT_RAW", 0.3, servo1_raw=Between(1100, 2000)),
            heartbeat(base_mode=145),
        ),
    ),
    Row(
        name="a quaternion of norm 2 is flown as its unit one",
        section=VALUES,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(HOVER_01, tuple(2 * c for c in about("roll", 8.0))), 100.0),
            Wait(1.0),
            always("ATTITUDE", 0.3, 20, roll=near(math.radians(8.0), 0.035)),
        ),
    ),
    *(
        Row(
            name=f"one setpoint with q {name} poisons the attitude controller: nothing is followed, in LOITER neither",
            section=VALUES,
            start=State.OFFBOARD,
            steps=(
                Stop(),
                Send(what=setpoint(HOVER_01, q)),
                Wait(0.1),
                tilted(20.0),
                Moves("roll_highest_deg", Between(-180.0, 14.0), 1.2),
                go(4, 3),
                mode(M_LOITER),
                tilted(20.0),
                go(6),
                Moves("roll_highest_deg", Between(-180.0, 14.0), 1.0),
            ),
            spoils=True,
        )
        for name, q in (("zero", (0.0, 0.0, 0.0, 0.0)), ("NaN", (NAN, NAN, NAN, NAN)))
    ),
    *(
        Row(
            name=f"a setpoint with q {name} does no harm when a good one follows at once",
            section=VALUES,
            start=State.OFFBOARD,
            steps=(Send(what=setpoint(HOVER_01, q)), tilted(20.0), Moves("roll_highest_deg", Between(18.0, 23.0), 1.2)),
            spoils=True,
        )
        for name, q in (("zero", (0.0, 0.0, 0.0, 0.0)), ("NaN", (NAN, NAN, NAN, NAN)))
    ),
    Row(
        name="60 degrees are followed",
        section=VALUES,
        start=State.OFFBOARD,
        steps=(
            tilted(60.0),
            Moves("highest_tilt_deg", Between(57.0, 70.0), 0.9),
            Stream(setpoint(HOVER_01)),
            Wait(1.0),
        ),
    ),
)


def step_response(axis: str, angle_deg: float, bounds: dict[str, Between], highest: Between, for_s: float) -> Row:
    target = round(angle_deg)
    thrust_01 = HOVER_01 if axis == "yaw" else HOVER_01 / math.cos(math.radians(angle_deg))
    return Row(
        name=f"{axis} step of {target} deg",
        section=RESPONSE,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(thrust_01, about(axis, angle_deg)), 100.0),
            *(Moves(f"{axis}_{target}_t{share}_s", wanted, for_s) for share, wanted in bounds.items()),
            Moves(f"{axis}_highest_deg", highest, for_s),
        ),
    )


RESPONSE_ROWS = (
    *(
        Row(
            name=f"thrust {thrust_01} accelerates downwards by {acc_m_s2:+.2f} m/s2",
            section=RESPONSE,
            start=State.LOITER,
            steps=(
                Mark(),
                sees("LOCAL_POSITION_NED", 20.0, vz=near(0.0, 0.05)),  # two thirds of a first speed would be added
                Stream(setpoint(HOVER_01), 100.0),
                go(6),
                Wait(0.2),
                Stream(setpoint(thrust_01), 100.0),
                Moves("acceleration_down_m_s2", near(acc_m_s2, 0.5), 0.75),  # of a real one: one sigma is 0.12
            ),
        )
        for thrust_01, acc_m_s2 in ((0.388, 1.41), (0.488, -0.01), (0.588, -1.30), (0.688, -2.58))  # means of 5 flights
    ),
    step_response(
        "roll",
        10.0,
        {"10": Between(0.1, 0.155), "50": Between(0.225, 0.285), "63": Between(0.265, 0.325), "90": Between(0.4, 0.51)},
        Between(9.8, 10.5),
        1.0,
    ),
    step_response("pitch", 10.0, {"63": Between(0.265, 0.325), "90": Between(0.40, 0.51)}, Between(9.8, 10.5), 1.0),
    step_response("roll", 30.0, {"63": Between(0.27, 0.33), "90": Between(0.41, 0.50)}, Between(28.8, 31.0), 1.0),
    step_response("yaw", 20.0, {"50": Between(0.50, 0.63), "90": Between(0.73, 0.86)}, Between(24.5, 26.8), 1.5),
    Row(
        name="hover thrust in LOITER",
        section=RESPONSE,
        start=State.LOITER,
        steps=(Wait(1.0), Mark(), Moves("mean_thrust_01", near(0.49, 0.006), 10.0)),  # of a second: 0.474 to 0.516
    ),
    Row(
        name="attitude-only take-off: 0.15 m up 0.7 s after arming, spool-up not waited for",
        section=RESPONSE,
        start=State.ARMABLE,
        steps=(
            Stream(setpoint(0.6)),
            go(6),
            Wait(0.1),
            arm(),
            Moves("climb_m", Between(0.05, 0.6), 0.7),
            Moves("height_m", Between(8.0, 15.5), 6.7),
        ),
    ),
)

ROWS = (*VALUE_ROWS, *RESPONSE_ROWS)
