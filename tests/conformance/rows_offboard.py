"""Section 4 of the sheet: OFFBOARD by SET_ATTITUDE_TARGET, its loss and return, and which type masks are a stream."""

from __future__ import annotations

import math

from tests.conformance.fields import Between, Other, near
from tests.conformance.vocabulary import (
    CRITICAL,
    HOVER_01,
    M_LAND,
    M_LOITER,
    M_OFFBOARD,
    M_RTL,
    OWN,
    TEMPORARILY_REJECTED,
    Mark,
    Moves,
    Row,
    Says,
    Send,
    State,
    Step,
    Stop,
    Stream,
    Turns,
    Wait,
    always,
    arm,
    disarm,
    go,
    heartbeat,
    mode,
    sees,
    setpoint,
)

ENTRY, LOSS, MASKS = "4 entry", "4 loss", "4 type_mask"
CHECK_S = 0.115  # the loss is looked for about every 100 ms
RETURN_S = 0.048  # 22-47 ms measured
LOST_TEXT = Says(text="Failsafe activated\t", severity=CRITICAL)


def about(axis: str, angle_deg: float) -> tuple[float, float, float, float]:
    """Quaternion of one rotation."""
    half = math.radians(angle_deg) / 2
    parts = {"roll": 1, "pitch": 2, "yaw": 3}
    q = [math.cos(half), 0.0, 0.0, 0.0]
    q[parts[axis]] = math.sin(half)
    return q[0], q[1], q[2], q[3]


def tilted(angle_deg: float) -> Stream:
    """A roll that keeps the height as well as one thrust can."""
    return Stream(setpoint(min(1.0, HOVER_01 / math.cos(math.radians(angle_deg))), about("roll", angle_deg)), 100.0)


def lost(after_s: float, to: int, checked_s: float = CHECK_S) -> tuple[Step, ...]:
    """The stream ends and the mode changes when it is due."""
    return Stop(), Turns(value=to, low_s=after_s + 0.005, high_s=after_s + checked_s)


ENTRY_ROWS = (
    Row(
        name="OFFBOARD is accepted disarmed without a stream, and arming is refused then",
        section=ENTRY,
        start=State.ARMABLE,
        steps=(go(6), mode(M_OFFBOARD), arm(TEMPORARILY_REJECTED)),
    ),
    *(
        Row(
            name=f"{count} setpoint{'s' * (count > 1)} {gap_s * 1e3:g} ms ahead are enough to enter armed",
            section=ENTRY,
            start=State.ARMED,
            steps=(Send(what=setpoint(), times=count, every_s=0.02), Wait(gap_s), go(6), mode(M_OFFBOARD)),
        )
        for count, gap_s in ((1, 0.005), (1, 0.5), (2, 0.1), (5, 0.02))
    ),
    Row(
        name="a setpoint older than COM_OF_LOSS_T is not enough",
        section=ENTRY,
        start=State.ARMED,
        steps=(Send(what=setpoint()), Wait(1.3), go(6, ack=TEMPORARILY_REJECTED), mode(M_LOITER)),
    ),
    Row(
        name="1.1 Hz holds OFFBOARD",  # at 1.0 Hz milliseconds decide
        section=ENTRY,
        start=State.OFFBOARD,
        steps=(Stream(setpoint(HOVER_01), 1.1), always("CURRENT_MODE", 5.0, 9, custom_mode=M_OFFBOARD)),
    ),
    Row(
        name="2 Hz holds OFFBOARD",
        section=ENTRY,
        start=State.OFFBOARD,
        steps=(Stream(setpoint(HOVER_01), 2.0), always("CURRENT_MODE", 3.0, 5, custom_mode=M_OFFBOARD)),
    ),
    Row(
        name="0.9 Hz loses OFFBOARD",
        section=ENTRY,
        start=State.OFFBOARD,
        steps=(Stream(setpoint(HOVER_01), 0.9), sees("CURRENT_MODE", 6.0, custom_mode=Other(M_OFFBOARD))),
    ),
    Row(
        name="no ground station and no radio for 13 s is no failsafe",
        section=ENTRY,
        start=State.OFFBOARD,
        steps=(always("CURRENT_MODE", 13.0, 25, custom_mode=M_OFFBOARD), heartbeat(system_status=4)),
    ),
    *(
        Row(
            name=f"a stream to {who} {'flies' if flies else 'is dropped: OFFBOARD times out'}",
            section=ENTRY,
            start=State.OFFBOARD,
            steps=(
                Stream(setpoint(HOVER_01, target=target)),
                always("CURRENT_MODE", 2.0, 3, custom_mode=M_OFFBOARD)
                if flies
                else Turns(value=M_RTL, low_s=0.95, high_s=1.2),
            ),
        )
        for who, target, flies in (
            ("another system", (77, 1), False),
            ("component 250", (OWN, 250), False),
            ("component 0", (OWN, 0), True),
            ("system 0", (0, 0), True),
        )
    ),
    Row(
        name="OFFBOARD then arm",
        section=ENTRY,
        start=State.ARMABLE,
        steps=(Stream(setpoint()), go(6), Wait(0.1), arm(), heartbeat(base_mode=145, custom_mode=M_OFFBOARD)),
    ),
    Row(
        name="arm then OFFBOARD",
        section=ENTRY,
        start=State.ARMED,
        steps=(Stream(setpoint()), go(6), heartbeat(base_mode=145, custom_mode=M_OFFBOARD)),
    ),
)

