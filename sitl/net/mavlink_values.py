"""Values of MAVLink's enumerations that every simulated autopilot sends. Tables only."""

from __future__ import annotations

import enum


class Result(enum.IntEnum):
    """Lists the values of MAV_RESULT that are sent."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Severity(enum.IntEnum):
    """Lists the values of MAV_SEVERITY that are sent."""

    EMERGENCY = 0
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    INFO = 6
