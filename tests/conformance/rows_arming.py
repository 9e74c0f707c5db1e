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
DENIED_HEALTH = Says("Arming denied: Resolve system health failures first\t", CRITICAL)
PREARM = 0x10000000
EXTENDED = "EXTENDED_SYS_STATE"


def refused_mode(main: int, sub: int = 0) -> Command:
    """DO_SET_MODE from the ground station: only its component receives the reason of a refusal."""
    return Command(SET_MODE, (1, main, sub), TEMPORARILY_REJECTED, link=GCS_LINK)


def unavailable(name: str) -> Says:
    return Says(f"Switching to {name} is currently not available\t", CRITICAL)


ARMING_ROWS = (
    Row(
        "arming is refused before the estimator is ready, with a text",
        REFUSALS,
        State.BOOTING,
        (At(2.9), arm(TEMPORARILY_REJECTED), DENIED_HEALTH),
    ),
    Row(
        "arming is refused 3.5 s after start and accepted at 4.2 s",
        ARMING,
        State.BOOTING,
        (At(3.5), arm(TEMPORARILY_REJECTED), At(4.2), arm()),
        not_by_url="the start is not seen from outside",
    ),
    Row(
        "HOME_POSITION first comes 3.8 s after start",
        "7",
        State.BOOTING,
        (First("HOME_POSITION", 3.5, 5.0),),
        not_by_url="the start is not seen from outside",
    ),
    Row(
        "take-off: accepted disarmed, then armed: 1-3-2, LOITER after 7.8 s at 2.5 m",
        ARMING,
        State.ARMABLE,
        (
            Command(TAKEOFF, ALL_NAN),
            arm(),
            Says("Using default takeoff altitude: 2.5 m\t", INFO),
            Turns(3, 1.3, 2.7, EXTENDED, "landed_state"),
            Says("Takeoff detected\t", INFO, 3.5),
            Turns(M_LOITER, 6.3, 9.3),
            Passes(EXTENDED, "landed_state", (1, 3, 2), 10.0),
            Mark(),
            Moves("height_m", near(2.5, 0.4), 1.0),
        ),
    ),
    Row(
        "take-off to 30 m takes 20 to 22 s",
        ARMING,
        State.ARMABLE,
        (
            Command(TAKEOFF, ALL_NAN),
            arm(),
            Turns(M_LOITER, 19.0, 23.0),
            Moves("height_m", near(30.0, 1.5), 24.5),
        ),
        {"MIS_TAKEOFF_ALT": 30.0},
    ),
    Row(
        "a whole AUTO flight: 1-3-2-4-1, disarmed 2.0 to 3.3 s after touchdown",
        ARMING,
        State.ARMED,
        (
            SetParam("MIS_TAKEOFF_ALT", 1.5),
            Command(TAKEOFF, ALL_NAN),
            Passes(EXTENDED, "landed_state", (1, 3, 2), 12.0),
            Command(LAND),
            Says("Landing at current position\t", INFO),
            Says("Landing detected\t", INFO, 15.0),
            Passes(EXTENDED, "landed_state", (4, 1), 10.0),
            Mark(),
            Says("Disarmed by landing\t", INFO, 3.6),
            heartbeat(4.6, base_mode=29, custom_mode=M_LOITER),
        ),
    ),
    Row(
        "disarmed by itself 11 s after arming in LOITER",
        ARMING,
        State.ARMABLE,
        (
            arm(),
            Says("Armed by external command\t", INFO),
            Says("Disarmed by auto preflight disarming\t", INFO, 12.0),
            heartbeat(13.0, base_mode=29, custom_mode=M_LOITER),
        ),
    ),
    Row(
        "11 s is 10 s of COM_DISARM_PRFLT and 1 s more",
        ARMING,
        State.ARMABLE,
        (
            arm(),
            always("SERVO_OUTPUT_RAW", 2.8, 100, servo1_raw=Between(1000, 1100)),
            Turns(900, 2.8, 3.3, "SERVO_OUTPUT_RAW", "servo1_raw"),
        ),
        {"COM_DISARM_PRFLT": 2.0},
    ),
    Row(
        "disarmed by itself in OFFBOARD at thrust 0, too",
        ARMING,
        State.ARMABLE,
        (
            Stream(setpoint()),
            go(6),
            arm(),
            Says("Disarmed by auto preflight disarming\t", INFO, 12.0),
            sees("HEARTBEAT", 13.0, after_s=10.5, base_mode=17, custom_mode=M_OFFBOARD),
        ),
    ),
    Row(
        "OFFBOARD, LAND, touchdown: disarmed in OFFBOARD",
        ARMING,
        State.OFFBOARD,
        (
            Stream(setpoint(0.44)),
            Wait(1.0),
            Stop(),
            go(4, 6),
            sees("HEARTBEAT", 25.0, base_mode=17, custom_mode=M_OFFBOARD),
        ),
    ),
)

