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
    PauseHeartbeats,
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
        name="a command to another system gets no ack and does nothing",
        section=LINK,
        start=State.ARMABLE,
        steps=(Command(number=ARM_DISARM, params=(1.0,), ack=NO_ACK, target=(77, 1)), heartbeat(base_mode=29)),
    ),
    Row(
        name="a command to component 250 gets no ack and does nothing",
        section=LINK,
        start=State.ARMABLE,
        steps=(Command(number=ARM_DISARM, params=(1.0,), ack=NO_ACK, target=(OWN, 250)), heartbeat(base_mode=29)),
    ),
    Row(
        name="a command to component 0 is executed",
        section=LINK,
        start=State.ARMABLE,
        steps=(Command(number=ARM_DISARM, params=(1.0,), target=(OWN, 0)), heartbeat(base_mode=157)),
    ),
    Row(
        name="COMMAND_INT 400 is COMMAND_LONG 400",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(Command(number=ARM_DISARM, params=(1.0,), as_int=True), heartbeat(base_mode=157)),
    ),
    Row(
        name="SET_MODE works and is acknowledged as command 176",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Send(what=message("SET_MODE", target_system=OWN, base_mode=1, custom_mode=0x00060000)),
            sees("COMMAND_ACK", 0.1, command=176, result=0),
            heartbeat(custom_mode=0x00060000),
        ),
    ),
    Row(
        name="commands work on the ground station link, and are answered there",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Command(number=ARM_DISARM, params=(1.0,), link=GCS_LINK),
            never("COMMAND_ACK", 0.2),
            sees("HEARTBEAT", 1.2, link=GCS_LINK, base_mode=157),
        ),
        needs_gcs=True,
    ),
    Row(
        name="texts go to the link of the ground station only",
        section=LINK,
        start=State.ARMABLE,
        steps=(arm(), Says(text="Armed by external command\t", severity=6, within_s=0.2), never("STATUSTEXT", 1.0)),
        needs_gcs=True,
    ),
    Row(
        name="a text is there 0.1 s after its cause",
        section=LINK,
        start=State.ARMABLE,
        steps=(arm(), Says(text="Armed by external command\t", severity=6, within_s=0.1)),
    ),
    Row(
        name="our heartbeats are forwarded to the other link",
        section=LINK,
        start=State.ARMABLE,
        steps=(
            forwarded("HEARTBEAT", 1.3, OFFBOARD_LINK, type=6, autopilot=8),
            forwarded("HEARTBEAT", 1.3, GCS_LINK, type=18),
        ),
        needs_gcs=True,
    ),
    Row(
        name="at boot an ack for 211 nobody asked for",
        section=LINK,
        start=State.BOOTING,
        steps=(sees("COMMAND_ACK", 6.0, command=211),),
        real_px4="a module for grippers sends it, which a reduced build lacks",
    ),
    Row(
        name="TIMESYNC is answered with nanoseconds since boot",
        section=LINK,
        start=State.ARMABLE,
        steps=(
            Send(what=message("TIMESYNC", tc1=0, ts1=424242)),
            sees("TIMESYNC", 0.1, ts1=424242, tc1=Between(1e6, 1e15)),
            Send(what=message("TIMESYNC", tc1=5, ts1=313131)),
            never("TIMESYNC", ts1=313131),
        ),
    ),
    Row(
        name="its own TIMESYNC requests have tc1 0",
        section=LINK,
        start=State.ARMABLE,
        steps=(sees("TIMESYNC", 0.3, tc1=0, ts1=Other(0)),),
    ),
    Row(
        name="PING is echoed to its sender",
        section=LINK,
        start=State.ARMABLE,
        steps=(
            Send(what=message("PING", time_usec=777, seq=34567)),
            sees("PING", 0.1, time_usec=777, seq=34567, target_system=Between(1, 255), target_component=191),
        ),
    ),
    Row(
        name="a PING to another system is not echoed",
        section=LINK,
        start=State.ARMABLE,
        steps=(
            Send(what=message("PING", time_usec=778, seq=34568, target_system=77, target_component=1)),
            never("PING", time_usec=778),
            Send(what=message("PING", time_usec=779, seq=34569)),
            sees("PING", 0.1, time_usec=779),
        ),
    ),
    Row(
        name="an interval on request: ODOMETRY at 100 Hz",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Command(number=SET_INTERVAL, params=(ODOMETRY, 10000)),
            Rate(name=ODOMETRY, hz=near(100, 12), for_s=1.0),
        ),
    ),
    Row(
        name="an interval on request: ATTITUDE at 250 Hz gives what its loop manages",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Command(number=SET_INTERVAL, params=(ATTITUDE, 4000)),
            Rate(name=ATTITUDE, hz=Between(165.0, 255.0), for_s=1.0),
        ),
    ),
    Row(
        name="interval -1 ends a stream, 0 is its default",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Command(number=SET_INTERVAL, params=(HIGHRES_IMU, -1)),
            Wait(0.1),
            Mark(),
            never(HIGHRES_IMU, 0.5),
            Command(number=SET_INTERVAL, params=(HIGHRES_IMU, 0)),
            Rate(name=HIGHRES_IMU, hz=near(49.5, 6), for_s=1.0),
        ),
    ),
    Row(
        name="an interval holds for the link it was asked on",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Command(number=SET_INTERVAL, params=(ATTITUDE, 100_000)),
            Wait(0.2),
            Rate(name=ATTITUDE, hz=near(10, 2), for_s=1.0),
            Rate(name=ATTITUDE, hz=near(49.5, 6), for_s=1.0, link=GCS_LINK),
            Command(number=SET_INTERVAL, params=(ATTITUDE, 0)),
        ),
        needs_gcs=True,
    ),
    Row(
        name="an interval of an unknown message fails",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(Command(number=SET_INTERVAL, params=(9999, 10000), ack=FAILED),),
    ),
    Row(
        name="AUTOPILOT_VERSION on request",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Command(number=REQUEST_MESSAGE, params=(148,)),
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
        name="HOME_POSITION on request",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(Command(number=REQUEST_MESSAGE, params=(242,)), sees("HOME_POSITION", 0.2)),
    ),
    Row(
        name="512 for 300 sends PROTOCOL_VERSION",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(Command(number=REQUEST_MESSAGE, params=(PROTOCOL_VERSION,)), sees(PROTOCOL_VERSION, 0.1)),
    ),
    Row(
        name="512 for a message it does not know is denied",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(Command(number=REQUEST_MESSAGE, params=(9999,), ack=DENIED),),
    ),
    Row(
        name="512 for CURRENT_MODE is denied while there is nothing new in it",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(sees("CURRENT_MODE", 0.7), Command(number=REQUEST_MESSAGE, params=(CURRENT_MODE,), ack=DENIED)),
    ),
    Row(
        name="CURRENT_MODE comes twice a second however often it is asked for",
        section=COMMANDS,
        start=State.ARMABLE,
        steps=(
            Command(number=SET_INTERVAL, params=(CURRENT_MODE, 10000)),
            Rate(name="CURRENT_MODE", hz=near(2.0, 0.3), for_s=4.0),
        ),
    ),
    Row(
        name="the id of a text counts up",
        section=LINK,
        start=State.ARMABLE,
        steps=(
            arm(),
            sees("STATUSTEXT", 0.3, link=TEXT_LINK, id=Between(1, 65535)),
            disarm(),
            sees("STATUSTEXT", 0.3, link=TEXT_LINK, id=Between(2, 65535)),
        ),
    ),
    Row(
        name="heartbeats of ours are not needed",
        section=LINK,
        start=State.ARMED,
        steps=(PauseHeartbeats("offboard"), Wait(1.5), always("HEARTBEAT", 3.2, 3, base_mode=157, system_status=4)),
    ),
    Row(
        name="a ground station that falls silent and comes back",
        section="5",
        start=State.ARMED,
        steps=(
            PauseHeartbeats(GCS_LINK),
            Mark(),
            SaysNothing(13.0),  # its loss is not reported
            PauseHeartbeats(GCS_LINK, paused=False),
            Mark(),
            Says(text="GCS connection regained\t", severity=6, within_s=3.0),
        ),
        needs_gcs=True,
    ),
)

ROWS = LINK_ROWS
