"""MAVLink 2 signatures: the bytes of a signed frame, and whether a key has signed it. Pure, without clock and memory.

A signed frame is the plain one with a flag in its header, a checksum that covers the flag, and a signature block: link
id, time stamp, and 48 bits of SHA-256 over key and frame. Only the flag's part of a checksum changes, so that messages
of every dialect can be signed, and plain frames regained, without knowing them.
"""

from __future__ import annotations

import hashlib
import hmac
from functools import cache
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx

KEY_BYTES = 32
_VERSION_2, _PLAIN, _SIGNED = 0xFD, 0, 1  # first byte of a frame; incompatibility flags
_HEADER_BYTES, _CHECKSUM_BYTES, _STAMP_BYTES, _DIGEST_BYTES = 10, 2, 6, 6
_BLOCK_BYTES = 1 + _STAMP_BYTES + _DIGEST_BYTES
_EPOCH_US = 1_420_070_400_000_000  # 2015-01-01 UTC
_TICK_US = 10
STAMPS_PER_S = 1_000_000 // _TICK_US
MOST_STAMP = (1 << 8 * _STAMP_BYTES) - 1
_FINGERPRINT_CHARACTERS = 16


class Stream(NamedTuple):
    """A sequence of frames whose time stamps only increase: one component on one of its links."""

    link_id: int
    sysid: int
    compid: int


class SigningKey:
    """The secret that a vehicle and its companion share; never shown as text.

    Attributes:
        secret: its 32 bytes.
        fingerprint: names the key without giving it away.
    """

    def __init__(self, secret: bytes) -> None:
        if len(secret) != KEY_BYTES:
            raise ValueError(f"a key of {len(secret)} bytes; allowed: {KEY_BYTES}")
        self.secret = secret
        self.fingerprint = hashlib.sha256(b"swarmctl fingerprint" + secret).hexdigest()[:_FINGERPRINT_CHARACTERS]
        self._begun = hashlib.sha256(secret)

    def __repr__(self) -> str:
        return f"SigningKey({self.fingerprint})"

    def digest(self, data: bytes) -> bytes:
        """Return the last part of the signature of a frame whose other bytes are `data`."""
        hashed = self._begun.copy()
        hashed.update(data)
        return hashed.digest()[:_DIGEST_BYTES]


def stamp_at(utc_us: int) -> int:
    """Return the time stamp of an instant [us since 1970], in 10 us since 2015."""
    return max(0, min(MOST_STAMP, (utc_us - _EPOCH_US) // _TICK_US))


def is_plain(frame: bytes) -> bool:
    """Return whether a frame is a whole one of MAVLink 2 without signature, which can be signed."""
    return _is_whole(frame, _PLAIN, 0)


def is_signed(frame: bytes) -> bool:
    """Return whether a frame is a whole one of MAVLink 2 that says to be signed."""
    return _is_whole(frame, _SIGNED, _BLOCK_BYTES)


def _is_whole(frame: bytes, flags: int, block_bytes: int) -> bool:
    around = _HEADER_BYTES + _CHECKSUM_BYTES + block_bytes
    return len(frame) >= around and frame[0] == _VERSION_2 and frame[2] == flags and len(frame) == around + frame[1]


def sign(frame: bytes, key: SigningKey, link_id: int, stamp: int) -> bytes:
    """Return a plain frame with a signature."""
    end = _HEADER_BYTES + frame[1]
    signed = bytearray(frame)
    signed[2] = _SIGNED
    signed[end:] = _turned(frame, end)
    signed.append(link_id)
    signed += stamp.to_bytes(_STAMP_BYTES, "little")
    head = bytes(signed)
    return head + key.digest(head)


def strip(frame: bytes) -> bytes:
    """Return a signed frame without its signature: the plain frame of the same message."""
    end = _HEADER_BYTES + frame[1]
    return frame[:2] + bytes((_PLAIN,)) + frame[3:end] + _turned(frame, end)


def is_authentic(frame: bytes, key: SigningKey) -> bool:
    """Return whether this key has signed a signed frame."""
    return hmac.compare_digest(key.digest(frame[:-_DIGEST_BYTES]), frame[-_DIGEST_BYTES:])


def origin(frame: bytes) -> tuple[Stream, int]:
    """Return the stream and the time stamp of a signed frame."""
    block = frame[-_BLOCK_BYTES:]
    return Stream(block[0], frame[5], frame[6]), int.from_bytes(block[1 : 1 + _STAMP_BYTES], "little")


def _turned(frame: bytes, end: int) -> bytes:
    """Return the checksum of a frame whose payload ends at `end` after the flag of a signature is changed."""
    checksum = int.from_bytes(frame[end : end + _CHECKSUM_BYTES], "little") ^ _flag_in_checksum(frame[1])
    return checksum.to_bytes(_CHECKSUM_BYTES, "little")


@cache
def _flag_in_checksum(payload_bytes: int) -> int:
    """Return what the flag changes in a checksum: the same bits in every frame of this length, as a CRC is linear."""
    rest = bytes(_HEADER_BYTES - 3 + payload_bytes + 1)  # header after the flags, payload, and the message's own seed
    without, with_flag = (mcrf4xx(bytes((0, flags)) + rest) for flags in (_PLAIN, _SIGNED))
    return int(without ^ with_flag)
