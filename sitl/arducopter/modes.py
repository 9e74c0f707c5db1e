"""ArduCopter's modes in MAVLink: custom_mode numbers, base_mode, MAV_STATE. Tables only."""

from __future__ import annotations

import enum

from swarmctl.core.types import FlightMode


class CopterMode(enum.IntEnum):
    """custom_mode of HEARTBEAT for the modes that are flown here."""

    STABILIZE = 0
    ALT_HOLD = 2
    GUIDED = 4
    LOITER = 5
    RTL = 6
    LAND = 9
    BRAKE = 17


NOT_FLOWN_HERE = {  # modes of ArduCopter 4.6 that this simulator does not enter
    1: "ACRO",
    3: "AUTO",
    7: "CIRCLE",
    11: "DRIFT",
    13: "SPORT",
    14: "FLIP",
    15: "AUTOTUNE",
    16: "POSHOLD",
    18: "THROW",
    19: "AVOID_ADSB",
    20: "GUIDED_NOGPS",
    21: "SMART_RTL",
    22: "FLOWHOLD",
    23: "TRACKING",
    24: "ZIGZAG",
    25: "SYSTEMID",
    26: "AUTOROTATE",
    27: "AUTO_RTL",
    28: "TURTLE",
}
NEEDS_POSITION = frozenset(  # modes that need a position while armed; LAND descends without one
    {CopterMode.GUIDED, CopterMode.LOITER, CopterMode.RTL, CopterMode.BRAKE}
)
NO_ARMING_IN = frozenset({CopterMode.RTL, CopterMode.LAND, CopterMode.BRAKE})
ENDS_ON_GROUND = frozenset({CopterMode.RTL, CopterMode.LAND})  # these disarm by themselves after touchdown
WITHOUT_POSITION_CONTROL = frozenset({CopterMode.STABILIZE, CopterMode.ALT_HOLD})

FLIGHT_MODES = {
    CopterMode.GUIDED: FlightMode.EXTERNAL,
    CopterMode.LOITER: FlightMode.HOLD,
    CopterMode.BRAKE: FlightMode.HOLD,
    CopterMode.RTL: FlightMode.RTL,
    CopterMode.LAND: FlightMode.LAND,
}

BASE_ARMED = 128
BASE_ALWAYS = 81  # custom, manual input, stabilize
BASE_POSITION_CONTROL = 8


class CopterState(enum.IntEnum):
    """MAV_STATE as ArduCopter uses it: standby means on the ground, armed or not."""

    BOOT = 1
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5
