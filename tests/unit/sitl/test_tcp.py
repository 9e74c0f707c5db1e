"""The simulator's TCP links: frames through a stream, one client after the other, clients that do not read."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest

from sitl.net.tcp import TcpServerTransport, serve_tcp
from swarmctl.errors import StartError

FRAME = bytes([0xFD, 1, 0, 0, 0, 1, 1, 0, 0, 0, 7, 0xAA, 0xBB])  # cut, not checked, here


@pytest.fixture
def server() -> Iterator[TcpServerTransport]:
    (served,) = serve_tcp("127.0.0.1", 0, 1)
    yield served
    served.close()


def client_of(server: TcpServerTransport) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", server.port), timeout=2.0)
    server.receive(0)
    return client


def received(server: TcpServerTransport, frames: int) -> list[bytes]:
    got: list[bytes] = []
    deadline = time.monotonic() + 2.0
    while len(got) < frames and time.monotonic() < deadline:
        got += [datagram.data for datagram in server.receive(5)]
    return got


def test_frames_pass_both_ways_however_the_stream_is_cut(server: TcpServerTransport) -> None:
    with client_of(server) as client:
        server.send(FRAME)
        assert client.recv(100) == FRAME
        client.sendall(b"junk" + FRAME + FRAME[:4])
        assert received(server, 1) == [FRAME]
        client.sendall(FRAME[4:])
        assert received(server, 1) == [FRAME]


def test_without_a_client_frames_are_dropped_and_the_next_client_starts_afresh(server: TcpServerTransport) -> None:
    server.send(FRAME)
    with client_of(server) as client:
        client.sendall(FRAME[:5])
    for _ in range(100):  # until its leaving is noticed
        server.receive(0)
        time.sleep(0.001)
    with client_of(server) as client:
        client.sendall(FRAME)
        assert received(server, 1) == [FRAME]
        server.send(FRAME)
        assert client.recv(100) == FRAME, "and nothing from before"


def test_a_client_that_does_not_read_loses_whole_frames_and_blocks_no_other(server: TcpServerTransport) -> None:
    with client_of(server) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        began, size = time.monotonic(), 0
        for _ in range(400_000):
            server.send(FRAME)
        assert time.monotonic() - began < 2.0
        client.settimeout(0.2)
        try:
            while data := client.recv(1 << 16):
                assert all(data[i] == FRAME[(size + i) % len(FRAME)] for i in range(0, len(data), 997))
                size += len(data)
        except TimeoutError:
            pass
        assert 0 < size < 400_000 * len(FRAME)


def test_a_taken_port_is_refused(server: TcpServerTransport) -> None:
    with pytest.raises(StartError, match="--tcp-port"):
        serve_tcp("127.0.0.1", server.port, 1)


def test_ports_are_ten_apart() -> None:
    first = 5760
    for _ in range(50):  # others may use some
        try:
            servers = serve_tcp("127.0.0.1", first, 3)
            break
        except StartError:
            first += 31
    assert [s.port - first for s in servers] == [0, 10, 20]
    for s in servers:
        s.close()
