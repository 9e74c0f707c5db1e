"""MAVLink 2 codec that converts bytes and dialect messages, one datagram at a time. It knows no socket and no vehicle.

`parse_buffer` is never used: as a stream parser it loses most good frames after two bytes of junk. Plain frames
(MAVLink 2, not signed) are judged and decoded here: to the same messages as by pymavlink's `decode`, in half of its
time. Who needs a few fields only takes the payload, and reads them by `fields`.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from operator import itemgetter
from typing import Any, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.mavlink_values import AUTOPILOT_COMPID
from swarmctl.mavlink.framing import frames, message_id

_VERSION_2, _PLAIN = 0xFD, 0  # first byte of a frame; incompatibility flags of one that is not signed
_HEADER_BYTES, _HEADER_BYTES_1, _CHECKSUM_BYTES = 10, 6, 2  # the second of MAVLink 1
_HEADER = struct.Struct("<BBBBBBBHB")
_LARGEST_NUMBER = 0xFFFF  # of a message in any dialect; a header that is none has most often a larger one
_UNKNOWN = "unknown message"  # its checksum can't be verified


class _Layout(NamedTuple):
    """Says how to make a message from the numbers in its payload."""

    make: Callable[..., Any]
    payload: struct.Struct
    seed: bytes  # appended to a frame for its checksum
    arguments: Callable[[tuple[Any, ...]], tuple[Any, ...]]  # numbers in wire order -> arguments of `make`
    arrays: tuple[int, ...]  # arguments that are lists
    texts: tuple[int, ...]  # arguments that are bytes padded with zeros


@lru_cache(maxsize=1024)  # as many as there are: the numbers of damaged frames have no end
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


def message_of(number: int, payload: bytes) -> Any:
    """Return the message with a payload that `Codec.payload` has returned."""
    layout = _layout(number)
    assert layout is not None
    arguments = list(layout.arguments(layout.payload.unpack_from(payload)))
    for i in layout.arrays:
        arguments[i] = list(arguments[i])
    for i in layout.texts:
        arguments[i] = arguments[i].rstrip(b"\0")
    return layout.make(*arguments)


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


def is_intact(frame: bytes) -> bool | None:
    """Return whether the checksum of a MAVLink 2 frame is right; None of unknown messages, where nobody can tell."""
    number, end = message_id(frame), _HEADER_BYTES + frame[1]
    layout = _layout(number)
    if layout is None:
        return None if number <= _LARGEST_NUMBER else False
    return bool(mcrf4xx(frame[1:end] + layout.seed) == int.from_bytes(frame[end : end + _CHECKSUM_BYTES], "little"))


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

    def frame(self, number: int, payload: bytes) -> bytes:
        """Return the frame of a message whose payload is at hand; zeros at its end are not sent."""
        layout = _layout(number)
        if layout is None:
            raise ValueError(f"message {number} is not of the dialect")
        sent = payload.rstrip(b"\0") or b"\0"
        ids = self._mav.seq, self.sysid, self.compid, number & 0xFFFF, number >> 16
        inside = _HEADER.pack(_VERSION_2, len(sent), _PLAIN, 0, *ids) + sent
        self._mav.seq = (self._mav.seq + 1) % 256
        return inside + int(mcrf4xx(inside[1:] + layout.seed)).to_bytes(_CHECKSUM_BYTES, "little")

    def payload(self, frame: bytes) -> bytes | None:
        """Return the payload of one frame, with the zeros that are not sent; None for a refused one, which is counted.

        Refused is exactly what `decode` refuses.
        """
        if not _is_plain(frame):
            message = self._decoded(frame)
            begin = _HEADER_BYTES if frame[:1] == bytes([_VERSION_2]) else _HEADER_BYTES_1
            return None if message is None else frame[begin : begin + frame[1]].ljust(message.unpacker.size, b"\0")
        layout = _layout(message_id(frame))
        if layout is None:
            self.refused[_UNKNOWN] += 1
            return None
        if mcrf4xx(frame[1:-_CHECKSUM_BYTES] + layout.seed) != int.from_bytes(frame[-_CHECKSUM_BYTES:], "little"):
            self.refused[dialect.MAVError.__name__] += 1
            return None
        return frame[_HEADER_BYTES:-_CHECKSUM_BYTES].ljust(layout.payload.size, b"\0")

    def decode(self, frame: bytes) -> Any | None:
        """Return the message of one frame, or None for a refused one, which is counted."""
        if not _is_plain(frame):
            return self._decoded(frame)
        payload = self.payload(frame)
        return None if payload is None else _with_header(message_of(message_id(frame), payload), frame)

    def _decoded(self, frame: bytes) -> Any | None:
        """Return the message of a frame that pymavlink judges, or None for a refused one, which is counted."""
        try:
            message = self._mav.decode(bytearray(frame))
        except (dialect.MAVError, IndexError, ValueError, KeyError) as error:
            self.refused[type(error).__name__] += 1
            return None
        if isinstance(message, dialect.MAVLink_unknown):
            self.refused[_UNKNOWN] += 1
            return None
        return message


def _is_plain(frame: bytes) -> bool:
    """Return whether a frame is a whole one of MAVLink 2 without signature."""
    whole = len(frame) >= _HEADER_BYTES + _CHECKSUM_BYTES and len(frame) == frame[1] + _HEADER_BYTES + _CHECKSUM_BYTES
    return whole and frame[0] == _VERSION_2 and frame[2] == _PLAIN


def _with_header(message: Any, frame: bytes) -> Any:
    """Return the message of a valid plain frame with what else pymavlink keeps of the frame."""
    header = message.get_header()
    header.mlen, header.seq, header.srcSystem, header.srcComponent = frame[1], frame[4], frame[5], frame[6]
    header.incompat_flags, header.compat_flags = frame[2], frame[3]
    message._msgbuf, message._crc = bytearray(frame), int.from_bytes(frame[-_CHECKSUM_BYTES:], "little")
    message._payload = message._msgbuf[6:-_CHECKSUM_BYTES]
    return message
