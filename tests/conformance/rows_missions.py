"""Missions, geofence, battery: what the sheet leaves to the mission protocol and PX4's documented failsafes."""

from __future__ import annotations

from dataclasses import dataclass

from tests.conformance.fields import Between, near
from tests.conformance.rows_arming import refused_mode, unavailable
from tests.conformance.rows_parameters import LAT_E7, LON_E7
from tests.conformance.vocabulary import (
    HOVER_01,
    M_LAND,
    M_LOITER,
    M_MISSION,
    M_OFFBOARD,
    M_RTL,
    MISSION_START,
    NAN,
    OWN,
    Command,
    Mark,
    Moves,
    Row,
    Send,
    SetParam,
    State,
    Step,
    Stream,
    Turns,
    Wait,
    always,
    go,
    heartbeat,
    message,
    mode,
    never,
    sees,
    setpoint,
)

TRANSFER, RUN, FENCE, BATTERY = "missions", "mission run", "geofence", "battery"
WAYPOINT, TAKEOFF, LAND, RTL, REPOSITION = 16, 22, 21, 20, 192
FRAME_MISSION, FRAME_RELATIVE_INT = 2, 6
NORTH_8_M = 8 * 90  # 1e-7 deg: 0.0111 m each
ACCEPTED_MISSION, NO_SPACE = 0, 4
FENCE_KIND, INCLUSION = 1, 5001


@dataclass(frozen=True, slots=True)
class Item:
    """A mission item: command, place over home, and what it needs."""

    command: int
    lat_e7: int = LAT_E7
    lon_e7: int = LON_E7
    up_m: float = 5.0
    param1: float = 0.0
    kind: int = 0
    frame: int = FRAME_RELATIVE_INT


UP_OVER_AND_LAND = (
    Item(TAKEOFF, up_m=3.0),
    Item(WAYPOINT, LAT_E7 + NORTH_8_M, up_m=4.0),
    Item(LAND, LAT_E7 + NORTH_8_M),
)
AROUND = (Item(WAYPOINT, LAT_E7 + NORTH_8_M, up_m=6.0), Item(WAYPOINT, up_m=6.0))


def addressed(name: str, **fields: object) -> Send:
    return Send(message(name, target_system=OWN, target_component=1, **fields))


def item(seq: int, what: Item) -> Send:
    return addressed(
        "MISSION_ITEM_INT",
        seq=seq,
        frame=what.frame,
        command=what.command,
        current=int(seq == 0),
        autocontinue=1,
        param1=what.param1,
        param4=NAN if what.kind == 0 else 0.0,
        x=what.lat_e7,
        y=what.lon_e7,
        z=what.up_m,
        mission_type=what.kind,
    )


def upload(items: tuple[Item, ...], kind: int = 0) -> tuple[Step, ...]:
    """Announced, asked for one by one, acknowledged."""
    steps: list[Step] = [addressed("MISSION_COUNT", count=len(items), mission_type=kind)]
    for seq, what in enumerate(items):
        steps += [sees("MISSION_REQUEST_INT", 1.5, seq=seq, mission_type=kind), item(seq, what)]
    return *steps, sees("MISSION_ACK", type=ACCEPTED_MISSION, mission_type=kind)


def download(items: tuple[Item, ...]) -> tuple[Step, ...]:
    steps: list[Step] = [addressed("MISSION_REQUEST_LIST"), sees("MISSION_COUNT", count=len(items), mission_type=0)]
    for seq, what in enumerate(items):
        steps += [
            addressed("MISSION_REQUEST_INT", seq=seq),
            sees(
                "MISSION_ITEM_INT",
                seq=seq,
                command=what.command,
                frame=FRAME_RELATIVE_INT,
                x=what.lat_e7,
                y=what.lon_e7,
                z=what.up_m,
            ),
        ]
    return *steps, addressed("MISSION_ACK", type=ACCEPTED_MISSION), never("MISSION_ACK", 0.2)