REFUSAL_ROWS = (
    Row("an unknown command", REFUSALS, State.ARMABLE, (Command(31999, ack=UNSUPPORTED), SaysNothing())),
    *(
        Row(f"command {number} is not supported", "1 commands", State.ARMABLE, (Command(number, ack=UNSUPPORTED),))
        for number in (520, 410)
    ),
    Row(
        "ARM p1=5 gets a text but no ack",
        REFUSALS,
        State.ARMABLE,
        (Command(ARM_DISARM, (5.0,), NO_ACK), Says("Unsupported ARM_DISARM param: 5.000\t", CRITICAL)),
    ),
    *(
        Row(
            f"ARM in OFFBOARD without a stream is refused{name}",
            REFUSALS,
            State.ARMABLE,
            (
                go(6),
                Command(ARM_DISARM, (1.0, magic), TEMPORARILY_REJECTED),
                DENIED_HEALTH,
                heartbeat(base_mode=Bits(off=128)),
            ),
        )
        for name, magic in (("", 0.0), (", also by force", FORCE))
    ),
    Row(
        "ARM in POSCTL without radio is refused",
        REFUSALS,
        State.ARMABLE,
        (go(3), arm(TEMPORARILY_REJECTED), DENIED_HEALTH, heartbeat(base_mode=81)),
    ),
    Row("ARM armed is accepted", REFUSALS, State.ARMED, (arm(), heartbeat(base_mode=157))),
    Row("DISARM disarmed is accepted", REFUSALS, State.ARMABLE, (disarm(), heartbeat(base_mode=29))),
    Row(
        "arming says so",
        REFUSALS,
        State.ARMABLE,
        (arm(), Says("Armed by external command\t", INFO), disarm(), Says("Disarmed by external command\t", INFO)),
    ),
    *(
        Row(
            f"DISARM in the air is refused in {name}",
            REFUSALS,
            start,
            (
                disarm(TEMPORARILY_REJECTED),
                Says("Disarming denied: not landed\t", CRITICAL),
                heartbeat(base_mode=Bits(128)),
            ),
        )
        for name, start in (("LOITER", State.LOITER), ("OFFBOARD", State.OFFBOARD))
    ),
    Row(
        "DISARM in the air by force: it falls",
        REFUSALS,
        State.LOITER,
        (
            disarm(magic=FORCE),
            Says("Disarmed by external command\t", INFO),
            Moves("acceleration_down_m_s2", Between(6.0, 10.0), 0.75),
        ),
        spoils=True,
    ),
    *(
        Row(
            f"{name} is refused armed",
            REFUSALS,
            State.LOITER,
            (Wait(1.2), refused_mode(main, sub), unavailable(name), mode(M_LOITER)),
            needs_gcs=True,
        )
        for name, main, sub in (("Offboard", 6, 0), ("Position", 3, 0), ("Acro", 5, 0), ("Mission", 4, 4))
    ),
    Row("POSCTL is accepted disarmed without radio", REFUSALS, State.ARMABLE, (go(3, ack=ACCEPTED), mode(M_POSCTL))),
    Row(
        "why a mode is refused is not told to an onboard computer",
        REFUSALS,
        State.LOITER,
        (Wait(1.2), go(6, ack=TEMPORARILY_REJECTED), SaysNothing(), mode(M_LOITER)),
    ),
    Row(
        "main mode 99 is refused",
        REFUSALS,
        State.ARMABLE,
        (go(99, ack=TEMPORARILY_REJECTED), Says("Unsupported main mode\t", CRITICAL), mode(M_LOITER)),
    ),
    Row(
        "a mode without the custom flag is refused",
        REFUSALS,
        State.ARMABLE,
        (go(4, 5, ack=TEMPORARILY_REJECTED, flag=0), Says("Unsupported base mode\t", CRITICAL), mode(M_LOITER)),
    ),
    *(
        Row(
            f"{name} by its own command",
            STATE,
            State.LOITER,
            (Command(number), mode(custom)),
        )
        for name, number, custom in (("LAND", LAND, M_LAND), ("RTL", RTL, M_RTL))
    ),
    Row(
        "RTL says where it goes and that it lands",
        REFUSALS,
        State.LOITER,
        (
            go(4, 5),
            Says(r"RTL: start return at \d+ m \(\d+ m above destination\)\t", INFO, is_pattern=True),
            Says("RTL: land at destination\t", INFO, 30.0),
        ),
        {"RTL_RETURN_ALT": 3.0},
    ),
)

ROWS = (*ARMING_ROWS, *REFUSAL_ROWS)
