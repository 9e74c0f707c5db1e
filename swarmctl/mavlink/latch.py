"""Ownership of a UDP port: the sender of the vehicle's heartbeat owns it for as long as it sends.

This module is pure; the test of a datagram is passed in. `admit_only` makes the kernel drop all other datagrams, so
that a flood neither fills the socket buffer nor costs the tick time.
"""

from __future__ import annotations

import contextlib
import ctypes
import socket
import struct
import sys
from collections.abc import Callable

Address = tuple[str, int]
IsVehicle = Callable[[bytes], bool]  # whether a datagram shows that its sender is the vehicle
Greeting = Callable[[bytes], bytes]  # what to answer the sender of a datagram that is not known to be the vehicle's

_SILENT_US = 3_000_000  # after this silence the vehicle may send from another address
_SLEPT_US = 500_000  # after this long without a poll, silence can't be attributed
_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27  # Linux
_INSTRUCTION = struct.Struct("=HBBI")  # code, jump if true, jump if false, constant
_LOAD_HALF, _LOAD_WORD, _JUMP_IF_EQUAL, _RETURN = 0x28, 0x20, 0x15, 0x06
_SOURCE_PORT, _SOURCE_ADDRESS = 0, 0xFFF0000C  # offsets: in the UDP header, in the IP header
_WHOLE = 0xFFFFFFFF


def anybody(data: bytes) -> bool:
    """Accept the first sender of anything: for ports that only the vehicle knows."""
    return True


def nobody(data: bytes) -> bool:
    """Accept no other sender than the given one, however long it is silent."""
    return False


def silence(data: bytes) -> bytes:
    """Answer nothing."""
    return b""


class Latch:
    """Decides which sender is the vehicle.

    Args:
        is_vehicle: whether a datagram shows that its sender is the vehicle.
        remote: expected address of the vehicle; None: it sends first.

    Attributes:
        remote: address of the vehicle; None before its first datagram.
        moves: number of address changes that have been followed.
    """

    def __init__(self, is_vehicle: IsVehicle, remote: Address | None = None) -> None:
        self._is_vehicle = is_vehicle
        self.remote = remote
        self.moves = 0
        self._received_us: int | None = None  # last datagram of the vehicle, or begin of the wait for it
        self._polled_us: int | None = None

    @property
    def only(self) -> Address | None:
        """The only sender to receive from; None while any sender is possible."""
        return None if self.remote is None or self._is_stale else self.remote

    def poll(self, now_us: int) -> None:
        """Judge silence; called before each drain of the port, because only a polled port can be silent."""
        slept = self._polled_us is None or now_us - self._polled_us > _SLEPT_US
        self._polled_us = now_us
        if slept or self._received_us is None:
            self._received_us = now_us

    def admits(self, sender: Address, data: bytes) -> bool:
        """Return whether a datagram is the vehicle's."""
        if sender == self.remote:
            self._received_us = self._polled_us
            return True
        if (self.remote is not None and not self._is_stale) or not self._is_vehicle(data):
            return False
        self.moves += self.remote is not None
        self.remote, self._received_us = sender, self._polled_us
        return True

    @property
    def _is_stale(self) -> bool:
        if self._polled_us is None or self._received_us is None:
            return False
        return self._polled_us - self._received_us > _SILENT_US


def admit_only(sock: socket.socket, sender: Address | None) -> None:
    """Have the kernel drop datagrams of every sender but `sender` (None: of no sender). Linux only.

    A connected socket would do the same, but receives nothing that is sent to another of the host's addresses.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError):
        if sender is None:
            sock.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
            return
        (address,) = struct.unpack("!I", socket.inet_aton(sender[0]))
        program = b"".join(
            _INSTRUCTION.pack(*instruction)
            for instruction in (
                (_LOAD_HALF, 0, 0, _SOURCE_PORT),
                (_JUMP_IF_EQUAL, 0, 3, sender[1]),
                (_LOAD_WORD, 0, 0, _SOURCE_ADDRESS),
                (_JUMP_IF_EQUAL, 0, 1, address),
                (_RETURN, 0, 0, _WHOLE),
                (_RETURN, 0, 0, 0),
            )
        )
        held = ctypes.create_string_buffer(program, len(program))
        count = len(program) // _INSTRUCTION.size
        sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, struct.pack("@HP", count, ctypes.addressof(held)))