# COM_OBL_RC_ACT: name, where to
LOSS_ACTIONS = {
    0: ("Position", M_RTL),
    1: ("Altitude", M_RTL),
    2: ("Stabilized", M_RTL),
    3: ("Return", M_RTL),
    4: ("Land", M_LAND),
    5: ("Hold", M_LOITER),
}

LOSS_ROWS = (
    *(
        Row(
            name=f"stream stops, COM_OBL_RC_ACT {action} {name}",
            section=LOSS,
            start=State.OFFBOARD,
            steps=(
                *lost(1.0, to),
                sees("CURRENT_MODE", custom_mode=to, intended_custom_mode=M_OFFBOARD, within_s=1.3),
                Says(text="Failsafe activated\t", severity=CRITICAL, within_s=1.4),
                sees("HEARTBEAT", 2.3, base_mode=157, custom_mode=to, system_status=5),
            ),
            params={"COM_OBL_RC_ACT": action},
        )
        for action, (name, to) in LOSS_ACTIONS.items()
    ),
    *(
        Row(
            name=f"COM_OF_LOSS_T {limit_s}",
            section=LOSS,
            start=State.OFFBOARD,
            steps=lost(limit_s, M_RTL),
            params={"COM_OF_LOSS_T": limit_s},
        )
        for limit_s in (0.5, 0.2, 0.1, 0.05)
    ),
    Row(
        name="COM_OF_LOSS_T 0.2 with Hold",
        section=LOSS,
        start=State.OFFBOARD,
        steps=lost(0.2, M_LOITER),
        params={"COM_OF_LOSS_T": 0.2, "COM_OBL_RC_ACT": 5},
    ),
    Row(
        name="Hold keeps the height",
        section=LOSS,
        start=State.OFFBOARD,
        # Measured 0.11 to 0.21 m, and once 0.31 m while the estimate of the height wandered by as much on the ground.
        steps=(*lost(1.0, M_LOITER), Wait(1.0), Mark(), Moves("height_change_m", Between(0.0, 0.5), 3.0)),
        params={"COM_OBL_RC_ACT": 5},
    ),
    Row(
        name="RTL above home descends at once",
        section=LOSS,
        start=State.OFFBOARD,
        steps=(*lost(1.0, M_RTL), Wait(1.5), Mark(), Moves("height_change_m", Between(0.8, 4.0), 2.0)),
    ),
    Row(
        name="COM_OBL_RC_ACT 6 Terminate: motors off, mode stays, commands rejected",
        section=LOSS,
        start=State.OFFBOARD,
        steps=(
            Stop(),
            Says(text="Failsafe activated\t", severity=CRITICAL, within_s=1.5),
            sees("SERVO_OUTPUT_RAW", 1.5, after_s=1.0, servo1_raw=900, servo4_raw=900),
            sees("HEARTBEAT", 2.5, custom_mode=M_OFFBOARD, system_status=8),
            go(4, 3, ack=TEMPORARILY_REJECTED),
            Stream(setpoint(HOVER_01)),
            always("SERVO_OUTPUT_RAW", 1.0, 10, servo1_raw=900, servo4_raw=900),
        ),
        params={"COM_OBL_RC_ACT": 6},
        real_px4="a reduced build says so and flies on",
        spoils=True,
    ),
    Row(
        name="COM_OBL_RC_ACT 7 Disarm: disarmed in the air, mode stays",
        section=LOSS,
        start=State.OFFBOARD,
        steps=(
            Stop(),
            Says(text="Disarmed by failsafe\t", severity=6, within_s=1.5),
            sees("SERVO_OUTPUT_RAW", 1.5, after_s=1.0, servo1_raw=900, servo4_raw=900),
            sees("HEARTBEAT", 2.5, base_mode=17, custom_mode=M_OFFBOARD),
            Stream(setpoint(HOVER_01)),
            always("SERVO_OUTPUT_RAW", 1.0, 10, servo1_raw=900, servo4_raw=900),
        ),
        params={"COM_OBL_RC_ACT": 7},
        spoils=True,
    ),
    Row(
        name="until the timeout the last setpoint is flown",
        section=LOSS,
        start=State.OFFBOARD,
        steps=(
            tilted(8.0),
            Wait(1.0),
            Stop(),
            Wait(0.5),
            Mark(),
            always("ATTITUDE", 0.3, 20, roll=near(math.radians(8.0), 0.035)),
        ),
    ),
    *(
        Row(
            name=f"OFFBOARD comes back by itself, {wait_s:g} s into {name}",
            section=LOSS,
            start=State.OFFBOARD,
            steps=(
                *lost(1.0, to),
                Wait(wait_s),
                Stream(setpoint(HOVER_01)),
                Turns(value=M_OFFBOARD, low_s=0.0, high_s=RETURN_S),
            ),
            params={"COM_OBL_RC_ACT": action},
        )
        for action, name, to, wait_s in ((0, "RTL", M_RTL, 1.0), (4, "LAND", M_LAND, 1.0), (5, "LOITER", M_LOITER, 7.0))
    ),
    Row(
        name="a return ends the failsafe",
        section=LOSS,
        start=State.OFFBOARD,
        steps=(
            *lost(1.0, M_LOITER),
            Stream(setpoint(HOVER_01)),
            Turns(value=M_OFFBOARD, low_s=0.0, high_s=RETURN_S),
            heartbeat(base_mode=145, custom_mode=M_OFFBOARD, system_status=4),
        ),
        params={"COM_OBL_RC_ACT": 5},
    ),
    Row(
        name="commanding another mode cancels the return",
        section=LOSS,
        start=State.OFFBOARD,
        steps=(
            *lost(1.0, M_RTL),
            go(4, 3),
            mode(M_LOITER, M_LOITER),
            heartbeat(custom_mode=M_LOITER, system_status=4),
            Stream(setpoint(HOVER_01)),
            always("CURRENT_MODE", 1.0, 1, custom_mode=M_LOITER, intended_custom_mode=M_LOITER),
        ),
    ),
    Row(
        name="commanding HOLD while streaming leaves OFFBOARD for good",
        section=LOSS,
        start=State.OFFBOARD,
        steps=(
            go(4, 3),
            Turns(value=M_LOITER, low_s=0.0, high_s=0.1),
            always("CURRENT_MODE", 1.0, 1, custom_mode=M_LOITER),
        ),
    ),
    Row(
        name="disarming on the ground stays in OFFBOARD",
        section=LOSS,
        start=State.GROUND_OFFBOARD,
        steps=(disarm(), always("HEARTBEAT", 2.2, 2, base_mode=17)),
    ),
)

