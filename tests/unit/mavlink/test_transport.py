"""Byte links: valid URLs, owners of ports, the address that is answered, arrival times, and ends of frames."""

from __future__ import annotations

import errno
import os
import pty
import socket
import termios
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.errors import StartError
from swarmctl.mavlink import serial_devices
from swarmctl.mavlink import transport as transport_module
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import cut_frames
from swarmctl.mavlink.transport import (
    Endpoint,
    SerialTransport,
    UdpTransport,
    bind_udp,
    open_transport,
    parse_url,
)
from swarmctl.wall_clock import monotonic_us, utc_us
from tests.benches.transports import SECOND, frame


@pytest.mark.parametrize(
    ("url", "endpoint"),
    [
        ("udpin://0.0.0.0:14540", Endpoint("udpin", "0.0.0.0", 14540)),
        ("udpout://px4.local:1", Endpoint("udpout", "px4.local", 1)),
        ("udpin://127.0.0.1:65535", Endpoint("udpin", "127.0.0.1", 65535)),
        ("tcp://127.0.0.1:5760", Endpoint("tcp", "127.0.0.1", 5760)),
        ("serial:///dev/ttyACM0:57600", Endpoint("serial", "/dev/ttyACM0", 57600)),
        ("serial:///dev/ttyS1:921600", Endpoint("serial", "/dev/ttyS1", 921600)),
    ],
)
def test_urls(url: str, endpoint: Endpoint) -> None:
    assert parse_url(url) == endpoint


@pytest.mark.parametrize(
    "url",
    [
        "",
        "14540",
        "udp://127.0.0.1:14540",
        "tcp://127.0.0.1",
        "tcpout://127.0.0.1:5760",
        "udpin://127.0.0.1",
        "udpin://:14540",
        "udpin://127.0.0.1:0",
        "udpout://127.0.0.1:65536",
        "udpin://127.0.0.1:-1",
        "udpin://127.0.0.1:14540/",
        " udpin://127.0.0.1:14540",
        "serial:///dev/ttyACM0",
    ],
)
def test_bad_urls_are_refused_with_the_value_and_what_is_allowed(url: str) -> None:
    with pytest.raises(ValueError, match=r"use udpin://|outside 1\.\.65535") as refused:
        parse_url(url)
    assert repr(url) in str(refused.value)


@pytest.fixture
def bound() -> Iterator[socket.socket]:
    sock = bind_udp("127.0.0.1", 0)
    yield sock
    sock.close()


def test_a_taken_port_is_refused_even_to_one_that_would_share(bound: socket.socket) -> None:
    port = bound.getsockname()[1]
    with pytest.raises(StartError, match=f"127.0.0.1:{port}"):
        bind_udp("127.0.0.1", port)
    with pytest.raises(StartError, match=f":{port}"):
        open_transport(f"udpin://127.0.0.1:{port}")
    thief = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    with pytest.raises(OSError, match="in use"):
        thief.bind(("127.0.0.1", port))
    thief.close()


def test_a_host_that_is_not_ours_is_a_start_error() -> None:
    with pytest.raises(StartError, match=r"192\.0\.2\.1"):
        bind_udp("192.0.2.1", 14540)


