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


@dataclass(frozen=True, slots=True, kw_only=True)
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
    Item(command=TAKEOFF, up_m=3.0),
    Item(command=WAYPOINT, lat_e7=LAT_E7 + NORTH_8_M, up_m=4.0, param1=1.0),
    Item(command=LAND, lat_e7=LAT_E7 + NORTH_8_M),
)
AROUND = (Item(command=WAYPOINT, lat_e7=LAT_E7 + NORTH_8_M, up_m=6.0), Item(command=WAYPOINT, up_m=6.0))


def addressed(name: str, **fields: object) -> Send:
    return Send(what=message(name, target_system=OWN, target_component=1, **fields))


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
    steps: list[Step] = [Wait(0.3)]  # PX4 acknowledges a list before its navigator has told how long it is
    steps += [addressed("MISSION_REQUEST_LIST"), sees("MISSION_COUNT", count=len(items), mission_type=0)]
    for seq, what in enumerate(items):
        steps += [
            addressed("MISSION_REQUEST_INT", seq=seq),
            sees(
                "MISSION_ITEM_INT",
                seq=seq,
                command=what.command,
                frame=FRAME_RELATIVE_INT,
                param1=what.param1,
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
        name="a mission goes up and comes down as it was",
        section=TRANSFER,
        start=State.ARMABLE,
        steps=(*upload(UP_OVER_AND_LAND), *download(UP_OVER_AND_LAND), *clear()),
    ),
    Row(name="an empty vehicle has no mission", section=TRANSFER, start=State.ARMABLE, steps=(*clear(), *download(()))),
    Row(
        name="a mission of nothing clears",
        section=TRANSFER,
        start=State.ARMABLE,
        steps=(*upload(AROUND), *upload(()), *download(())),
    ),
    Row(
        name="MISSION_CURRENT counts what is there",
        section=TRANSFER,
        start=State.ARMABLE,
        steps=(*upload(AROUND), Mark(), sees("MISSION_CURRENT", 1.2, seq=0, total=2), *clear()),
    ),
    Row(
        name="an item that was lost is asked for again",
        section=TRANSFER,
        start=State.ARMABLE,
        steps=(
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
        name="more items than there is room for",
        section=TRANSFER,
        start=State.ARMABLE,
        steps=(addressed("MISSION_COUNT", count=65000), sees("MISSION_ACK", type=NO_SPACE), *download(())),
    ),
    Row(
        name="an item that is not there is asked for in vain",
        section=TRANSFER,
        start=State.ARMABLE,
        steps=(
            *clear(),
            addressed("MISSION_REQUEST_INT", seq=7),
            never("MISSION_ITEM_INT"),
            never("MISSION_ACK"),
        ),
    ),
    Row(
        name="a mission for another system is not taken",
        section=TRANSFER,
        start=State.ARMABLE,
        steps=(
            *clear(),
            Send(what=message("MISSION_COUNT", target_system=77, target_component=1, count=1)),
            never("MISSION_REQUEST_INT"),
            *download(()),
        ),
    ),
    Row(
        name="MISSION mode is refused without one, armed",
        section=TRANSFER,
        start=State.ARMED,
        steps=(
            *clear(),
            refused_mode(4, 4),
            unavailable("Mission"),
        ),
        needs_gcs=True,
    ),
)

RUN_ROWS = (
    Row(
        name="a mission of take-off, waypoint and landing flies and ends disarmed",
        section=RUN,
        start=State.ARMABLE,
        steps=(
            *upload(UP_OVER_AND_LAND),
            Wait(1.0),  # it is examined
            Command(number=MISSION_START, params=(0.0, 0.0)),
            heartbeat(base_mode=157, custom_mode=M_MISSION, system_status=4),
            sees("MISSION_ITEM_REACHED", 15.0, seq=0),
            sees("MISSION_CURRENT", 16.0, seq=1),
            sees("MISSION_ITEM_REACHED", 30.0, seq=1),
            sees("LOCAL_POSITION_NED", 40.0, x=near(8.0, 1.0), z=near(0.0, 0.3)),
            sees("HEARTBEAT", 45.0, after_s=10.0, base_mode=29),
            *clear(),
        ),
        params={"NAV_ACC_RAD": 2.0},
    ),
    Row(
        name="MISSION from LOITER, left by HOLD, taken up again where it was",
        section=RUN,
        start=State.LOITER,
        steps=(
            *upload((*AROUND, Item(command=RTL, lat_e7=0, lon_e7=0, up_m=0.0, frame=FRAME_MISSION))),
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
            sees("CURRENT_MODE", 21.0, custom_mode=M_RTL),
            *clear(),
        ),
        params={"NAV_ACC_RAD": 2.0},
        spoils=True,  # PX4 in HOLD goes on to the height at which a return has begun to climb
    ),
    Row(
        name="DO_REPOSITION flies there in LOITER",
        section=RUN,
        start=State.LOITER,
        steps=(
            Command(
                number=REPOSITION,
                params=(-1.0, 1.0, 0.0, NAN, float(LAT_E7 + NORTH_8_M), float(LON_E7), 495.4),
                as_int=True,
            ),
            mode(M_LOITER),
            # The height is above sea level, and the vehicle's origin as high as its GPS said when it started.
            sees("LOCAL_POSITION_NED", 15.0, x=near(8.0, 0.8), y=near(0.0, 0.8), z=near(-6.0, 1.6)),
        ),
    ),
    Row(
        name="HOLD while a return climbs goes on to climb",
        section=RUN,
        start=State.LOITER,
        steps=(
            Command(
                number=REPOSITION,
                params=(-1.0, 1.0, 0.0, NAN, float(LAT_E7 + NORTH_8_M), float(LON_E7), 495.4),
                as_int=True,
            ),
            sees("LOCAL_POSITION_NED", 15.0, x=near(8.0, 0.8), y=near(0.0, 0.8)),
            go(4, 5),
            mode(M_RTL),
            Wait(1.3),
            go(4, 3),
            mode(M_LOITER),
            Mark(),
            Moves("climb_m", Between(6.0, 24.0), 6.0),
            heartbeat(custom_mode=M_LOITER),
        ),
        params={"RTL_RETURN_ALT": 30.0, "RTL_CONE_ANG": 0},
        spoils=True,
    ),
)

FENCE_ROWS = (
    Row(
        name="height fence with Hold: OFFBOARD is left",
        section=FENCE,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(0.6)),
            sees("CURRENT_MODE", 6.0, custom_mode=M_LOITER),
            sees("HEARTBEAT", 7.5, custom_mode=M_LOITER, system_status=5),
        ),
        params={"GF_ACTION": 2, "GF_MAX_VER_DIST": 9.0},
    ),
    Row(
        name="height fence with Return",
        section=FENCE,
        start=State.OFFBOARD,
        steps=(Stream(setpoint(0.6)), sees("CURRENT_MODE", 13.0, custom_mode=M_RTL)),
        params={"GF_ACTION": 3, "GF_MAX_VER_DIST": 9.0},
    ),
    Row(
        name="height fence that only warns",
        section=FENCE,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(0.6)),
            Wait(4.0),
            Stream(setpoint(HOVER_01)),
            always("CURRENT_MODE", 1.5, 2, custom_mode=M_OFFBOARD),
            Moves("height_m", Between(9.0, 30.0), 1.5),
        ),
        params={"GF_ACTION": 1, "GF_MAX_VER_DIST": 9.0},
    ),
    Row(
        name="a fence goes up by the mission protocol",
        section=FENCE,
        start=State.ARMABLE,
        steps=(
            *upload(
                tuple(
                    Item(command=INCLUSION, lat_e7=LAT_E7 + n, lon_e7=LON_E7 + e, up_m=0.0, param1=4.0, kind=FENCE_KIND)
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
        name="a critical battery lands, after a while in Hold",
        section=BATTERY,
        start=State.LOITER,
        steps=(
            SetParam("BAT_LOW_THR", 3.0),
            SetParam("BAT_CRIT_THR", 2.0),
            Mark(),
            sees("BATTERY_STATUS", 3.0, charge_state=3),
            Turns(value=M_LAND, low_s=3.0, high_s=8.0),
            sees("HEARTBEAT", 9.5, custom_mode=M_LAND, system_status=5),
        ),
        params={"COM_LOW_BAT_ACT": 2},
        spoils=True,  # the battery stays critical for a while after its limits are put back: PX4 then returns
    ),
    Row(
        name="a critical battery only warns unless told otherwise",
        section=BATTERY,
        start=State.LOITER,
        steps=(
            SetParam("BAT_LOW_THR", 3.0),
            SetParam("BAT_CRIT_THR", 2.0),
            always("CURRENT_MODE", 7.0, 13, custom_mode=M_LOITER),
        ),
        params={"COM_LOW_BAT_ACT": 0},
        spoils=True,  # the battery stays critical for a while, as in the row before
    ),
)

ROWS = (*TRANSFER_ROWS, *RUN_ROWS, *FENCE_ROWS, *BATTERY_ROWS)
