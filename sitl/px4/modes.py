"""PX4's modes in MAVLink: custom_mode numbers, base_mode, MAV_STATE. Tables only."""

from __future__ import annotations

import enum

from swarmctl.core.types import FlightMode


def _main(number: int, sub: int = 0) -> int:
    return number << 16 | sub << 24


class Px4Mode(enum.IntEnum):
    """custom_mode of HEARTBEAT: main << 16 | sub << 24."""

    MANUAL = _main(1)
    ALTCTL = _main(2)
    POSCTL = _main(3)
    AUTO_TAKEOFF = _main(4, 2)
    AUTO_LOITER = _main(4, 3)
    AUTO_MISSION = _main(4, 4)
    AUTO_RTL = _main(4, 5)
    AUTO_LAND = _main(4, 6)
    ACRO = _main(5)
    OFFBOARD = _main(6)
    STABILIZED = _main(7)
    TERMINATION = _main(10)


MODE_NAMES = {  # names in PX4's refusals
    Px4Mode.MANUAL: "Manual",
    Px4Mode.ALTCTL: "Altitude",
    Px4Mode.POSCTL: "Position",
    Px4Mode.ACRO: "Acro",
    Px4Mode.STABILIZED: "Stabilized",
    Px4Mode.OFFBOARD: "Offboard",
    Px4Mode.AUTO_TAKEOFF: "Takeoff",
    Px4Mode.AUTO_LOITER: "Hold",
    Px4Mode.AUTO_MISSION: "Mission",
    Px4Mode.AUTO_RTL: "Return",
    Px4Mode.AUTO_LAND: "Land",
}
NEEDS_PILOT = frozenset({Px4Mode.MANUAL, Px4Mode.ALTCTL, Px4Mode.POSCTL, Px4Mode.ACRO, Px4Mode.STABILIZED})
NO_ARMING_IN = frozenset({Px4Mode.AUTO_RTL, Px4Mode.AUTO_LAND, *NEEDS_PILOT})
NOT_KEPT_AFTER_LANDING = frozenset({Px4Mode.AUTO_TAKEOFF, Px4Mode.AUTO_LAND, Px4Mode.AUTO_RTL})
FLIES_BLIND = frozenset({Px4Mode.OFFBOARD, Px4Mode.AUTO_LAND})  # modes without a position; LAND then only descends

FLIGHT_MODES = {
    Px4Mode.AUTO_TAKEOFF: FlightMode.TAKEOFF,
    Px4Mode.AUTO_LOITER: FlightMode.HOLD,
    Px4Mode.AUTO_MISSION: FlightMode.MISSION,
    Px4Mode.AUTO_RTL: FlightMode.RTL,
    Px4Mode.AUTO_LAND: FlightMode.LAND,
    Px4Mode.OFFBOARD: FlightMode.EXTERNAL,
}
STANDARD_MODES = {  # MAV_STANDARD_MODE of CURRENT_MODE
    Px4Mode.POSCTL: 1,
    Px4Mode.ALTCTL: 4,
    Px4Mode.AUTO_RTL: 5,
    Px4Mode.AUTO_MISSION: 6,
    Px4Mode.AUTO_LAND: 7,
    Px4Mode.AUTO_TAKEOFF: 8,
}

BASE_ARMED = 128
BASE_AUTO = 29  # custom, auto, guided, stabilize
BASE_MANUAL = 65  # custom, manual input
BASE_STABILIZED = 81
BASE_OFFBOARD = 17
BASE_OFFBOARD_NO_STREAM_YET = 1


def base_mode(mode: Px4Mode, *, armed: bool, streamed: bool) -> int:
    """Return HEARTBEAT.base_mode; `streamed`: a setpoint stream has been seen since boot."""
    if mode == Px4Mode.OFFBOARD:
        flags = BASE_OFFBOARD if streamed or armed else BASE_OFFBOARD_NO_STREAM_YET
    elif mode in (Px4Mode.MANUAL, Px4Mode.ACRO):
        flags = BASE_MANUAL
    elif mode in NEEDS_PILOT:
        flags = BASE_STABILIZED
    else:
        flags = BASE_AUTO
    return flags | (BASE_ARMED if armed else 0)


class MavState(enum.IntEnum):
    """Lists the values of MAV_STATE that are sent."""

    UNINIT = 0
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5
    TERMINATION = 8


class MissionState(enum.IntEnum):
    """Lists the values of MISSION_STATE that MISSION_CURRENT carries."""

    NO_MISSION = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


class OffboardLoss(enum.IntEnum):
    """Values of COM_OBL_RC_ACT; the first four need a pilot or mean Return, and end in RTL without one."""

    POSITION = 0
    ALTITUDE = 1
    STABILIZED = 2
    RETURN = 3
    LAND = 4
    HOLD = 5
    TERMINATE = 6
    DISARM = 7
