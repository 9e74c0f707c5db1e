"""A vehicle link that hears everybody, for checks: who else sends here, and in which protocol, is part of the answer.

The flying link (`transport`) obeys its vehicle and drops the rest; this one tells them apart. It answers only the
address it is told to.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import NamedTuple, Protocol

from swarmctl.mavlink.transport import Transport, bind_towards, bind_udp, open_transport, parse_url, resolve

Address = tuple[str, int]
NOWHERE: Address = ("", 0)
_MAX_DATAGRAM = 2048
_DATAGRAMS_AT_ONCE = 200  # one flooded link must not starve the others


class ReceivedDatagram(NamedTuple):
    """Bytes, when they arrived (monotonic) and who sent them."""

    t_us: int
    data: bytes
    sender: Address


class Listener(Protocol):
    """One vehicle's link. Never blocks."""

    def receive(self) -> list[ReceivedDatagram]:
        """What has arrived since the last call."""

    def send(self, data: bytes, to: Address) -> None:
        """Hand over one frame; dropped when the link can't take it."""

    def fd(self) -> int | None:
        """Descriptor to wait for, None where there is none."""

    def close(self) -> None:
        """Release the port."""


def monotonic_us() -> int:
    """Now, of the clock that every time in a check is of."""
    return time.monotonic_ns() // 1000


def open_listener(url: str) -> tuple[Listener, Address]:
    """The link a URL names, and where to speak before anybody was heard (`NOWHERE`: nowhere).

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
    """A bound UDP socket."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._sock.setblocking(False)

    def receive(self) -> list[ReceivedDatagram]:
        heard: list[ReceivedDatagram] = []
        for _ in range(_DATAGRAMS_AT_ONCE):
            try:
                data, sender = self._sock.recvfrom(_MAX_DATAGRAM)
            except ConnectionRefusedError:
                continue  # ICMP port unreachable surfaces here once
            except OSError:
                break
            heard.append(ReceivedDatagram(monotonic_us(), data, sender))
        return heard

    def send(self, data: bytes, to: Address) -> None:
        with contextlib.suppress(OSError):
            self._sock.sendto(data, to)

    def fd(self) -> int | None:
        return self._sock.fileno()

    def close(self) -> None:
        self._sock.close()


class TransportListener:
    """Serial and TCP: there is one other end."""

    def __init__(self, transport: Transport, there: Address) -> None:
        self._transport, self._there = transport, there

    def receive(self) -> list[ReceivedDatagram]:
        return [ReceivedDatagram(d.t_us, d.data, self._there) for d in self._transport.receive(monotonic_us())]

    def send(self, data: bytes, to: Address) -> None:
        self._transport.send(data)

    def fd(self) -> int | None:
        return None

    def close(self) -> None:
        self._transport.close()
