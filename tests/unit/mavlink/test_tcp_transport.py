"""Links over TCP: lost and found again, without a tick that waits."""

from __future__ import annotations

import socket
import time
from typing import Any

from swarmctl.core.clock import SimClock
from swarmctl.mavlink.framing import cut_frames
from swarmctl.mavlink.transport import (
    TcpTransport,
    open_transport,
    pipe_pair,
)
from tests.benches.transports import SECOND, frame


class Server:
    """A listening autopilot; `link` has its connection in the first tick that finds it."""

    def __init__(self, port: int = 0) -> None:
        self.listener = socket.socket()
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.listener.bind(("127.0.0.1", port))
        self.listener.listen(1)
        self.listener.settimeout(2.0)
        self.port = int(self.listener.getsockname()[1])
        self.peer: socket.socket | None = None

    def accept(self) -> socket.socket:
        self.peer, _ = self.listener.accept()
        self.peer.settimeout(2.0)
        return self.peer

    def close(self) -> None:
        if self.peer is not None:
            self.peer.close()
        self.listener.close()


def drain(link: TcpTransport, now_us: int, count: int) -> list[bytes]:
    got: list[bytes] = []
    deadline = time.monotonic() + 2.0
    while len(got) < count and time.monotonic() < deadline:
        got += [d.data for d in link.receive(now_us)]
    return got


def tcp_link(port: int) -> TcpTransport:
    link = open_transport(f"tcp://localhost:{port}")
    assert isinstance(link, TcpTransport)
    return link


def test_tcp_carries_whole_frames_both_ways() -> None:
    server = Server()
    link = tcp_link(server.port)
    assert link.receive(0) == []
    peer = server.accept()
    good = frame(b"abc")
    peer.sendall(b"banner\r\n" + good + good[:7])
    assert drain(link, 5, 1) == [good]
    peer.sendall(good[7:])
    assert drain(link, 6, 1) == [good]
    link.send(good)
    assert peer.recv(100) == good
    link.close()
    server.close()


def test_tcp_comes_back_a_second_after_the_other_end_has_gone() -> None:
    server = Server()
    link = tcp_link(server.port)
    link.receive(0)
    peer = server.accept()
    peer.sendall(frame(b"abc")[:6])
    time.sleep(0.02)
    link.receive(1)
    server.close()
    time.sleep(0.02)
    assert link.receive(2) == []
    link.send(b"into nothing")
    again = Server(server.port)
    assert link.receive(SECOND - 1) == []
    link.receive(SECOND)
    again.accept().sendall(frame(b"xyz"))
    assert drain(link, SECOND + 1, 1) == [frame(b"xyz")], "half a frame of the old connection is forgotten"
    link.close()
    again.close()


def test_tcp_without_a_server_is_tried_again_and_never_blocks() -> None:
    server = Server()
    server.close()
    link = tcp_link(server.port)
    began = time.monotonic()
    for k in range(100):
        assert link.receive(k * 20_000) == []
        link.send(frame(b"abc"))
    assert time.monotonic() - began < 0.5
    late = Server(server.port)
    link.receive(10 * SECOND)
    silent = late.accept()
    assert link.receive(15 * SECOND + 1) == [], "connected but silent for too long: connected again"
    assert silent.recv(1) == b""
    late.accept().sendall(frame(b"abc"))
    assert drain(link, 10 * SECOND + 1, 1) == [frame(b"abc")]
    link.close()
    late.close()


def test_tcp_into_a_full_buffer_drops_whole_frames() -> None:
    server = Server()
    link = tcp_link(server.port)
    link.receive(0)
    peer = server.accept()
    sent = [frame(bytes([k % 256]) * 200) for k in range(40_000)]
    for data in sent:
        link.send(data)
    peer.setblocking(False)
    buffer, got = bytearray(), []
    for _ in range(1000):
        try:
            buffer += peer.recv(1 << 20)
        except BlockingIOError:
            link.send(frame(b"last"))
            time.sleep(0.001)
        got += cut_frames(buffer)
        if got and got[-1] == frame(b"last"):
            break
    assert got[-1] == frame(b"last")
    assert 10 < len(got) < len(sent), "some were dropped"
    assert set(got) <= {*sent, frame(b"last")}, "none was torn"
    link.close()
    server.close()


def test_tcp_reads_a_bounded_amount_at_once_so_that_a_flood_does_not_stall_the_tick() -> None:
    link = tcp_link(1)

    class Flood:
        """A connection whose other end never stops sending."""

        reads = 0

        def recv(self, size: int) -> bytes:
            self.reads += 1
            assert self.reads < 1000, "it is read without end"
            return frame(b"x" * 200) * (size // 212)

        def close(self) -> None:
            return

    flood: Any = Flood()
    link._sock = flood
    got = link.receive(0)
    assert 500 < len(got) < 2000
    assert len(link._buffer) < 300, "what was read is cut, and none of it kept"
    assert link.receive(1), "the next call goes on"
    link.close()


def test_pipe_delays_by_its_latency_in_both_directions() -> None:
    clock = SimClock()
    left, right = pipe_pair(clock.now_us, latency_us=30)
    left.send(b"a")
    right.send(b"b")
    clock.advance(29)
    assert right.receive(clock.now_us()) == left.receive(clock.now_us()) == []
    clock.advance(1)
    assert right.receive(clock.now_us()) == [(30, b"a")]
    assert left.receive(clock.now_us()) == [(30, b"b")]
    assert left.receive(clock.now_us()) == []
