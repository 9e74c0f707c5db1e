"""MAVLink listener for checks: receives from every sender, because foreign senders and protocols are findings.

The flying link (`transport`) accepts its vehicle alone; this one reports the sender of each datagram. It sends only to
the address that it is given.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from collections.abc import Mapping
from typing import NamedTuple, Protocol

from swarmctl.mavlink.transport import (
    MAX_DATAGRAM,
    Transport,
    bind_towards,
    bind_udp,
    open_transport,
    parse_url,
    resolve,
)
from swarmctl.wall_clock import monotonic_us

Address = tuple[str, int]
NOWHERE: Address = ("", 0)
_DATAGRAMS_AT_ONCE = 200  # bounded, so that one flooded link does not starve the others
_SO_RXQ_OVFL = 40  # Linux: each datagram comes with the number that found the queue full; not in Python's socket
_COUNT = struct.Struct("@I")


class ReceivedDatagram(NamedTuple):
    """A datagram with its monotonic arrival time [us] and its sender."""

    t_us: int
    data: bytes
    sender: Address


class Listener(Protocol):
    """Receives and sends on one vehicle's link without blocking.

    Attributes:
        dropped: datagrams that reached this computer and found its queue full, as far as the system tells.
        refused: frames not taken on a signed link, by reason; None: the link is not signed.
    """

    @property
    def dropped(self) -> int: ...

    @property
    def refused(self) -> Mapping[str, int] | None: ...

    def receive(self) -> list[ReceivedDatagram]:
        """Return everything that has arrived since the last call."""

    def send(self, data: bytes, to: Address) -> None:
        """Send one frame; it is dropped when the link can't take it."""

    def fd(self) -> int | None:
        """Return the file descriptor to wait for, or None where there is none."""

    def close(self) -> None:
        """Release the port."""


def open_listener(url: str) -> tuple[Listener, Address]:
    """Open the link that a URL names; return it with the address to send to first (`NOWHERE`: wait for the vehicle).

    Raises:
        StartError: the port is taken, the host has no address, or the device does not exist.
    """
    endpoint = parse_url(url)
    if endpoint.scheme == "udpin":
        return UdpListener(bind_udp(endpoint.where, endpoint.number)), NOWHERE
    if endpoint.scheme == "udpout":
        there = resolve(endpoint.where), endpoint.number
        return UdpListener(bind_towards(there)), there
    there = endpoint.where, endpoint.number
    return TransportListener(open_transport(url), there), there


class UdpListener:
    """Listens on a bound UDP socket."""

    refused = None

    def __init__(self, sock: socket.socket) -> None:
        self.dropped = 0
        self._sock = sock
        self._sock.setblocking(False)
        if sys.platform == "linux":
            self._sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)

    def receive(self) -> list[ReceivedDatagram]:
        heard: list[ReceivedDatagram] = []
        for _ in range(_DATAGRAMS_AT_ONCE):
            try:
                data, ancillary, _, sender = self._sock.recvmsg(MAX_DATAGRAM, socket.CMSG_SPACE(_COUNT.size))
            except ConnectionRefusedError:
                continue  # ICMP port unreachable surfaces here once
            except OSError:
                break
            heard.append(ReceivedDatagram(monotonic_us(), data, sender))
            for level, kind, value in ancillary:
                if level == socket.SOL_SOCKET and kind == _SO_RXQ_OVFL:
                    [self.dropped] = _COUNT.unpack(value)
        return heard

    def send(self, data: bytes, to: Address) -> None:
        with contextlib.suppress(OSError):
            self._sock.sendto(data, to)

    def fd(self) -> int | None:
        return self._sock.fileno()

    def close(self) -> None:
        self._sock.close()


class TransportListener:
    """Listens on a serial or TCP link, which has one other end."""

    refused = None

    def __init__(self, transport: Transport, there: Address) -> None:
        self.dropped = 0
        self._transport, self._there = transport, there

    def receive(self) -> list[ReceivedDatagram]:
        return [ReceivedDatagram(d.t_us, d.data, self._there) for d in self._transport.receive(monotonic_us())]

    def send(self, data: bytes, to: Address) -> None:
        self._transport.send(data)

    def fd(self) -> int | None:
        return None

    def close(self) -> None:
        self._transport.close()
