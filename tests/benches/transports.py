"""Frames to send over transports, and the unit of their times, for tests."""

from __future__ import annotations

SECOND = 1_000_000


def frame(payload: bytes, signed: bool = False) -> bytes:
    """A frame as far as its length goes."""
    tail = b"\x11" * (15 if signed else 2)
    return bytes([0xFD, len(payload), int(signed), 0, 0, 1, 1, 0, 0, 0]) + payload + tail
