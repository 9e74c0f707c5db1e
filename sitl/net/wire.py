"""MAVLink frames of the simulator, packed directly from tuples.

A dialect object takes 5-40 us to pack, a tuple about 2: one core has to carry 25,000 messages a second. PX4 sends seven
messages that the dialect module lacks, ArduCopter one; they are defined here. `tests/unit/sitl/test_wire.py` compares
all with pymavlink.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import development as mav

_MAGIC_V2 = b"\xfd"
_HEADER = struct.Struct("<BHBBB")  # length, flags, sequence, system, component; the message's number follows


class Kind(NamedTuple):
    """Layout of one message; `layout` takes its fields in wire order (largest type first)."""

    number_bytes: bytes  # (3,) as in a frame
    name: str
    layout: struct.Struct
    seed: bytes  # appended to a frame for its checksum


# Fields in wire order, as in the standard's definition: their names and types give the CRC seed.
LACKING: dict[int, tuple[str, str, int, tuple[str, ...]]] = {
    8: (
        "LINK_NODE_STATUS",
        "<QIIIIIHHHBB",
        117,
        (
            "uint64_t timestamp",
            "uint32_t tx_rate",
            "uint32_t rx_rate",
            "uint32_t messages_sent",
            "uint32_t messages_received",
            "uint32_t messages_lost",
            "uint16_t rx_parse_err",
            "uint16_t tx_overflows",
            "uint16_t rx_overflows",
            "uint8_t tx_buf",
            "uint8_t rx_buf",
        ),
    ),
    193: (
        "EKF_STATUS_REPORT",
        "<5fH",
        71,
        (
            "float velocity_variance",
            "float pos_horiz_variance",
            "float pos_vert_variance",
            "float compass_variance",
            "float terrain_alt_variance",
            "uint16_t flags",
        ),
    ),
    290: (
        "ESC_INFO",
        "<Q4IH4H4hBBBB",
        251,
        (
            "uint64_t time_usec",
            "uint32_t error_count 4",
            "uint16_t counter",
            "uint16_t failure_flags 4",
            "int16_t temperature 4",
            "uint8_t index",
            "uint8_t count",
            "uint8_t connection_type",
            "uint8_t info",
        ),
    ),
    291: (
        "ESC_STATUS",
        "<Q4i4f4fB",
        10,
        ("uint64_t time_usec", "int32_t rpm 4", "float voltage 4", "float current 4", "uint8_t index"),
    ),
    300: (
        "PROTOCOL_VERSION",
        "<HHH8B8B",
        217,
        (
            "uint16_t version",
            "uint16_t min_version",
            "uint16_t max_version",
            "uint8_t spec_version_hash 8",
            "uint8_t library_version_hash 8",
        ),
    ),
    380: (
        "TIME_ESTIMATE_TO_TARGET",
        "<5i",
        232,
        (
            "int32_t safe_return",
            "int32_t land",
            "int32_t mission_next_item",
            "int32_t mission_end",
            "int32_t commanded_action",
        ),
    ),
    411: ("CURRENT_EVENT_SEQUENCE", "<HB", 106, ("uint16_t sequence", "uint8_t flags")),
    514: (
        "ESTIMATOR_SENSOR_FUSION_STATUS",
        "<9f9B9B",
        197,
        ("float test_ratio 9", "uint8_t intended 9", "uint8_t active 9"),
    ),
}


def _kind(number: int, name: str, layout: struct.Struct, crc_extra: int) -> Kind:
    return Kind(number.to_bytes(3, "little"), name, layout, bytes((crc_extra,)))


def _kinds() -> dict[int, Kind]:
    kinds = {
        number: _kind(number, message.msgname, message.unpacker, message.crc_extra)
        for number, message in mav.mavlink_map.items()
    }
    for number, (name, layout, crc_extra, _) in LACKING.items():
        kinds[number] = _kind(number, name, struct.Struct(layout), crc_extra)
    return kinds


KINDS = _kinds()


class FrameWriter:
    """Writes the frames of one component on one link, with the link's sequence number."""

    def __init__(self, sysid: int, compid: int) -> None:
        self.sysid = sysid
        self.compid = compid
        self.sequence = 0

    def frame(self, kind: Kind, fields: tuple[Any, ...]) -> bytes:
        """Return the MAVLink 2 frame of a message from its fields in wire order."""
        payload = kind.layout.pack(*fields).rstrip(b"\0") or b"\0"
        header = _HEADER.pack(len(payload), 0, self.sequence, self.sysid, self.compid)
        self.sequence = (self.sequence + 1) & 0xFF
        body = header + kind.number_bytes + payload
        return _MAGIC_V2 + body + mcrf4xx(body + kind.seed).to_bytes(2, "little")
