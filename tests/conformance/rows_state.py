"""Section 2 of the sheet: modes and states as HEARTBEAT, CURRENT_MODE, SYS_STATUS and others show them."""

from __future__ import annotations

from tests.conformance.fields import Between, Bits, NotANumber
from tests.conformance.vocabulary import (
    DENIED,
    M_LAND,
    M_LOITER,
    M_OFFBOARD,
    M_POSCTL,
    M_RTL,
    M_TAKEOFF,
    M_TERMINATION,
    NAN,
    TAKEOFF,
    TERMINATE,
    Command,
    First,
    Mark,
    Row,
    State,
    Stop,
    Stream,
    Turns,
    Wait,
    always,
    go,
    heartbeat,
    never,
    sees,
    setpoint,
)

STATE = "2 state"
ALL_NAN = (NAN,) * 7
PREARM = 0x10000000
EXTENDED = "EXTENDED_SYS_STATE"

STATE_ROWS = (
    Row(
        "boot: LOITER, not yet armable",
        STATE,
        State.BOOTING,
        (heartbeat(type=2, autopilot=12, mavlink_version=3, base_mode=29, custom_mode=M_LOITER, system_status=0),),
    ),
    Row(
        "LOITER, armable",
        STATE,
        State.ARMABLE,
        (heartbeat(type=2, autopilot=12, base_mode=29, custom_mode=M_LOITER, system_status=3),),
    ),
    Row(
        "the first HEARTBEAT comes 1.3 s after start",
        STATE,
        State.BOOTING,
        (First("HEARTBEAT", 1.2, 1.4),),
        not_by_url="the start is not seen from outside",
    ),
    Row("armed in LOITER", STATE, State.ARMED, (heartbeat(base_mode=157, custom_mode=M_LOITER, system_status=4),)),
    Row(
        "TAKEOFF",
        STATE,
        State.ARMED,
        (Command(TAKEOFF, ALL_NAN), heartbeat(base_mode=157, custom_mode=M_TAKEOFF, system_status=4)),
    ),
    Row("LAND", STATE, State.LOITER, (go(4, 6), heartbeat(base_mode=157, custom_mode=M_LAND, system_status=4))),
    Row("RTL", STATE, State.LOITER, (go(4, 5), heartbeat(base_mode=157, custom_mode=M_RTL, system_status=4))),
    Row(
        "OFFBOARD disarmed, never a stream",
        STATE,
        State.ARMABLE,
        (go(6), heartbeat(base_mode=1, custom_mode=M_OFFBOARD, system_status=0)),
        never_streamed=True,
    ),
    Row(
        "OFFBOARD disarmed with a stream, then without",
        STATE,
        State.ARMABLE,
        (
            Stream(setpoint()),
            go(6),
            heartbeat(base_mode=17, custom_mode=M_OFFBOARD, system_status=3),
            Stop(),
            heartbeat(2.6, base_mode=17, custom_mode=M_OFFBOARD, system_status=0),
        ),
    ),
    Row(
        "OFFBOARD armed",
        STATE,
        State.GROUND_OFFBOARD,
        (heartbeat(base_mode=145, custom_mode=M_OFFBOARD, system_status=4),),
    ),
    Row(
        "POSCTL disarmed, no radio",
        STATE,
        State.ARMABLE,
        (go(3), heartbeat(base_mode=81, custom_mode=M_POSCTL, system_status=0)),
    ),
    Row(
        "flight termination: status 8 and a mode of its own",
        STATE,
        State.ARMED,
        (Command(TERMINATE, (1.0,)), heartbeat(custom_mode=M_TERMINATION, system_status=8)),
        spoils=True,
    ),
    Row(
        "flight termination is denied disarmed",
        STATE,
        State.ARMABLE,
        (Command(TERMINATE, (1.0,), DENIED), heartbeat(base_mode=29, custom_mode=M_LOITER, system_status=3)),
    ),
    Row(
        "CURRENT_MODE shows a change within 30 ms, HEARTBEAT within 1 s",
        STATE,
        State.LOITER,
        (go(4, 6), Turns(M_LAND, 0.0, 0.03), Turns(M_LAND, 0.0, 1.01, "HEARTBEAT")),
    ),
    Row(
        "SYS_STATUS, armable",
        STATE,
        State.ARMABLE,
        (
            sees(
                "SYS_STATUS",
                onboard_control_sensors_present=Bits(0x0200C02F, ~0x0300C02F),  # and while it logs, the logger
                onboard_control_sensors_enabled=Bits(0x0201C02F, ~0x0301C02F),
                onboard_control_sensors_health=0x1320C83F,
                voltage_battery=16200,
                current_battery=-1,
                battery_remaining=Between(50, 100),
            ),
        ),
    ),
    Row(
        "PREARM is clear in POSCTL without radio",
        STATE,
        State.ARMABLE,
        (go(3), Wait(0.3), Mark(), sees("SYS_STATUS", onboard_control_sensors_health=Bits(off=PREARM))),
    ),
    Row(
        "PREARM is clear in OFFBOARD without stream, set with one",
        STATE,
        State.ARMABLE,
        (
            go(6),
            Wait(0.3),
            Mark(),
            sees("SYS_STATUS", onboard_control_sensors_health=Bits(off=PREARM)),
            Stream(setpoint()),
            sees("SYS_STATUS", 0.7, onboard_control_sensors_health=Bits(PREARM)),
        ),
    ),
    Row("ESTIMATOR_STATUS flags", STATE, State.ARMABLE, (sees("ESTIMATOR_STATUS", 1.2, flags=1023),)),
    Row(
        "ODOMETRY is NED in position and velocity",
        STATE,
        State.ARMABLE,
        (sees("ODOMETRY", frame_id=1, child_frame_id=1),),
    ),
    Row("VFR_HUD.airspeed is NaN", STATE, State.ARMABLE, (sees("VFR_HUD", airspeed=NotANumber()),)),
    Row(
        "servos 900 disarmed",
        STATE,
        State.ARMABLE,
        (sees("SERVO_OUTPUT_RAW", servo1_raw=900, servo2_raw=900, servo3_raw=900, servo4_raw=900),),
    ),
    Row(
        "servos 1000 to 2000 armed",
        STATE,
        State.LOITER,
        (always("SERVO_OUTPUT_RAW", 0.5, 5, servo1_raw=Between(1000, 2000), servo4_raw=Between(1000, 2000)),),
    ),
    Row("EXTENDED_SYS_STATE on the ground", STATE, State.ARMABLE, (sees(EXTENDED, vtol_state=0, landed_state=1),)),
    Row(
        "OFFBOARD goes from ground to air within 0.1 s of lift-off thrust, by way of nothing",
        STATE,
        State.GROUND_OFFBOARD,
        (
            Stream(setpoint(0.7)),
            Turns(2, 0.0, 0.12, EXTENDED, "landed_state"),
            never(EXTENDED, 0.3, landed_state=3),
            Stream(setpoint(0.0)),
        ),
    ),
)

ROWS = STATE_ROWS
