"""Byte links to a vehicle: UDP, TCP, serial, and an in-memory pipe for lockstep. None of them blocks.

A transport moves datagrams and stamps their arrival; of MAVLink it only cuts streams into frames. Broken streams are
reopened without limit: a lost vehicle is judged elsewhere.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import struct
import sys
import zlib
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol

from swarmctl.errors import StartError
from swarmctl.mavlink.codec import is_intact
from swarmctl.mavlink.framing import FrameWriter, cut_frames
from swarmctl.mavlink.latch import Address, Greeting, IsVehicle, Latch, admit_only, anybody, silence
from swarmctl.mavlink.serial_devices import serial_problem
from swarmctl.wall_clock import utc_us

MAX_DATAGRAM = 2048
_CHUNK = 65536
_DATAGRAMS_A_POLL, _BYTES_A_POLL = 600, 131_072  # limits of one tick; the rest waits for the next
_BUFFER_BYTES = 1 << 20  # as much as the system allows, so that frames survive a pause of the reader
_SO_TIMESTAMPNS = 35  # Linux; socket.SO_TIMESTAMPNS is not exported before Python 3.13
_TIMESPEC = struct.Struct("@qq")
_URL = re.compile(r"^(?P<scheme>udpin|udpout|tcp|serial)://(?P<where>[^:]+):(?P<number>\d+)$")
_LOCAL_PORTS = (20000, 32700)  # local ports towards vehicles that we address first; below the ephemeral range
_NEIGHBOURS = 16
_REOPEN_US = 1_000_000
_LOST_AFTER_US = 5_000_000  # every autopilot sends a heartbeat once a second


class Datagram(NamedTuple):
    """Received bytes and their monotonic arrival time [us]."""

    t_us: int
    data: bytes


class Transport(Protocol):
    """A byte link to one vehicle."""

    def send(self, data: bytes) -> None:
        """Send one frame; it is dropped, never queued, when the link can't take it."""

    def receive(self, now_us: int) -> list[Datagram]:
        """Return everything that has arrived since the last call."""

    def close(self) -> None:
        """Release the port."""


class Endpoint(NamedTuple):
    """A parsed vehicle URL."""

    scheme: str  # udpin | udpout | tcp | serial
    where: str  # host, or device path
    number: int  # port, or baud rate


def parse_url(url: str) -> Endpoint:
    """Split `udpin://host:port`, `udpout://host:port`, `tcp://host:port` or `serial:///dev/tty:baud`.

    Raises:
        ValueError: with the allowed forms, when the URL has none of them or the port is out of range.
    """
    match = _URL.match(url)
    if match is None:
        raise ValueError(
            f"{url!r}: use udpin://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT or serial:///DEVICE:BAUD"
        )
    endpoint = Endpoint(match["scheme"], match["where"], int(match["number"]))
    if endpoint.scheme != "serial" and not 1 <= endpoint.number <= 65535:
        raise ValueError(f"{url!r}: port {endpoint.number} is outside 1..65535")
    return endpoint


def open_transport(
    url: str,
    inherited_fd: int | None = None,
    is_vehicle: IsVehicle = anybody,
    remote: Address | None = None,
    *,
    greeting: Greeting = silence,
) -> Transport:
    """Open the link that a URL names.

    Args:
        url: see `parse_url`.
        inherited_fd: a bound UDP socket from the launcher, which holds the port so that no other launch can
            take it between the check and the flight.
        is_vehicle: whether a datagram shows that its sender is the vehicle; the first sender of one owns the port.
        remote: known address of the other end of an inherited socket.
        greeting: what a sender is answered who is not the vehicle, while the port has no owner.

    Raises:
        StartError: the port is taken, the host has no address, or the device does not exist.
    """
    endpoint = parse_url(url)
    if endpoint.scheme == "serial":
        return SerialTransport(endpoint.where, endpoint.number)
    if inherited_fd is not None:
        return UdpTransport(socket.socket(fileno=inherited_fd), remote, is_vehicle, greeting)
    if endpoint.scheme == "udpin":
        return UdpTransport(bind_udp(endpoint.where, endpoint.number), None, is_vehicle, greeting)
    there = resolve(endpoint.where), endpoint.number
    if endpoint.scheme == "tcp":
        return TcpTransport(there)
    return UdpTransport(bind_towards(there), there, is_vehicle, greeting)