FLOWN_MASKS = (7, 0, 1, 2, 3, 4, 5, 6, 128, 132, 32, 39, 15, 23)
IGNORED_MASKS = (129, 130, 131, 135, 192, 64, 71)
MASK_ROWS = (
    *(
        Row(
            name=f"type_mask {mask} counts as a stream",
            section=MASKS,
            start=State.ARMED,
            steps=(Stream(setpoint(mask=mask)), Wait(0.1), go(6), mode(M_OFFBOARD)),
        )
        for mask in FLOWN_MASKS
    ),
    *(
        Row(
            name=f"type_mask {mask} counts as no stream",
            section=MASKS,
            start=State.ARMED,
            steps=(
                Stream(setpoint(mask=mask)),
                Wait(0.1),
                go(6, ack=TEMPORARILY_REJECTED),
                mode(M_LOITER),
            ),
        )
        for mask in IGNORED_MASKS
    ),
    Row(
        name="type_mask 32 ignores thrust: without thrust_body it falls",
        section=MASKS,
        start=State.OFFBOARD,
        steps=(Stream(setpoint(HOVER_01, mask=39)), Moves("acceleration_down_m_s2", Between(6.0, 10.0), 0.75)),
    ),
    Row(
        name="type_mask 128 flies rates",
        section=MASKS,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(HOVER_01, mask=128, rates_rad_s=(0.0, 0.0, 0.5)), 100.0),
            sees("ATTITUDE", 1.5, yawspeed=near(0.5, 0.1)),
        ),
    ),
)

ROWS = (*ENTRY_ROWS, *LOSS_ROWS, *MASK_ROWS)
