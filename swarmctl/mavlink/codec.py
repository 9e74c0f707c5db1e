"""MAVLink 2 codec that converts bytes and dialect messages, one datagram at a time. It knows no socket and no vehicle.

`parse_buffer` is never used: as a stream parser it loses most good frames after two bytes of junk. Plain frames
(MAVLink 2, not signed, valid) are decoded here: to the same messages as by pymavlink's `decode`, in half of its time.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable
from functools import cache
from operator import itemgetter
from typing import Any, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import development as dialect

from swarmctl.mavlink.framing import frames, message_id

AUTOPILOT_COMPID = 1  # MAV_COMP_ID_AUTOPILOT1
_VERSION_2, _PLAIN = 0xFD, 0  # first byte of a frame; incompatibility flags of one that is not signed
_HEADER_BYTES, _CHECKSUM_BYTES = 10, 2


class _Layout(NamedTuple):
    """Says how to make a message from the numbers in its payload."""

    make: Callable[..., Any]
    payload: struct.Struct
    seed: bytes  # appended to a frame for its checksum
    arguments: Callable[[tuple[Any, ...]], tuple[Any, ...]]  # numbers in wire order -> arguments of `make`
    arrays: tuple[int, ...]  # arguments that are lists
    texts: tuple[int, ...]  # arguments that are bytes padded with zeros


@cache
def _layout(number: int) -> _Layout | None:
    """Return the layout of a message of the dialect; None for an unknown one."""
    kind = dialect.mavlink_map.get(number)
    if kind is None:
        return None
    firsts = [sum(kind.lengths[:place]) for place in kind.orders]  # of the numbers of each argument
    counts = [kind.lengths[place] for place in kind.orders]
    zeros = kind.unpacker.unpack(bytes(kind.unpacker.size))
    picks = [first if count == 1 else slice(first, first + count) for first, count in zip(firsts, counts, strict=True)]
    return _Layout(
        make=kind,
        payload=kind.unpacker,
        seed=bytes([kind.crc_extra]),
        arguments=itemgetter(*picks) if len(picks) > 1 else lambda numbers: (numbers[picks[0]],),
        arrays=tuple(i for i, count in enumerate(counts) if count > 1),
        texts=tuple(i for i, first in enumerate(firsts) if isinstance(zeros[first], bytes)),
    )


def heartbeat_of(sysid: int) -> Callable[[bytes], bool]:
    """Return a predicate: does a datagram hold a valid HEARTBEAT of the autopilot with this system id?

    Ground stations and companions send HEARTBEAT too, some with a vehicle's system id; they name no autopilot type.
    """
    codec = Codec(sysid, AUTOPILOT_COMPID)

    def beats(datagram: bytes) -> bool:
        for frame in frames(datagram):
            if message_id(frame) != dialect.MAVLINK_MSG_ID_HEARTBEAT or frame[5:7] != bytes([sysid, AUTOPILOT_COMPID]):
                continue
            message = codec.decode(frame)
            if message is not None and message.autopilot != dialect.MAV_AUTOPILOT_INVALID:
                return True
        return False

    return beats


def is_damaged(frame: bytes) -> bool:
    """Return whether the checksum of a frame of MAVLink 2 is wrong, as after noise; not known of unknown messages."""
    layout, end = _layout(message_id(frame)), _HEADER_BYTES + frame[1]
    checksum = int.from_bytes(frame[end : end + _CHECKSUM_BYTES], "little")
    return layout is not None and bool(mcrf4xx(frame[1:end] + layout.seed) != checksum)


class Codec:
    """Packs messages as one component, and decodes frames; counts what it refuses."""

    def __init__(self, sysid: int, compid: int) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=sysid, srcComponent=compid)
        self._mav.robust_parsing = False
        self.sysid = sysid
        self.compid = compid
        self.refused: Counter[str] = Counter()

    def encode(self, message: Any) -> bytes:
        """Return the frame of a dialect message, with this component's ids and the next sequence number."""
        frame: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def decode(self, frame: bytes) -> Any | None:
        """Return the message of one frame, or None for a refused one, which is counted."""
        try:
            message = _decode_plain(frame) or self._mav.decode(bytearray(frame))
        except (dialect.MAVError, IndexError, ValueError, KeyError) as error:
            self.refused[type(error).__name__] += 1
            return None
        if isinstance(message, dialect.MAVLink_unknown):  # its checksum can't be verified
            self.refused["unknown message"] += 1
            return None
        return message


def _decode_plain(frame: bytes) -> Any | None:
    """Return the message of a valid frame of MAVLink 2 without signature; None for others, which pymavlink judges."""
    whole = len(frame) >= _HEADER_BYTES + _CHECKSUM_BYTES and len(frame) == frame[1] + _HEADER_BYTES + _CHECKSUM_BYTES
    if not whole or frame[0] != _VERSION_2 or frame[2] != _PLAIN:
        return None
    number = message_id(frame)
    layout = _layout(number)
    checksum = int.from_bytes(frame[-_CHECKSUM_BYTES:], "little")
    if layout is None or mcrf4xx(frame[1:-_CHECKSUM_BYTES] + layout.seed) != checksum:
        return None
    size = layout.payload.size
    payload = frame[_HEADER_BYTES:-_CHECKSUM_BYTES][:size].ljust(size, b"\0")
    arguments = list(layout.arguments(layout.payload.unpack(payload)))
    for i in layout.arrays:
        arguments[i] = list(arguments[i])
    for i in layout.texts:
        arguments[i] = arguments[i].rstrip(b"\0")
    message = layout.make(*arguments)
    header = message.get_header()
    header.mlen, header.seq, header.srcSystem, header.srcComponent = frame[1], frame[4], frame[5], frame[6]
    header.incompat_flags, header.compat_flags = frame[2], frame[3]
    message._msgbuf, message._crc = bytearray(frame), checksum
    message._payload = message._msgbuf[6:-_CHECKSUM_BYTES]
    return message