def resolve(host: str) -> str:
    """Return the IPv4 address of a host. Resolved once, because a name server would stall the tick.

    Raises:
        StartError: the host has no address.
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise StartError(f"{host} has no IPv4 address: {error}; check the host") from error


def bind_udp(host: str, port: int) -> socket.socket:
    """Return a bound UDP socket without address reuse: a second binder must fail instead of taking the traffic.

    Raises:
        StartError: the port is taken or the host is not ours.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    try:
        sock.bind((host, port))
    except (OSError, OverflowError) as error:
        sock.close()
        raise StartError(f"udp {host}:{port} can't be bound: {error}. Choose a free port or stop its owner") from error
    return sock


def bind_towards(remote: tuple[str, int]) -> socket.socket:
    """Return a UDP socket on a local port that is the same at every start, as PX4 sends to the first port only.

    Raises:
        StartError: the port and its neighbours are taken.
    """
    host = _own_address(remote)
    first = _LOCAL_PORTS[0] + zlib.crc32(f"{remote[0]}:{remote[1]}".encode()) % (_LOCAL_PORTS[1] - _LOCAL_PORTS[0])
    for port in range(first, first + _NEIGHBOURS):  # another vehicle may have the same port
        with contextlib.suppress(StartError):
            return bind_udp(host, port)
    raise StartError(f"udp ports {first} to {port} are taken. Stop what talks to {remote[0]}:{remote[1]} already")