def clear(kind: int = 0) -> tuple[Step, ...]:
    return addressed("MISSION_CLEAR_ALL", mission_type=kind), sees("MISSION_ACK", type=0, mission_type=kind)


TRANSFER_ROWS = (
    Row(
        "a mission goes up and comes down as it was",
        TRANSFER,
        State.ARMABLE,
        (*upload(UP_OVER_AND_LAND), *download(UP_OVER_AND_LAND), *clear()),
    ),
    Row("an empty vehicle has no mission", TRANSFER, State.ARMABLE, (*clear(), *download(()))),
    Row("a mission of nothing clears", TRANSFER, State.ARMABLE, (*upload(AROUND), *upload(()), *download(()))),
    Row(
        "MISSION_CURRENT counts what is there",
        TRANSFER,
        State.ARMABLE,
        (*upload(AROUND), Mark(), sees("MISSION_CURRENT", 1.2, seq=0, total=2), *clear()),
    ),
    Row(
        "an item that was lost is asked for again",
        TRANSFER,
        State.ARMABLE,
        (
            addressed("MISSION_COUNT", count=1),
            sees("MISSION_REQUEST_INT", seq=0),
            Wait(0.1),
            Mark(),
            sees("MISSION_REQUEST_INT", 0.6, seq=0),
            item(0, AROUND[0]),
            sees("MISSION_ACK", type=0),
            *clear(),
        ),
    ),
    Row(
        "more items than there is room for",
        TRANSFER,
        State.ARMABLE,
        (addressed("MISSION_COUNT", count=65000), sees("MISSION_ACK", type=NO_SPACE), *download(())),
    ),
    Row(
        "an item that is not there is asked for in vain",
        TRANSFER,
        State.ARMABLE,
        (
            *clear(),
            addressed("MISSION_REQUEST_INT", seq=7),
            never("MISSION_ITEM_INT"),
            never("MISSION_ACK"),
        ),
    ),
    Row(
        "a mission for another system is not taken",
        TRANSFER,
        State.ARMABLE,
        (
            *clear(),
            Send(message("MISSION_COUNT", target_system=77, target_component=1, count=1)),
            never("MISSION_REQUEST_INT"),
            *download(()),
        ),
    ),
    Row(
        "MISSION mode is refused without one, armed",
        TRANSFER,
        State.ARMED,
        (
            *clear(),
            refused_mode(4, 4),
            unavailable("Mission"),
        ),
        needs_gcs=True,
    ),
)

RUN_ROWS = (
    Row(
        "a mission of take-off, waypoint and landing flies and ends disarmed",
        RUN,
        State.ARMABLE,
        (
            *upload(UP_OVER_AND_LAND),
            Wait(1.0),  # it is examined
            Command(MISSION_START, (0.0, 0.0)),
            heartbeat(base_mode=157, custom_mode=M_MISSION, system_status=4),
            sees("MISSION_ITEM_REACHED", 15.0, seq=0),
            sees("MISSION_CURRENT", 16.0, seq=1),
            sees("MISSION_ITEM_REACHED", 30.0, seq=1),
            sees("LOCAL_POSITION_NED", 40.0, x=near(8.0, 1.0), z=near(0.0, 0.3)),
            sees("HEARTBEAT", 45.0, after_s=10.0, base_mode=29),
            *clear(),
        ),
        {"NAV_ACC_RAD": 2.0},
    ),
    Row(
        "MISSION from LOITER, left by HOLD, taken up again where it was",
        RUN,
        State.LOITER,
        (
            *upload((*AROUND, Item(RTL, 0, 0, 0.0, frame=FRAME_MISSION))),
            Wait(1.0),  # it is examined
            go(4, 4),
            mode(M_MISSION),
            sees("MISSION_ITEM_REACHED", 20.0, seq=0),
            go(4, 3),
            mode(M_LOITER),
            sees("MISSION_CURRENT", 1.5, seq=1),
            go(4, 4),
            mode(M_MISSION),
            sees("MISSION_ITEM_REACHED", 20.0, seq=Between(1, 2)),  # a return has no place to reach
            *clear(),
        ),
        {"NAV_ACC_RAD": 2.0},
    ),
    Row(
        "DO_REPOSITION flies there in LOITER",
        RUN,
        State.LOITER,
        (
            Command(REPOSITION, (-1.0, 1.0, 0.0, NAN, float(LAT_E7 + NORTH_8_M), float(LON_E7), 495.4), as_int=True),
            mode(M_LOITER),
            sees("LOCAL_POSITION_NED", 15.0, x=near(8.0, 0.8), y=near(0.0, 0.8), z=near(-6.0, 0.8)),
        ),
    ),
)

