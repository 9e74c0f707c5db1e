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
        name="boot: LOITER, not yet armable",
        section=STATE,
        start=State.BOOTING,
        steps=(
            heartbeat(
                3.0, type=2, autopilot=12, mavlink_version=3, base_mode=29, custom_mode=M_LOITER, system_status=0
            ),
        ),
    ),
    Row(
        name="LOITER, armable",
        section=STATE,
        start=State.ARMABLE,
        steps=(heartbeat(type=2, autopilot=12, base_mode=29, custom_mode=M_LOITER, system_status=3),),
    ),
    Row(
        name="the first HEARTBEAT comes 1.3 s after start",
        section=STATE,
        start=State.BOOTING,
        steps=(First("HEARTBEAT", 1.2, 1.4),),
        not_by_url="the start is not seen from outside",
    ),
    Row(
        name="armed in LOITER",
        section=STATE,
        start=State.ARMED,
        steps=(heartbeat(base_mode=157, custom_mode=M_LOITER, system_status=4),),
    ),
    Row(
        name="TAKEOFF",
        section=STATE,
        start=State.ARMED,
        steps=(
            Command(number=TAKEOFF, params=ALL_NAN),
            heartbeat(base_mode=157, custom_mode=M_TAKEOFF, system_status=4),
        ),
    ),
    Row(
        name="LAND",
        section=STATE,
        start=State.LOITER,
        steps=(go(4, 6), heartbeat(base_mode=157, custom_mode=M_LAND, system_status=4)),
    ),
    Row(
        name="RTL",
        section=STATE,
        start=State.LOITER,
        steps=(go(4, 5), heartbeat(base_mode=157, custom_mode=M_RTL, system_status=4)),
    ),
    Row(
        name="OFFBOARD disarmed, never a stream",
        section=STATE,
        start=State.ARMABLE,
        steps=(go(6), heartbeat(base_mode=1, custom_mode=M_OFFBOARD, system_status=0)),
        untouched=True,
    ),
    Row(
        name="OFFBOARD disarmed with a stream, then without",
        section=STATE,
        start=State.ARMABLE,
        steps=(
            Stream(setpoint()),
            go(6),
            heartbeat(base_mode=17, custom_mode=M_OFFBOARD, system_status=3),
            Stop(),
            heartbeat(2.6, base_mode=17, custom_mode=M_OFFBOARD, system_status=0),
        ),
    ),
    Row(
        name="OFFBOARD armed",
        section=STATE,
        start=State.GROUND_OFFBOARD,
        steps=(heartbeat(base_mode=145, custom_mode=M_OFFBOARD, system_status=4),),
    ),
    Row(
        name="POSCTL disarmed, no radio",
        section=STATE,
        start=State.ARMABLE,
        steps=(go(3), heartbeat(base_mode=81, custom_mode=M_POSCTL, system_status=0)),
    ),
    Row(
        name="flight termination: status 8 and a mode of its own",
        section=STATE,
        start=State.ARMED,
        steps=(Command(number=TERMINATE, params=(1.0,)), heartbeat(custom_mode=M_TERMINATION, system_status=8)),
        spoils=True,
    ),
    Row(
        name="flight termination is denied disarmed",
        section=STATE,
        start=State.ARMABLE,
        steps=(
            Command(number=TERMINATE, params=(1.0,), ack=DENIED),
            heartbeat(base_mode=29, custom_mode=M_LOITER, system_status=3),
        ),
    ),
    Row(
        name="CURRENT_MODE shows a change within 30 ms, HEARTBEAT within 1 s",
        section=STATE,
        start=State.LOITER,
        steps=(
            go(4, 6),
            Turns(value=M_LAND, low_s=0.0, high_s=0.03),
            Turns(value=M_LAND, low_s=0.0, high_s=1.01, name="HEARTBEAT"),
        ),
    ),
    Row(
        name="SYS_STATUS, armable",
        section=STATE,
        start=State.ARMABLE,
        steps=(
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
        name="PREARM is clear in POSCTL without radio",
        section=STATE,
        start=State.ARMABLE,
        steps=(go(3), Wait(0.3), Mark(), sees("SYS_STATUS", onboard_control_sensors_health=Bits(off=PREARM))),
    ),
    Row(
        name="PREARM is clear in OFFBOARD without stream, set with one",
        section=STATE,
        start=State.ARMABLE,
        steps=(
            go(6),
            Wait(2.2),
            Mark(),
            sees("SYS_STATUS", onboard_control_sensors_health=Bits(off=PREARM)),
            Stream(setpoint()),
            sees("SYS_STATUS", 0.7, onboard_control_sensors_health=Bits(PREARM)),
        ),
        untouched=True,  # PX4 reports this at most every 2 s, and may forget that a stream of 1 s has ended
    ),
    Row(
        name="ESTIMATOR_STATUS flags",
        section=STATE,
        start=State.ARMABLE,
        steps=(sees("ESTIMATOR_STATUS", 1.2, flags=1023),),
    ),
    Row(
        name="ODOMETRY is NED in position and velocity",
        section=STATE,
        start=State.ARMABLE,
        steps=(sees("ODOMETRY", frame_id=1, child_frame_id=1),),
    ),
    Row(
        name="VFR_HUD.airspeed is NaN",
        section=STATE,
        start=State.ARMABLE,
        steps=(sees("VFR_HUD", airspeed=NotANumber()),),
    ),
    Row(
        name="servos 900 disarmed",
        section=STATE,
        start=State.ARMABLE,
        steps=(sees("SERVO_OUTPUT_RAW", servo1_raw=900, servo2_raw=900, servo3_raw=900, servo4_raw=900),),
    ),
    Row(
        name="servos 1000 to 2000 armed",
        section=STATE,
        start=State.LOITER,
        steps=(always("SERVO_OUTPUT_RAW", 0.5, 5, servo1_raw=Between(1000, 2000), servo4_raw=Between(1000, 2000)),),
    ),
    Row(
        name="EXTENDED_SYS_STATE on the ground",
        section=STATE,
        start=State.ARMABLE,
        steps=(sees(EXTENDED, vtol_state=0, landed_state=1),),
    ),
    Row(
        name="OFFBOARD goes from ground to air within 0.1 s of lift-off thrust, by way of nothing",
        section=STATE,
        start=State.GROUND_OFFBOARD,
        steps=(
            Stream(setpoint(0.7)),
            Turns(value=2, low_s=0.0, high_s=0.12, name=EXTENDED, field="landed_state"),
            never(EXTENDED, 0.3, landed_state=3),
            Stream(setpoint(0.0)),
        ),
    ),
)

ROWS = STATE_ROWS