def _own_address(remote: tuple[str, int]) -> str:
    """Return the address of the interface that leads to `remote`; every interface while there is no route."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(remote)  # sends nothing
        except OSError:
            return "0.0.0.0"
        return str(probe.getsockname()[0])


class UdpTransport:
    """A UDP socket that receives from and sends to one address: the vehicle, see `Latch`.

    With `remote` set it sends first. The kernel stamps arrivals, so a tick that drains the socket every 20 ms still
    knows the arrival time of each sample. One call reads a bounded amount, so that a flood can't stall the tick.
    """

    def __init__(
        self,
        sock: socket.socket,
        remote: Address | None = None,
        is_vehicle: IsVehicle = anybody,
        greeting: Greeting = silence,
    ) -> None:
        self._sock = sock
        self._sock.setblocking(False)
        self._greeting = greeting
        self.latch = Latch(is_vehicle, remote)
        self._admitted: Address | None = None  # sender that the kernel admits; None: every sender
        self._empty_us = 0  # when nothing was left: what is read next has arrived since, also where UTC has been set
        self._stamped = sys.platform == "linux"
        if self._stamped:
            self._sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    @property
    def fd(self) -> int:
        """File descriptor, for a selector."""
        return self._sock.fileno()

    def send(self, data: bytes) -> None:
        if self.latch.remote is None:
            return
        try:
            self._sock.sendto(data, self.latch.remote)
        except OSError:
            return  # full buffer, or no receiver: the autopilot's own failsafe judges silence

    def receive(self, now_us: int) -> list[Datagram]:
        latch = self.latch
        latch.poll(now_us)
        self._admit(latch.only)
        arrived: list[Datagram] = []
        left, least_us = _BYTES_A_POLL, self._empty_us
        for _ in range(_DATAGRAMS_A_POLL):
            try:
                data, ancillary, _, sender = self._sock.recvmsg(MAX_DATAGRAM, 64)
            except ConnectionRefusedError:
                continue  # ICMP port unreachable surfaces here once
            except OSError:
                self._empty_us = now_us
                break
            if latch.admits(sender, data):
                arrived.append(Datagram(max(least_us, self._arrival_us(ancillary, now_us)), data))
                left -= len(data)
            elif latch.only is None and (greeting := self._greeting(data)):
                with contextlib.suppress(OSError):
                    self._sock.sendto(greeting, sender)
            if left < 0:
                break
        self._admit(latch.only)
        return arrived

    def _admit(self, sender: Address | None) -> None:
        if sender != self._admitted:
            self._admitted = sender
            admit_only(self._sock, sender)

    def _arrival_us(self, ancillary: list[tuple[int, int, bytes]], now_us: int) -> int:
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                age_us: int = utc_us() - (seconds * 1_000_000 + nanoseconds // 1000)
                return now_us - max(0, age_us)
        return now_us

    def close(self) -> None:
        self._sock.close()


class TcpTransport:
    """A TCP client (ArduPilot listens on 5760) that cuts frames out of the byte stream.

    It connects while the tick runs, and again a second after the other end has gone. Frames that do not fit into the
    socket buffer are dropped whole. One call reads a bounded amount, so that a flood can't stall the tick.
    """

    def __init__(self, remote: tuple[str, int]) -> None:
        self._remote = remote
        self._sock: socket.socket | None = None
        self._open_us: int | None = None  # begin of the last attempt
        self._received_us = 0
        self._buffer = bytearray()
        self._writer = FrameWriter()

    def send(self, data: bytes) -> None:
        if self._sock is None:
            return
        try:
            self._writer.send(self._sock.send, data)
        except OSError:
            self._lose()

    def receive(self, now_us: int) -> list[Datagram]:
        if self._sock is not None and now_us - self._received_us > _LOST_AFTER_US:
            self._lose()  # a peer that vanished without FIN would block for a quarter of an hour
        if self._sock is None and (self._open_us is None or now_us - self._open_us >= _REOPEN_US):
            self._open(now_us)
        try:
            left = _BYTES_A_POLL
            while self._sock is not None and left > 0:
                data = self._sock.recv(_CHUNK)
                if not data:
                    self._lose()
                self._buffer += data
                left -= len(data)
                self._received_us = now_us
        except (BlockingIOError, InterruptedError):
            pass  # the socket is empty, or still connecting
        except OSError:
            self._lose()
        return [Datagram(now_us, frame) for frame in cut_frames(self._buffer)]

    def close(self) -> None:
        self._lose()

    def _open(self, now_us: int) -> None:
        self._open_us = self._received_us = now_us
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._sock.setblocking(False)
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with contextlib.suppress(BlockingIOError, OSError):  # recv tells whether it has worked
            self._sock.connect(self._remote)

    def _lose(self) -> None:
        if self._sock is not None:
            self._sock.close()
        self._sock = None
        self._writer.clear()
        self._buffer.clear()


class SerialTransport:
    """A serial port that cuts frames out of a byte stream with gaps; it is reopened after it was unplugged.

    No other program of ours shares it: each would read bytes of the other's frames. Frames that do not fit into the
    output buffer are dropped whole.
    """

    def __init__(self, device: str, baud: int) -> None:
        import termios

        import serial  # only serial links need it

        def open_port() -> Any:
            try:
                return serial.Serial(device, baud, timeout=0, exclusive=True)
            except termios.error as error:  # the device has vanished while it was being set up
                raise OSError(*error.args) from error

        self._open_port: Callable[[], Any] = open_port
        try:
            self._port: Any = open_port()
        except (OSError, ValueError) as error:  # SerialException is an OSError
            taken = isinstance(error, OSError) and error.errno in (errno.EWOULDBLOCK, errno.EBUSY)
            why = serial_problem(device) or ("it is in use by another program; end that one" if taken else error)
            raise StartError(f"serial {device} at {baud} baud can't be opened: {why}") from error
        self._lost_us: int | None = None
        self._lost = False
        self._buffer = bytearray()
        self._writer = FrameWriter()

    def send(self, data: bytes) -> None:
        if self._port is None:
            return
        try:
            self._writer.send(partial(os.write, self._port.fileno()), data)  # pyserial's waits for room
        except OSError:
            self._lost = True

    def receive(self, now_us: int) -> list[Datagram]:
        self._reopen(now_us)
        if self._port is None:
            return []
        try:
            self._buffer += self._port.read(_CHUNK)
        except OSError:
            self._lost = True
            return []
        return [Datagram(now_us, frame) for frame in cut_frames(self._buffer, judge=is_intact)]

    def close(self) -> None:
        if self._port is not None:
            self._port.close()

    def _reopen(self, now_us: int) -> None:
        if self._lost and self._port is not None:
            with contextlib.suppress(OSError):
                self._port.close()
            self._port, self._lost_us = None, now_us
            self._buffer.clear()
            self._writer.clear()
        if self._port is None and self._lost_us is not None and now_us - self._lost_us >= _REOPEN_US:
            self._lost_us = now_us
            with contextlib.suppress(OSError):
                self._port = self._open_port()
                self._lost = False


class PipeTransport:
    """One end of an in-memory link on a simulated clock; `latency_us` delays every datagram."""

    def __init__(self, now_us: Callable[[], int], latency_us: int = 0) -> None:
        self._now_us = now_us
        self._latency_us = latency_us
        self._inbox: deque[Datagram] = deque()
        self.other: PipeTransport = self

    def send(self, data: bytes) -> None:
        self.other._inbox.append(Datagram(self._now_us() + self._latency_us, data))

    def receive(self, now_us: int) -> list[Datagram]:
        arrived: list[Datagram] = []
        while self._inbox and self._inbox[0].t_us <= now_us:
            arrived.append(self._inbox.popleft())
        return arrived

    def close(self) -> None:
        self._inbox.clear()


def pipe_pair(now_us: Callable[[], int], latency_us: int = 0) -> tuple[PipeTransport, PipeTransport]:
    """Return two connected ends."""
    left, right = PipeTransport(now_us, latency_us), PipeTransport(now_us, latency_us)
    left.other, right.other = right, left
    return left, right
