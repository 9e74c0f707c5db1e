"""Sections 3 and 5 of the sheet: arming, take-off and landing; refusals and texts."""

from __future__ import annotations

from tests.conformance.fields import Between, Bits, near
from tests.conformance.vocabulary import (
    ACCEPTED,
    ARM_DISARM,
    CRITICAL,
    FORCE,
    GCS_LINK,
    INFO,
    LAND,
    M_LAND,
    M_LOITER,
    M_OFFBOARD,
    M_POSCTL,
    M_RTL,
    M_TAKEOFF,
    NAN,
    NO_ACK,
    RTL,
    SET_MODE,
    TAKEOFF,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
    At,
    Command,
    First,
    Mark,
    Moves,
    Passes,
    Row,
    Says,
    SaysNothing,
    SetParam,
    State,
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

STATE, ARMING, REFUSALS = "2 state", "3", "5"
ALL_NAN = (NAN,) * 7
DENIED_HEALTH = Says(text="Arming denied: Resolve system health failures first\t", severity=CRITICAL)
PREARM = 0x10000000
EXTENDED = "EXTENDED_SYS_STATE"


def refused_mode(main: int, sub: int = 0) -> Command:
    """DO_SET_MODE from the ground station: only its component receives the reason of a refusal."""
    return Command(number=SET_MODE, params=(1, main, sub), ack=TEMPORARILY_REJECTED, link=GCS_LINK)


def unavailable(name: str) -> Says:
    return Says(text=f"Switching to {name} is currently not available\t", severity=CRITICAL)


ARMING_ROWS = (
    Row(
        name="arming is refused before the estimator is ready, with a text",
        section=REFUSALS,
        start=State.BOOTING,
        steps=(At(2.9), arm(TEMPORARILY_REJECTED), DENIED_HEALTH),
    ),
    Row(
        name="arming is refused 3.5 s after start and accepted at 4.2 s",
        section=ARMING,
        start=State.BOOTING,
        steps=(At(3.5), arm(TEMPORARILY_REJECTED), At(4.2), arm()),
        not_by_url="the start is not seen from outside",
    ),
    Row(
        name="HOME_POSITION first comes 3.8 s after start",
        section="7",
        start=State.BOOTING,
        steps=(First("HOME_POSITION", 3.5, 5.0),),
        not_by_url="the start is not seen from outside",
    ),
    Row(
        name="take-off: accepted disarmed, then armed: 1-3-2, LOITER after 7.8 s at 2.5 m",
        section=ARMING,
        start=State.ARMABLE,
        steps=(
            Command(number=TAKEOFF, params=ALL_NAN),
            arm(),
            Says(text="Using default takeoff altitude: 2.5 m\t", severity=INFO),
            Turns(value=3, low_s=1.3, high_s=2.7, name=EXTENDED, field="landed_state"),
            Says(text="Takeoff detected\t", severity=INFO, within_s=3.5),
            Turns(value=M_LOITER, low_s=5.5, high_s=9.3),
            Passes(name=EXTENDED, field="landed_state", values=(1, 3, 2), within_s=10.0),
            Mark(),
            Moves("height_above_home_m", near(2.5, 0.4), 4.0),  # it goes on to climb in LOITER
        ),
    ),
    Row(
        name="take-off to 30 m takes 20 to 22 s",
        section=ARMING,
        start=State.ARMABLE,
        steps=(
            Command(number=TAKEOFF, params=ALL_NAN),
            sees("CURRENT_MODE", custom_mode=M_TAKEOFF),  # one of before is on its way while TAKEOFF is acknowledged
            arm(),
            Turns(value=M_LOITER, low_s=19.0, high_s=23.0),
            Moves("height_m", near(30.0, 1.5), 24.5),
        ),
        params={"MIS_TAKEOFF_ALT": 30.0},
    ),
    Row(
        name="a whole AUTO flight: 1-3-2-4-1, disarmed 2.0 to 3.3 s after touchdown",
        section=ARMING,
        start=State.ARMED,
        steps=(
            SetParam("MIS_TAKEOFF_ALT", 1.5),
            Command(number=TAKEOFF, params=ALL_NAN),
            Passes(name=EXTENDED, field="landed_state", values=(1, 3, 2), within_s=12.0),
            Command(number=LAND),
            Says(text="Landing at current position\t", severity=INFO),
            Says(text="Landing detected\t", severity=INFO, within_s=15.0),
            Passes(name=EXTENDED, field="landed_state", values=(4, 1), within_s=15.0),
            Mark(),
            Says(text="Disarmed by landing\t", severity=INFO, within_s=3.6),
            heartbeat(4.6, base_mode=29, custom_mode=M_LOITER),
        ),
    ),
    Row(
        name="disarmed by itself 11 s after arming in LOITER",
        section=ARMING,
        start=State.ARMABLE,
        steps=(
            arm(),
            Says(text="Armed by external command\t", severity=INFO),
            Says(text="Disarmed by auto preflight disarming\t", severity=INFO, within_s=12.0),
            heartbeat(13.0, base_mode=29, custom_mode=M_LOITER),
        ),
    ),
    Row(
        name="11 s is 10 s of COM_DISARM_PRFLT and 1 s more",
        section=ARMING,
        start=State.ARMABLE,
        steps=(
            arm(),
            always("SERVO_OUTPUT_RAW", 2.8, 100, servo1_raw=Between(1000, 1100)),
            Turns(value=900, low_s=2.8, high_s=3.3, name="SERVO_OUTPUT_RAW", field="servo1_raw"),
        ),
        params={"COM_DISARM_PRFLT": 2.0},
    ),
    Row(
        name="disarmed by itself in OFFBOARD at thrust 0, too",
        section=ARMING,
        start=State.ARMABLE,
        steps=(
            Stream(setpoint()),
            go(6),
            arm(),
            Says(text="Disarmed by auto preflight disarming\t", severity=INFO, within_s=12.0),
            sees("HEARTBEAT", 13.0, after_s=10.5, base_mode=17, custom_mode=M_OFFBOARD),
        ),
    ),
    Row(
        name="OFFBOARD, LAND, touchdown: disarmed in OFFBOARD",
        section=ARMING,
        start=State.OFFBOARD,
        steps=(
            Stream(setpoint(0.44)),
            Wait(1.0),
            Stop(),
            go(4, 6),
            sees("HEARTBEAT", 25.0, base_mode=17, custom_mode=M_OFFBOARD, system_status=0),
            Mark(),
            sees("SYS_STATUS", onboard_control_sensors_health=Bits(off=PREARM)),
            arm(TEMPORARILY_REJECTED),
            go(4, 3),
            heartbeat(base_mode=29, system_status=3),
            sees("SYS_STATUS", onboard_control_sensors_health=Bits(PREARM)),
            arm(),
        ),
    ),
)

REFUSAL_ROWS = (
    Row(
        name="an unknown command",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(Command(number=31999, ack=UNSUPPORTED), SaysNothing()),
    ),
    *(
        Row(
            name=f"command {number} is not supported",
            section="1 commands",
            start=State.ARMABLE,
            steps=(Command(number=number, ack=UNSUPPORTED),),
        )
        for number in (520, 410)
    ),
    Row(
        name="ARM p1=5 gets a text but no ack",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(
            Command(number=ARM_DISARM, params=(5.0,), ack=NO_ACK),
            Says(text="Unsupported ARM_DISARM param: 5.000\t", severity=CRITICAL),
            heartbeat(base_mode=29),
        ),
    ),
    *(
        Row(
            name=f"ARM in OFFBOARD without a stream is refused{name}",
            section=REFUSALS,
            start=State.ARMABLE,
            steps=(
                go(6),
                Command(number=ARM_DISARM, params=(1.0, magic), ack=TEMPORARILY_REJECTED),
                DENIED_HEALTH,
                heartbeat(base_mode=Bits(off=128)),
            ),
        )
        for name, magic in (("", 0.0), (", also by force", FORCE))
    ),
    Row(
        name="ARM in POSCTL without radio is refused",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(go(3), arm(TEMPORARILY_REJECTED), DENIED_HEALTH, heartbeat(base_mode=81)),
    ),
    Row(name="ARM armed is accepted", section=REFUSALS, start=State.ARMED, steps=(arm(), heartbeat(base_mode=157))),
    Row(
        name="DISARM disarmed is accepted",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(disarm(), heartbeat(base_mode=29)),
    ),
    Row(
        name="arming says so",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(
            arm(),
            Says(text="Armed by external command\t", severity=INFO),
            disarm(),
            Says(text="Disarmed by external command\t", severity=INFO),
        ),
    ),
    *(
        Row(
            name=f"DISARM in the air is refused in {name}",
            section=REFUSALS,
            start=start,
            steps=(
                disarm(TEMPORARILY_REJECTED),
                Says(text="Disarming denied: not landed\t", severity=CRITICAL),
                heartbeat(base_mode=Bits(128)),
            ),
        )
        for name, start in (("LOITER", State.LOITER), ("OFFBOARD", State.OFFBOARD))
    ),
    Row(
        name="DISARM in the air by force: it falls",
        section=REFUSALS,
        start=State.LOITER,
        steps=(
            disarm(magic=FORCE),
            Says(text="Disarmed by external command\t", severity=INFO),
            Moves("acceleration_down_m_s2", Between(6.0, 10.0), 0.75),
        ),
        spoils=True,
    ),
    *(
        Row(
            name=f"{name} is refused armed",
            section=REFUSALS,
            start=State.LOITER,
            steps=(Wait(1.2), refused_mode(main, sub), unavailable(name), mode(M_LOITER)),
            needs_gcs=True,
        )
        for name, main, sub in (("Offboard", 6, 0), ("Position", 3, 0), ("Acro", 5, 0), ("Mission", 4, 4))
    ),
    Row(
        name="POSCTL is accepted disarmed without radio",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(go(3, ack=ACCEPTED), mode(M_POSCTL)),
    ),
    Row(
        name="why a mode is refused is not told to an onboard computer",
        section=REFUSALS,
        start=State.LOITER,
        steps=(Wait(1.2), go(6, ack=TEMPORARILY_REJECTED), SaysNothing(), mode(M_LOITER)),
    ),
    Row(
        name="main mode 99 is refused",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(
            go(99, ack=TEMPORARILY_REJECTED),
            Says(text="Unsupported main mode\t", severity=CRITICAL),
            mode(M_LOITER),
        ),
    ),
    Row(
        name="a mode without the custom flag is refused",
        section=REFUSALS,
        start=State.ARMABLE,
        steps=(
            go(4, 5, ack=TEMPORARILY_REJECTED, flag=0),
            Says(text="Unsupported base mode\t", severity=CRITICAL),
            mode(M_LOITER),
        ),
    ),
    *(
        Row(
            name=f"{name} by its own command",
            section=STATE,
            start=State.LOITER,
            steps=(Command(number=number), mode(custom)),
        )
        for name, number, custom in (("LAND", LAND, M_LAND), ("RTL", RTL, M_RTL))
    ),
    Row(
        name="RTL says where it goes and that it lands",
        section=REFUSALS,
        start=State.LOITER,
        steps=(
            go(4, 5),
            Says(text=r"RTL: start return at \d+ m \(\d+ m above destination\)\t", severity=INFO, is_pattern=True),
            Says(text="RTL: land at destination\t", severity=INFO, within_s=30.0),
        ),
        params={"RTL_RETURN_ALT": 3.0},
    ),
)

ROWS = (*ARMING_ROWS, *REFUSAL_ROWS)
