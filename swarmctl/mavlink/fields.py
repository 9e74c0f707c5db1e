"""Reads from the payloads of MAVLink messages what is used of them, without making a message of each.

Where a field is in a payload follows from the dialect's definition. Messages with text are made in full; they are rare.
"""

from __future__ import annotations

import struct
from collections import namedtuple
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from pymavlink.dialects.v20 import development as dialect

from swarmctl.mavlink.codec import message_of

Reader = Callable[[bytes], Any]

_USED = {
    dialect.MAVLINK_MSG_ID_HEARTBEAT: "type autopilot base_mode custom_mode system_status",
    dialect.MAVLINK_MSG_ID_CURRENT_MODE: "custom_mode",
    dialect.MAVLINK_MSG_ID_ODOMETRY: (
        "time_usec x y z q vx vy vz rollspeed pitchspeed yawspeed frame_id child_frame_id reset_counter"
    ),
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: "time_boot_ms q1 q2 q3 q4 rollspeed pitchspeed yawspeed",
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: "time_boot_ms x y z vx vy vz",
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: "time_boot_ms lat lon alt",
    dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: "latitude longitude altitude",
    dialect.MAVLINK_MSG_ID_SYS_STATUS: "onboard_control_sensors_health battery_remaining",
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: "landed_state",
    dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: "pos_horiz_accuracy flags",
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: "fix_type satellites_visible h_acc",
    dialect.MAVLINK_MSG_ID_ATTITUDE_TARGET: "thrust",
    dialect.MAVLINK_MSG_ID_TIMESYNC: "tc1 ts1",
}
_TEXTS = (dialect.MAVLINK_MSG_ID_PARAM_VALUE, dialect.MAVLINK_MSG_ID_STATUSTEXT)


def reader(number: int, *names: str) -> Reader:
    """Return a function that makes a named tuple of some fields of a payload; an array `q` becomes `q_0`, `q_1` ...

    Args:
        number: id of the message.
        names: the fields, as the standard calls them.

    Raises:
        ValueError: the message has no such field, or it is text.
    """
    kind = dialect.mavlink_map[number]
    codes = kind.native_format[1:].decode()
    layout, found = "<", list[str]()
    for name, code, length in zip(kind.ordered_fieldnames, codes, kind.array_lengths, strict=True):
        count = max(1, length)
        if name not in names:
            layout += f"{count * struct.calcsize(code)}x"
            continue
        layout += f"{count}{code}"
        found += [f"{name}_{i}" for i in range(length)] or [name]
    texts = {name for name, code in zip(kind.ordered_fieldnames, codes, strict=True) if code == "c"}
    if unknown := set(names) - (set(kind.ordered_fieldnames) - texts):
        raise ValueError(f"{kind.msgname} has no number {', '.join(sorted(unknown))}")
    unpack = struct.Struct(layout).unpack_from
    fields: Any = namedtuple(kind.msgname, found)  # type: ignore[misc]
    make = fields._make
    return lambda payload: make(unpack(payload))


READERS: Mapping[int, Reader] = {
    **{number: reader(number, *names.split()) for number, names in _USED.items()},
    **{number: partial(message_of, number) for number in _TEXTS},
}

BOOT_READERS: Mapping[int, Reader] = {  # of `time_boot_ms`, for every message that has it
    number: reader(number, "time_boot_ms")
    for number, kind in dialect.mavlink_map.items()
    if "time_boot_ms" in kind.fieldnames
}
