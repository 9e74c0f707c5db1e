"""Section 1 of the sheet: addressing and replies, requests and intervals, texts, time."""

from __future__ import annotations

from tests.conformance.fields import Between, Other, near
from tests.conformance.vocabulary import (
    ARM_DISARM,
    DENIED,
    FAILED,
    GCS_LINK,
    NO_ACK,
    OFFBOARD_LINK,
    OWN,
    REQUEST_MESSAGE,
    SET_INTERVAL,
    TEXT_LINK,
    Command,
    Mark,
    Mute,
    Rate,
    Row,
    Says,
    SaysNothing,
    Send,
    State,
    Wait,
    always,
    arm,
    disarm,
    forwarded,
    heartbeat,
    message,
    never,
    sees,
)

LINK, COMMANDS = "1 link", "1 commands"
ATTITUDE, ODOMETRY, HIGHRES_IMU, CURRENT_MODE, PROTOCOL_VERSION = 30, 331, 105, 436, 300


LINK_ROWS = (
    Row(
        "a command to another system gets no ack and does nothing",
        LINK,
        State.ARMABLE,
        (Command(ARM_DISARM, (1.0,), NO_ACK, (77, 1)), heartbeat(base_mode=29)),
    ),
    Row(
        "a command to component 250 gets no ack and does nothing",
        LINK,
        State.ARMABLE,
        (Command(ARM_DISARM, (1.0,), NO_ACK, (OWN, 250)), heartbeat(base_mode=29)),
    ),
    Row(
        "a command to component 0 is executed",
        LINK,
        State.ARMABLE,
        (Command(ARM_DISARM, (1.0,), target=(OWN, 0)), heartbeat(base_mode=157)),
    ),
    Row(
        "COMMAND_INT 400 is COMMAND_LONG 400",
        COMMANDS,
        State.ARMABLE,
        (Command(ARM_DISARM, (1.0,), as_int=True), heartbeat(base_mode=157)),
    ),
    Row(
        "SET_MODE works and is acknowledged as command 176",
        COMMANDS,
        State.ARMABLE,
        (
            Send(message("SET_MODE", target_system=OWN, base_mode=1, custom_mode=0x00060000)),
            sees("COMMAND_ACK", 0.1, command=176, result=0),
            heartbeat(custom_mode=0x00060000),
        ),
    ),
    Row(
        "commands work on the ground station link, and are answered there",
        COMMANDS,
        State.ARMABLE,
        (
            Command(ARM_DISARM, (1.0,), link=GCS_LINK),
            never("COMMAND_ACK", 0.2),
            sees("HEARTBEAT", 1.2, link=GCS_LINK, base_mode=157),
        ),
        needs_gcs=True,
    ),
    Row(
        "texts go to the link of the ground station only",
        LINK,
        State.ARMABLE,
        (arm(), Says("Armed by external command\t", 6, 0.2), never("STATUSTEXT", 1.0)),
        needs_gcs=True,
    ),
    Row(
        "a text is there 0.1 s after its cause",
        LINK,
        State.ARMABLE,
        (arm(), Says("Armed by external command\t", 6, 0.1)),
    ),
    Row(
        "our heartbeats are forwarded to the other link",
        LINK,
        State.ARMABLE,
        (
            forwarded("HEARTBEAT", 1.3, OFFBOARD_LINK, type=6, autopilot=8),
            forwarded("HEARTBEAT", 1.3, GCS_LINK, type=18),
        ),
        needs_gcs=True,
    ),
    Row(
        "at boot an ack for 211 nobody asked for",
        LINK,
        State.BOOTING,
        (sees("COMMAND_ACK", 6.0, command=211),),
        real_px4="a module for grippers sends it, which a reduced build lacks",
    ),
    Row(
        "TIMESYNC is answered with nanoseconds since boot",
        LINK,
        State.ARMABLE,
        (
            Send(message("TIMESYNC", tc1=0, ts1=424242)),
            sees("TIMESYNC", 0.1, ts1=424242, tc1=Between(1e6, 1e15)),
            Send(message("TIMESYNC", tc1=5, ts1=313131)),
            never("TIMESYNC", ts1=313131),
        ),
    ),
    Row(
        "its own TIMESYNC requests have tc1 0",
        LINK,
        State.ARMABLE,
        (sees("TIMESYNC", 0.3, tc1=0, ts1=Other(0)),),
    ),
    Row(
        "PING is echoed to its sender",
        LINK,
        State.ARMABLE,
        (
            Send(message("PING", time_usec=777, seq=34567)),
            sees("PING", 0.1, time_usec=777, seq=34567, target_system=Between(1, 255), target_component=191),
        ),
    ),
    Row(
        "a PING to another system is not echoed",
        LINK,
        State.ARMABLE,
        (
            Send(message("PING", time_usec=778, seq=34568, target_system=77, target_component=1)),
            never("PING", time_usec=778),
            Send(message("PING", time_usec=779, seq=34569)),
            sees("PING", 0.1, time_usec=779),
        ),
    ),
    Row(
        "an interval on request: ODOMETRY at 100 Hz",
        COMMANDS,
        State.ARMABLE,
        (Command(SET_INTERVAL, (ODOMETRY, 10000)), Rate(ODOMETRY, near(100, 12), 1.0)),
    ),
    Row(
        "an interval on request: ATTITUDE at 250 Hz gives about 205",
        COMMANDS,
        State.ARMABLE,
        (Command(SET_INTERVAL, (ATTITUDE, 4000)), Rate(ATTITUDE, near(225, 30), 1.0)),
    ),
    Row(
        "interval -1 ends a stream, 0 is its default",
        COMMANDS,
        State.ARMABLE,
        (
            Command(SET_INTERVAL, (HIGHRES_IMU, -1)),
            Wait(0.1),
            Mark(),
            never(HIGHRES_IMU, 0.5),
            Command(SET_INTERVAL, (HIGHRES_IMU, 0)),
            Rate(HIGHRES_IMU, near(49.5, 6), 1.0),
        ),
    ),
    Row(
        "an interval holds for the link it was asked on",
        COMMANDS,
        State.ARMABLE,
        (
            Command(SET_INTERVAL, (ATTITUDE, 100_000)),
            Wait(0.2),
            Rate(ATTITUDE, near(10, 2), 1.0),
            Rate(ATTITUDE, near(49.5, 6), 1.0, GCS_LINK),
            Command(SET_INTERVAL, (ATTITUDE, 0)),
        ),
        needs_gcs=True,
    ),
    Row(
        "an interval of an unknown message fails",
        COMMANDS,
        State.ARMABLE,
        (Command(SET_INTERVAL, (9999, 10000), FAILED),),
    ),
    Row(
        "AUTOPILOT_VERSION on request",
        COMMANDS,
        State.ARMABLE,
        (
            Command(REQUEST_MESSAGE, (148,)),
            sees(
                "AUTOPILOT_VERSION",
                0.2,
                capabilities=59647,
                flight_sw_version=0x01120080,
                middleware_sw_version=0x01120080,
                board_version=1,
                uid2=Other([0] * 18 + [1]),
            ),
        ),
    ),
    Row(
        "HOME_POSITION on request",
        COMMANDS,
        State.ARMABLE,
        (Command(REQUEST_MESSAGE, (242,)), sees("HOME_POSITION", 0.2)),
    ),
    Row(
        "512 for 300 sends PROTOCOL_VERSION",
        COMMANDS,
        State.ARMABLE,
        (Command(REQUEST_MESSAGE, (PROTOCOL_VERSION,)), sees(PROTOCOL_VERSION, 0.1)),
    ),
    Row(
        "512 for a message it does not know is denied",
        COMMANDS,
        State.ARMABLE,
        (Command(REQUEST_MESSAGE, (9999,), DENIED),),
    ),
    Row(
        "512 for CURRENT_MODE is denied while there is nothing new in it",
        COMMANDS,
        State.ARMABLE,
        (sees("CURRENT_MODE", 0.7), Command(REQUEST_MESSAGE, (CURRENT_MODE,), DENIED)),
    ),
    Row(
        "CURRENT_MODE comes twice a second however often it is asked for",
        COMMANDS,
        State.ARMABLE,
        (Command(SET_INTERVAL, (CURRENT_MODE, 10000)), Rate("CURRENT_MODE", near(2.0, 0.3), 4.0)),
    ),
    Row(
        "the id of a text counts up",
        LINK,
        State.ARMABLE,
        (
            arm(),
            sees("STATUSTEXT", 0.3, link=TEXT_LINK, id=Between(1, 65535)),
            disarm(),
            sees("STATUSTEXT", 0.3, link=TEXT_LINK, id=Between(2, 65535)),
        ),
    ),
    Row(
        "heartbeats of ours are not needed",
        LINK,
        State.ARMED,
        (Mute("offboard"), Wait(1.5), always("HEARTBEAT", 3.2, 3, base_mode=157, system_status=4)),
    ),
    Row(
        "a ground station that falls silent and comes back",
        "5",
        State.ARMED,
        (
            Mute(GCS_LINK),
            Mark(),
            SaysNothing(13.0),  # its loss is not reported
            Mute(GCS_LINK, muted=False),
            Mark(),
            Says("GCS connection regained\t", 6, 3.0),
        ),
        needs_gcs=True,
    ),
)

ROWS = LINK_ROWS