FENCE_ROWS = (
    Row(
        "height fence with Hold: OFFBOARD is left",
        FENCE,
        State.OFFBOARD,
        (
            Stream(setpoint(0.6)),
            sees("CURRENT_MODE", 6.0, custom_mode=M_LOITER),
            sees("HEARTBEAT", 7.5, custom_mode=M_LOITER, system_status=5),
        ),
        {"GF_ACTION": 2, "GF_MAX_VER_DIST": 9.0},
    ),
    Row(
        "height fence with Return",
        FENCE,
        State.OFFBOARD,
        (Stream(setpoint(0.6)), sees("CURRENT_MODE", 13.0, custom_mode=M_RTL)),
        {"GF_ACTION": 3, "GF_MAX_VER_DIST": 9.0},
    ),
    Row(
        "height fence that only warns",
        FENCE,
        State.OFFBOARD,
        (
            Stream(setpoint(0.6)),
            Wait(4.0),
            Stream(setpoint(HOVER_01)),
            always("CURRENT_MODE", 1.5, 2, custom_mode=M_OFFBOARD),
            Moves("height_m", Between(9.0, 30.0), 1.5),
        ),
        {"GF_ACTION": 1, "GF_MAX_VER_DIST": 9.0},
    ),
    Row(
        "a fence goes up by the mission protocol",
        FENCE,
        State.ARMABLE,
        (
            *upload(
                tuple(
                    Item(INCLUSION, LAT_E7 + n, LON_E7 + e, 0.0, 4.0, FENCE_KIND)
                    for n, e in ((-9000, -9000), (9000, -9000), (9000, 9000), (-9000, 9000))
                ),
                FENCE_KIND,
            ),
            addressed("MISSION_REQUEST_LIST", mission_type=FENCE_KIND),
            sees("MISSION_COUNT", count=4, mission_type=FENCE_KIND),
            addressed("MISSION_ACK", type=ACCEPTED_MISSION, mission_type=FENCE_KIND),
            Wait(0.2),
            *clear(FENCE_KIND),
        ),
    ),
)

BATTERY_ROWS = (
    Row(
        "a critical battery lands, after a while in Hold",
        BATTERY,
        State.LOITER,
        (
            SetParam("BAT_LOW_THR", 3.0),
            SetParam("BAT_CRIT_THR", 2.0),
            Mark(),
            sees("BATTERY_STATUS", 3.0, charge_state=3),
            Turns(M_LAND, 3.0, 8.0),
            sees("HEARTBEAT", 9.5, custom_mode=M_LAND, system_status=5),
        ),
        {"COM_LOW_BAT_ACT": 2},
    ),
    Row(
        "a critical battery only warns unless told otherwise",
        BATTERY,
        State.LOITER,
        (
            SetParam("BAT_LOW_THR", 3.0),
            SetParam("BAT_CRIT_THR", 2.0),
            always("CURRENT_MODE", 7.0, 13, custom_mode=M_LOITER),
        ),
        {"COM_LOW_BAT_ACT": 0},
    ),
)

ROWS = (*TRANSFER_ROWS, *RUN_ROWS, *FENCE_ROWS, *BATTERY_ROWS)