def wait_for(link: UdpTransport, count: int) -> list[bytes]:
    got: list[bytes] = []
    deadline = time.monotonic() + 2.0
    while len(got) < count and time.monotonic() < deadline:
        got += [d.data for d in link.receive(time.monotonic_ns() // 1000)]
    return got


def client() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.settimeout(1.0)
    return sock


def test_the_first_sender_is_the_peer_and_no_other_is_received_or_answered(bound: socket.socket) -> None:
    link = UdpTransport(bound)
    vehicle, stranger = client(), client()
    link.send(b"to nobody")  # no peer yet: dropped
    vehicle.sendto(b"first", bound.getsockname())
    assert wait_for(link, 1) == [b"first"]
    stranger.sendto(b"intruder", bound.getsockname())
    vehicle.sendto(b"second", bound.getsockname())
    assert wait_for(link, 1) == [b"second"]
    link.send(b"setpoint")
    assert vehicle.recv(100) == b"setpoint"
    stranger.settimeout(0.05)
    with pytest.raises(TimeoutError):
        stranger.recv(100)
    vehicle.close()
    stranger.close()


def test_udpout_talks_first_and_hears_the_answer() -> None:
    vehicle = client()
    link = open_transport(f"udpout://127.0.0.1:{vehicle.getsockname()[1]}")
    assert isinstance(link, UdpTransport)
    link.send(b"hello")
    data, sender = vehicle.recvfrom(100)
    vehicle.sendto(b"state", ("127.0.0.1", sender[1]))
    assert data == b"hello"
    assert wait_for(link, 1) == [b"state"]
    vehicle.close()
    link.close()


def test_a_link_that_sends_first_uses_the_same_port_at_every_start() -> None:
    ports = []
    for _ in range(2):
        link = open_transport("udpout://127.0.0.1:14581")
        assert isinstance(link, UdpTransport)
        ports.append(socket.socket(fileno=os.dup(link.fd)).getsockname()[1])
        link.close()
    assert ports[0] == ports[1]
    both = [open_transport("udpout://127.0.0.1:14581") for _ in range(2)]
    for link in both:
        link.close()


def test_arrival_is_stamped_by_the_kernel_and_not_by_the_tick_that_drains(bound: socket.socket) -> None:
    link = UdpTransport(bound)
    vehicle = client()
    sent_us = []
    for _ in range(2):
        sent_us.append(time.monotonic_ns() // 1000)
        vehicle.sendto(b"x", bound.getsockname())
        time.sleep(0.04)
    now_us = time.monotonic_ns() // 1000
    stamps_us = [d.t_us for d in link.receive(now_us)]
    assert len(stamps_us) == 2
    for stamp_us, expected_us in zip(stamps_us, sent_us, strict=True):
        assert abs(stamp_us - expected_us) < 10_000
    assert stamps_us[0] < stamps_us[1] < now_us
    vehicle.close()


@pytest.mark.parametrize("set_by_us", [-3_600_000_000, 3_600_000_000])
def test_a_clock_that_is_set_moves_no_arrival_by_more_than_a_tick(
    bound: socket.socket, monkeypatch: pytest.MonkeyPatch, set_by_us: int
) -> None:
    """An arrival an hour ago would look like a silent link, after which the mode of the vehicle is in doubt."""
    link, vehicle = UdpTransport(bound), client()
    emptied_us = monotonic_us()
    assert link.receive(emptied_us) == []
    vehicle.sendto(b"x", bound.getsockname())
    monkeypatch.setattr(transport_module, "utc_us", lambda: utc_us() + set_by_us)
    now_us = monotonic_us()
    [datagram] = link.receive(now_us)
    assert emptied_us <= datagram.t_us <= now_us
    vehicle.close()


def test_an_inherited_socket_is_used_as_it_is(bound: socket.socket) -> None:
    link = open_transport("udpin://127.0.0.1:1", os.dup(bound.fileno()))
    vehicle = client()
    vehicle.sendto(b"x", bound.getsockname())
    assert isinstance(link, UdpTransport)
    assert wait_for(link, 1) == [b"x"]
    link.close()
    vehicle.close()


def test_a_missing_receiver_is_not_an_error_of_the_tick() -> None:
    gone = client()
    link = open_transport(f"udpout://127.0.0.1:{gone.getsockname()[1]}")
    gone.close()
    for _ in range(3):
        link.send(b"x")
        assert link.receive(0) == []
    link.close()


def test_frames_are_cut_out_of_a_byte_stream_however_it_is_split() -> None:
    frames = [frame(b"abc"), frame(b""), frame(b"signed", signed=True), frame(bytes(255))]
    stream = b"".join(frames)
    for size in (1, 2, 7, 100, len(stream)):
        buffer, got = bytearray(), []
        for start in range(0, len(stream), size):
            buffer += stream[start : start + size]
            got += cut_frames(buffer)
        assert got == frames
        assert not buffer


def test_junk_before_and_between_frames_is_dropped() -> None:
    good = frame(b"abc")
    buffer = bytearray(b"\xfe\x01boot text\r\n" + good + b"\x00\x01" + good + b"tail")
    assert cut_frames(buffer) == [good, good]
    assert not buffer


def test_a_stream_recovers_from_a_false_start() -> None:
    good = frame(b"abcdefgh")  # 20 bytes
    buffer = bytearray(b"\xfd\xff" + good * 100)
    got = cut_frames(buffer)
    assert got.count(good) >= 85  # one false length swallows at most 280 bytes: 14 frames
    assert got[-1] == good


def test_half_a_frame_waits_for_the_rest() -> None:
    good = frame(b"abc")
    buffer = bytearray(good[:-1])
    assert cut_frames(buffer) == []
    assert bytes(buffer) == good[:-1]
    buffer += good[-1:]
    assert cut_frames(buffer) == [good]


def test_serial_passes_on_whole_frames() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = SerialTransport(os.ttyname(slave), 57600)
    good = frame(b"abc")
    os.write(master, b"noise" + good + good[:5])
    time.sleep(0.02)
    assert [(d.t_us, d.data) for d in link.receive(77)] == [(77, good)]
    os.write(master, good[5:])
    time.sleep(0.02)
    assert [d.data for d in link.receive(99)] == [good]
    link.send(good)
    assert os.read(master, 100) == good
    link.close()
    os.close(master)
    os.close(slave)


def test_a_byte_that_a_serial_line_loses_costs_one_frame() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = SerialTransport(os.ttyname(slave), 57600)
    codec = Codec(1, 1)
    sent = [codec.encode(mavlink.MAVLink_ping_message(7, k, 1, 1)) for k in range(4)]
    os.write(master, sent[0] + sent[1][:15] + sent[1][16:] + sent[2] + sent[3])
    found: list[bytes] = []
    until_s = time.monotonic() + 5.0
    while sent[3] not in found and time.monotonic() < until_s:
        found += [datagram.data for datagram in link.receive(0)]
    assert [data for data in found if codec.payload(data) is not None] == [sent[0], sent[2], sent[3]]
    assert codec.refused.total() == 1
    link.close()
    os.close(master)
    os.close(slave)


def test_a_serial_port_is_opened_once() -> None:
    master, slave = pty.openpty()
    url = f"serial://{os.ttyname(slave)}:57600"
    first = open_transport(url)
    with pytest.raises(StartError, match=r"at 57600 baud can't be opened: it is in use by another program"):
        open_transport(url)
    first.close()
    open_transport(url).close()
    os.close(master)
    os.close(slave)


def test_a_serial_device_that_is_not_there_is_said_to_be_missing_and_which_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_devices, "_FOLDER", tmp_path)
    (tmp_path / "ttyACM1").touch()
    (tmp_path / "tty7").touch()
    missing = tmp_path / "ttyUSB0"
    with pytest.raises(StartError) as refused:
        open_transport(f"serial://{missing}:57600")
    assert str(refused.value) == (
        f"serial {missing} at 57600 baud can't be opened: {missing} does not exist; "
        f"serial ports here: {tmp_path}/ttyACM1. Plug it in, or name another"
    )


@pytest.mark.timeout(20)
def test_a_serial_port_that_takes_nothing_costs_frames_and_no_time() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = SerialTransport(os.ttyname(slave), 57600)
    sent = [frame(str(number).encode() * 7) for number in range(5000)]
    begun_s = time.monotonic()
    for data in sent:
        link.send(data)
    assert time.monotonic() - begun_s < 2.0
    os.set_blocking(master, False)
    arrived = drained(master)
    assert 0 < len(arrived) < sum(map(len, sent)), "its buffer was full"
    last = frame(b"last")
    link.send(last)
    arrived += drained(master)
    taken = cut_frames(bytearray(arrived))
    assert b"".join(taken) == arrived, "the rest of a frame goes before the next one"
    assert taken[-1] == last
    assert [data for data in sent if data in set(taken)] == taken[:-1]
    link.close()
    os.close(master)
    os.close(slave)


def drained(fd: int) -> bytes:
    """Return all bytes that have arrived at the far end."""
    data, silent = b"", 0
    while silent < 5:
        try:
            data, silent = data + os.read(fd, 65536), 0
        except BlockingIOError:
            silent += 1
            time.sleep(0.01)
    return data


def test_a_missing_serial_device_is_a_start_error_with_its_name() -> None:
    with pytest.raises(StartError, match="/dev/no-such-port at 57600"):
        open_transport("serial:///dev/no-such-port:57600")


def test_a_serial_device_that_vanishes_while_it_is_opened_again_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loose plug; pyserial lets an error of the set-up pass that is no OSError."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    link = SerialTransport(os.ttyname(slave), 57600)
    monkeypatch.setattr(link._port, "read", lambda size: os.read(-1, size))
    assert link.receive(0) == []

    def vanished(*_: object, **__: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    with monkeypatch.context() as change:
        change.setattr(serial, "Serial", vanished)
        for second in range(1, 4):
            assert link.receive(second * SECOND) == []
    link.receive(9 * SECOND)
    os.write(master, frame(b"back"))
    time.sleep(0.02)
    assert [d.data for d in link.receive(10 * SECOND)] == [frame(b"back")]
    link.close()
    os.close(master)
    os.close(slave)


def test_a_serial_port_that_is_unplugged_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    link = SerialTransport(name, 57600)
    good = frame(b"abc")
    port = link._port

    def unplugged(size: int) -> bytes:
        raise OSError("device disconnected")

    monkeypatch.setattr(port, "read", unplugged)
    assert link.receive(SECOND) == []
    link.send(good)  # into nothing
    assert link.receive(SECOND + 1) == []
    assert link.receive(2 * SECOND) == []
    assert link._port is None
    assert link.receive(2 * SECOND + 1) == []
    assert link._port is not None, "opened again a second later"
    os.write(master, good)
    time.sleep(0.02)
    assert [d.data for d in link.receive(3 * SECOND)] == [good]
    link.close()
    os.close(master)
    os.close(slave)


def test_a_host_without_an_address_is_a_start_error() -> None:
    for url in ("tcp://no-such-host.invalid:5760", "udpout://no-such-host.invalid:14540"):
        with pytest.raises(StartError, match=r"no-such-host\.invalid has no IPv4 address"):
            open_transport(url)


def test_names_are_resolved_once_so_that_the_answer_is_known_for_the_peers() -> None:
    vehicle = client()
    link = open_transport(f"udpout://localhost:{vehicle.getsockname()[1]}")
    assert isinstance(link, UdpTransport)
    link.send(b"hello")
    _, sender = vehicle.recvfrom(100)
    vehicle.sendto(b"state", ("127.0.0.1", sender[1]))
    assert wait_for(link, 1) == [b"state"]
    vehicle.close()
    link.close()
