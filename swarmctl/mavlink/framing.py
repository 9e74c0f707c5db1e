"""Frame boundaries of MAVLink in streams of bytes, received and sent. Checksums are verified by a `judge` alone."""

from __future__ import annotations

import re
from collections.abc import Callable

_START_2 = re.compile(b"\xfd")
_START_1_OR_2 = re.compile(b"[\xfd\xfe]")
_VERSION_2 = 0xFD
Judge = Callable[[bytes], bool | None]  # whether the checksum of a frame is right; None: it can't be verified
_FIRST_BYTES = 3  # they tell the length of a frame
_AROUND_1, _AROUND_2, _SIGNATURE = 8, 12, 13  # bytes of header and checksum by version, and of a signature
_SIGNED = 1


def cut_frames(buffer: bytearray, version_1: bool = False, judge: Judge | None = None) -> list[bytes]:
    """Remove and return all complete MAVLink 2 frames at the front of `buffer`; junk before a start byte is dropped.

    Args:
        buffer: what has arrived.
        version_1: MAVLink 1 frames are returned too; otherwise they are junk.
        judge: for streams that lose bytes: what a damaged frame says of its length takes others away with it, so that
            frames are looked for within it, too. It is returned before them, to be refused and counted.
    """
    start_byte = _START_1_OR_2 if version_1 else _START_2
    found: list[bytes] = []
    while True:
        start = start_byte.search(buffer)
        if start is None:
            buffer.clear()
            return found
        del buffer[: start.start()]
        if len(buffer) < _FIRST_BYTES:
            return found
        if buffer[0] == _VERSION_2:
            length = _AROUND_2 + buffer[1] + (_SIGNATURE if buffer[2] & _SIGNED else 0)
        else:
            length = _AROUND_1 + buffer[1]
        if len(buffer) < length:
            return found
        frame = bytes(buffer[:length])
        is_good = True if judge is None else judge(frame)
        if is_good is None:  # of an unknown message: then what follows has to begin as a frame
            is_good = length == len(buffer) or start_byte.match(buffer, length) is not None
        elif not is_good:
            found.append(frame)
        if is_good:
            found.append(frame)
        del buffer[: length if is_good else 1]


def frames(datagram: bytes, version_1: bool = False) -> list[bytes]:
    """Return the frames of a datagram as `cut_frames` does; a truncated frame ends it."""
    if len(datagram) >= _AROUND_2 and datagram[0] == _VERSION_2:
        around = _AROUND_2 + _SIGNATURE if datagram[2] & _SIGNED else _AROUND_2
        if len(datagram) == around + datagram[1]:
            return [datagram]  # nearly every one is a single frame
    return cut_frames(bytearray(datagram), version_1)


def message_id(frame: bytes) -> int:
    """Return the message id of a MAVLink 2 frame."""
    return int.from_bytes(frame[7:10], "little")


class FrameWriter:
    """Writes frames to a stream that takes what fits: whole ones, or none of a frame.

    The rest of a frame that was taken in part goes before the next one, which is dropped while that does not fit.
    """

    def __init__(self) -> None:
        self._rest = b""

    def send(self, write: Callable[[bytes], int], frame: bytes) -> None:
        """Send one frame by `write`, which returns how many bytes it has taken and never blocks.

        Raises:
            OSError: the stream is lost.
        """
        try:
            if self._rest:
                self._rest = self._rest[write(self._rest) :]
            if not self._rest:
                self._rest = frame[write(frame) :]
        except (BlockingIOError, InterruptedError):
            return

    def clear(self) -> None:
        """Forget a rest: the stream begins again."""
        self._rest = b""
