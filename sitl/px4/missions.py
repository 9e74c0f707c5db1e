"""Uploads to a vehicle: mission, geofence and rally items, and which of them PX4 refuses. No protocol, no flight."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import NamedTuple

from pymavlink.dialects.v20 import development as mav

from sitl.px4.modes import MissionState

MISSION, FENCE, RALLY, ALL = 0, 1, 2, 255  # MAV_MISSION_TYPE
CAPACITY = {MISSION: 2000, FENCE: 64, RALLY: 64}
_GLOBAL_FRAMES = frozenset({0, 3, 5, 6})  # GLOBAL, GLOBAL_RELATIVE_ALT, and both INT
_RELATIVE_FRAMES = frozenset({3, 6})
_FRAME_MISSION = 2

NAV_WAYPOINT, NAV_LOITER_UNLIM, NAV_LOITER_TIME = 16, 17, 19
NAV_RETURN, NAV_LAND, NAV_TAKEOFF, NAV_DELAY = 20, 21, 22, 93
DO_JUMP, DO_CHANGE_SPEED = 177, 178
FENCE_IN, FENCE_OUT = mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
CIRCLE_IN, CIRCLE_OUT = mav.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, mav.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION
_PLACED: dict[int, frozenset[int]] = {
    MISSION: frozenset({NAV_WAYPOINT, NAV_LOITER_UNLIM, NAV_LOITER_TIME, NAV_LAND, NAV_TAKEOFF}),
    FENCE: frozenset({FENCE_IN, FENCE_OUT, CIRCLE_IN, CIRCLE_OUT}),
    RALLY: frozenset({mav.MAV_CMD_NAV_RALLY_POINT}),
}
_UNPLACED = frozenset({NAV_RETURN, NAV_DELAY, DO_JUMP, DO_CHANGE_SPEED})


class MissionResult(enum.IntEnum):
    """Lists the values of MAV_MISSION_RESULT that are sent."""

    ACCEPTED = 0
    ERROR = 1
    UNSUPPORTED_FRAME = 2
    UNSUPPORTED = 3
    NO_SPACE = 4
    INVALID = 5
    INVALID_PARAM1 = 6
    INVALID_PARAM5_X = 10
    INVALID_PARAM6_Y = 11
    INVALID_PARAM7 = 12
    INVALID_SEQUENCE = 13
    DENIED = 14
    OPERATION_CANCELLED = 15


class Item(NamedTuple):
    """One uploaded item; `lat_e7`, `lon_e7` are raw, `z_m` is in `frame`."""

    frame: int
    command: int
    params: tuple[float, float, float, float]
    lat_e7: int
    lon_e7: int
    z_m: float
    autocontinue: int = 1

    @property
    def relative(self) -> bool:
        """Whether the height is above home instead of above the sea."""
        return self.frame in _RELATIVE_FRAMES


class Progress(NamedTuple):
    """Holds what MISSION_CURRENT says of a mission."""

    seq: int
    total: int
    state: int
    mode: int


def validate(kind: int, item: Item) -> MissionResult:
    """Return PX4's result for an item of this mission type."""
    if item.frame == _FRAME_MISSION:
        known = kind == MISSION and item.command in _UNPLACED
        return MissionResult.ACCEPTED if known else MissionResult.UNSUPPORTED
    if item.frame not in _GLOBAL_FRAMES:
        return MissionResult.UNSUPPORTED_FRAME
    if item.command not in _PLACED[kind] and not (kind == MISSION and item.command in _UNPLACED):
        return MissionResult.UNSUPPORTED
    if abs(item.lat_e7) > 900_000_000:
        return MissionResult.INVALID_PARAM5_X
    if abs(item.lon_e7) > 1_800_000_000:
        return MissionResult.INVALID_PARAM6_Y
    if not math.isfinite(item.z_m) and item.command not in _UNPLACED:
        return MissionResult.INVALID_PARAM7
    return _validate_fence(item) if kind == FENCE else MissionResult.ACCEPTED


def _validate_fence(item: Item) -> MissionResult:
    if item.command in (CIRCLE_IN, CIRCLE_OUT):
        return MissionResult.ACCEPTED if item.params[0] > 0 else MissionResult.INVALID_PARAM1
    return MissionResult.ACCEPTED if 3 <= item.params[0] <= CAPACITY[FENCE] else MissionResult.INVALID_PARAM1


@dataclass(slots=True)
class Store:
    """Everything uploaded to one vehicle; it survives a reboot."""

    items: dict[int, tuple[Item, ...]] = field(default_factory=lambda: {MISSION: (), FENCE: (), RALLY: ()})
    current: int = 0
    changes: int = 0  # counts replacements, so that a running flight or fence notices them

    def replace(self, kind: int, items: tuple[Item, ...]) -> None:
        """Replace the whole list; a mission begins at its first item."""
        kinds = (MISSION, FENCE, RALLY) if kind == ALL else (kind,)
        for each in kinds:
            self.items[each] = items
        if MISSION in kinds:
            self.current = 0
        self.changes += 1

    @property
    def mission(self) -> tuple[Item, ...]:
        return self.items[MISSION]

    def jump(self, seq: int) -> bool:
        """Make item `seq` the current one; return False when there is none."""
        if not 0 <= seq < len(self.mission):
            return False
        self.current = seq
        self.changes += 1
        return True

    def progress(self, *, flying: bool, finished: bool) -> Progress:
        """Return the content of MISSION_CURRENT."""
        total = len(self.mission)
        if not total:
            return Progress(0, 0, MissionState.NO_MISSION, 0)
        if finished:
            state = MissionState.COMPLETE
        elif flying:
            state = MissionState.ACTIVE
        else:
            state = MissionState.PAUSED if self.current else MissionState.NOT_STARTED
        return Progress(self.current, total, state, 1 if flying else 2)
