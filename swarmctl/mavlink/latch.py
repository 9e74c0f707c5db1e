"""Whom a UDP port belongs to: the sender of a vehicle's heartbeat, for as long as it speaks, and nobody else.

Pure; what makes a datagram a vehicle's is handed in. `admit_only` has the kernel drop everybody else's datagrams, so
that a flood neither fills the socket's buffer nor costs the tick anything.
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

_SILENT_US = 3_000_000  # after which the vehicle may speak from another address
_SLEPT_US = 500_000  # without a poll for so long, nobody knows who was silent
_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27  # Linux
_INSTRUCTION = struct.Struct("=HBBI")  # code, jump if true, jump if false, constant
_LOAD_HALF, _LOAD_WORD, _JUMP_IF_EQUAL, _RETURN = 0x28, 0x20, 0x15, 0x06
_SOURCE_PORT, _SOURCE_ADDRESS = 0, 0xFFF0000C  # offsets: in the UDP header, in the IP header
_WHOLE = 0xFFFFFFFF


def anybody(data: bytes) -> bool:
    """The first sender of anything: for ports that only the vehicle knows of."""
    return True


def nobody(data: bytes) -> bool:
    """No sender but the given one, however long it is silent."""
    return False


class Latch:
    """Which sender is the vehicle.

    Args:
        is_vehicle: whether a datagram shows that its sender is the vehicle.
        remote: where the vehicle is expected; None: it will speak first.

    Attributes:
        remote: where the vehicle is; None before it was heard.
        strangers: datagrams of others so far, as far as the kernel has let them through.
        moves: how often the vehicle has been followed to another address.
    """

    def __init__(self, is_vehicle: IsVehicle, remote: Address | None = None) -> None:
        self._is_vehicle = is_vehicle
        self.remote = remote
        self.strangers = self.moves = 0
        self._heard_us: int | None = None  # the vehicle, or when waiting for it began
        self._polled_us: int | None = None

    @property
    def only(self) -> Address | None:
        """The only sender worth hearing; None while it may be anybody."""
        return None if self.remote is None or self._silent else self.remote

    def poll(self, now_us: int) -> None:
        """Called before every draining of the port: judges silence, and only while somebody has listened."""
        slept = self._polled_us is None or now_us - self._polled_us > _SLEPT_US
        self._polled_us = now_us
        if slept or self._heard_us is None:
            self._heard_us = now_us

    def admits(self, sender: Address, data: bytes) -> bool:
        """Whether a datagram is the vehicle's."""
        if sender == self.remote:
            self._heard_us = self._polled_us
            return True
        if (self.remote is not None and not self._silent) or not self._is_vehicle(data):
            self.strangers += 1
            return False
        self.moves += self.remote is not None
        self.remote, self._heard_us = sender, self._polled_us
        return True

    @property
    def _silent(self) -> bool:
        if self._polled_us is None or self._heard_us is None:
            return False
        return self._polled_us - self._heard_us > _SILENT_US


def admit_only(sock: socket.socket, sender: Address | None) -> None:
    """Have the kernel drop the datagrams of everybody but `sender`; None: of nobody. Without effect but on Linux.

    A connected socket would do the same, but hears nothing that is sent to another of the host's addresses.
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
