"""Ownership of a UDP port: the vehicle's from its first heartbeat on, also after a move and under a flood."""

from __future__ import annotations

import multiprocessing
import socket
import time
from collections.abc import Iterator
from multiprocessing.synchronize import Event
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as dialect

from swarmctl.mavlink import transport
from swarmctl.mavlink.codec import Codec, heartbeat_of
from swarmctl.mavlink.latch import Latch, admit_only, anybody, nobody
from swarmctl.mavlink.transport import UdpTransport, bind_towards, bind_udp

SYSID = 3
TICK_US = 20_000
PX4, INVALID = 12, 8
VEHICLE, ELSEWHERE, STRANGER = ("127.0.0.1", 14580), ("127.0.0.1", 14581), ("127.0.0.1", 40_000)


def beat(sysid: int = SYSID, compid: int = 1, kind: int = 2, autopilot: int = PX4) -> bytes:
    return Codec(sysid, compid).encode(dialect.MAVLink_heartbeat_message(kind, autopilot, 128, 0, 4, 3))


def state(t_us: int = 0) -> bytes:
    return Codec(SYSID, 1).encode(dialect.MAVLink_attitude_message(t_us // 1000 % 2**32, 0, 0, 0, 0, 0, 0))


BROKEN = bytes([*beat()[:-1], beat()[-1] ^ 1])
NO_VEHICLE = {
    "text": b"hello",
    "nothing": b"",
    "state without a heartbeat": state(),
    "bad checksum": BROKEN,
    "another system": beat(sysid=SYSID + 1),
    "companion of the vehicle": beat(compid=191, kind=18, autopilot=INVALID),
    "companion that names an autopilot": beat(compid=191),
    "ground station with the vehicle's ids": beat(kind=6, autopilot=INVALID),
    "MAVLink 1": b"\xfe" + beat()[1:],
}


@pytest.mark.parametrize("data", NO_VEHICLE.values(), ids=NO_VEHICLE)
def test_what_is_no_heartbeat_of_the_vehicle_does_not_latch(data: bytes) -> None:
    latch = Latch(heartbeat_of(SYSID))
    latch.poll(0)
    assert not latch.admits(STRANGER, data)
    assert latch.remote is None
    assert latch.admits(VEHICLE, state() + beat()), "wherever in the datagram"
    assert latch.remote == VEHICLE


def polled(latch: Latch, from_us: int, to_us: int, speaks: tuple[str, int] | None = None) -> None:
    for now_us in range(from_us, to_us, TICK_US):
        latch.poll(now_us)
        if speaks is not None:
            latch.admits(speaks, state())


def latched() -> Latch:
    latch = Latch(heartbeat_of(SYSID))
    latch.poll(0)
    latch.admits(VEHICLE, beat())
    return latch


def test_a_vehicle_is_followed_to_another_address_only_after_it_was_silent_at_the_old_one() -> None:
    latch = latched()
    polled(latch, 0, 2_900_000)
    assert not latch.admits(ELSEWHERE, beat())
    assert latch.only == VEHICLE
    polled(latch, 2_900_000, 3_200_000)
    assert latch.only is None
    for data in NO_VEHICLE.values():
        assert not latch.admits(STRANGER, data)
    assert latch.admits(ELSEWHERE, beat())
    assert (latch.remote, latch.only, latch.moves) == (ELSEWHERE, ELSEWHERE, 1)
    assert not latch.admits(VEHICLE, beat())


def test_a_vehicle_that_sends_is_not_followed_to_another_address() -> None:
    latch = latched()
    polled(latch, 0, 10_000_000, speaks=VEHICLE)
    assert not latch.admits(ELSEWHERE, beat())


def test_silence_without_a_poll_is_not_attributed() -> None:
    latch = latched()
    latch.poll(20_000_000)  # we slept
    assert not latch.admits(ELSEWHERE, beat())


def test_a_given_address_is_the_vehicles_until_it_is_silent_and_for_good_where_no_other_sender_is_allowed() -> None:
    latch = Latch(heartbeat_of(SYSID), VEHICLE)
    latch.poll(0)
    assert not latch.admits(ELSEWHERE, beat())
    assert latch.admits(VEHICLE, state())
    fixed = Latch(nobody, VEHICLE)
    polled(fixed, 0, 10_000_000)
    assert not fixed.admits(ELSEWHERE, beat())
    assert fixed.admits(VEHICLE, b"anything")


# -- on real sockets --------------------------------------------------------------------------------------------------


def now() -> int:
    return time.monotonic_ns() // 1000


def speaker() -> socket.socket:
    sock = bind_udp("127.0.0.1", 0)
    sock.settimeout(1.0)
    return sock


@pytest.fixture
def port() -> Iterator[socket.socket]:
    sock = bind_udp("127.0.0.1", 0)
    yield sock
    sock.close()


def heard(link: UdpTransport, count: int, wait_s: float = 1.0) -> list[bytes]:
    got: list[bytes] = []
    deadline = time.monotonic() + wait_s
    while len(got) < count and time.monotonic() < deadline:
        got += [d.data for d in link.receive(now())]
    return got


def test_a_stranger_that_sends_first_gets_neither_the_link_nor_an_answer(port: socket.socket) -> None:
    link = UdpTransport(port, None, heartbeat_of(SYSID))
    vehicle, stranger = speaker(), speaker()
    for data in (b"hello", beat(sysid=99), BROKEN, state()):
        stranger.sendto(data, port.getsockname())
    assert heard(link, 1, 0.05) == []
    link.send(b"to nobody")
    vehicle.sendto(beat(), port.getsockname())
    assert heard(link, 1) == [beat()]
    link.send(b"setpoint")
    assert vehicle.recv(100) == b"setpoint"
    stranger.settimeout(0.02)
    with pytest.raises(TimeoutError):
        stranger.recv(100)
    for sock in (vehicle, stranger):
        sock.close()


def test_the_kernel_keeps_strangers_out_of_the_buffer_until_the_vehicle_may_have_moved(port: socket.socket) -> None:
    vehicle, stranger = speaker(), speaker()
    port.setblocking(False)
    admit_only(port, vehicle.getsockname())
    stranger.sendto(beat(), port.getsockname())
    vehicle.sendto(b"state", port.getsockname())
    assert port.recv(100) == b"state"
    with pytest.raises(BlockingIOError):
        port.recv(100)
    admit_only(port, None)
    stranger.sendto(b"heard again", port.getsockname())
    assert port.recv(100) == b"heard again"
    for sock in (vehicle, stranger):
        sock.close()


def test_a_vehicle_that_comes_back_on_another_port_is_received_and_answered_there(port: socket.socket) -> None:
    link = UdpTransport(port, None, heartbeat_of(SYSID))
    before, after = speaker(), speaker()
    start_us = now()
    before.sendto(beat(), port.getsockname())
    assert heard(link, 1) == [beat()]
    before.close()
    came_us = None
    for k in range(200):
        after.sendto(beat(), port.getsockname())
        if link.receive(start_us + k * TICK_US):  # a simulated clock: real sockets, no waiting
            came_us = k * TICK_US
            break
    assert came_us is not None
    assert 2_900_000 < came_us < 3_200_000
    link.send(b"setpoint")
    assert after.recv(100) == b"setpoint"
    after.close()


def test_a_link_that_sends_first_binds_the_interface_towards_the_vehicle() -> None:
    sock = bind_towards(("127.0.0.1", 14581))
    assert sock.getsockname()[0] == "127.0.0.1"
    sock.close()


def flood(port: int, stop: Event, rate_hz: Any) -> None:
    """Send as fast as possible from a separate port; record the rate."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    began, count = time.monotonic(), 0
    while not stop.is_set():
        for _ in range(200):
            sock.sendto(b"x" * 60, ("127.0.0.1", port))
        count += 200
    rate_hz.value = count / (time.monotonic() - began)


def fly_through_flood(link: UdpTransport, port: int, seconds: float) -> tuple[list[float], int, int, float]:
    """Times of the ticks' draining [ms], frames of the vehicle sent and heard, and the flood's rate [1/s]."""
    stop, rate_hz = multiprocessing.Event(), multiprocessing.Value("d", 0.0)
    flooder = multiprocessing.Process(target=flood, args=(port, stop, rate_hz), daemon=True)
    vehicle = speaker()
    vehicle.sendto(beat(), ("127.0.0.1", port))
    assert heard(link, 1) == [beat()]
    flooder.start()
    time.sleep(0.3)
    duration_ms, sent, got = [], 0, 0
    for k in range(round(seconds / 0.02)):
        for _ in range(2):
            sent += vehicle.sendto(state(k), ("127.0.0.1", port)) > 0
        time.sleep(0.02)
        began = time.thread_time()  # what the drain costs, not what else the machine does
        got += len(link.receive(now()))
        duration_ms.append((time.thread_time() - began) * 1e3)
    stop.set()
    flooder.join(5.0)
    vehicle.close()
    return duration_ms, sent, got, float(rate_hz.value)


def test_a_flood_costs_the_tick_nothing_and_loses_nothing_of_the_vehicle(port: socket.socket) -> None:
    link = UdpTransport(port, None, heartbeat_of(SYSID))
    duration_ms, sent, got, rate_hz = fly_through_flood(link, port.getsockname()[1], 2.0)
    worst_ms = max(duration_ms)
    print(f"flood {rate_hz:.0f}/s: worst drain {worst_ms:.2f} ms, {got} of {sent} frames")
    assert rate_hz > 20_000
    assert got == sent
    assert worst_ms < 5.0


def test_negative_control_without_the_kernels_help_the_drain_is_bounded_but_frames_are_lost(
    port: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transport, "admit_only", lambda *_, **__: None)
    link = UdpTransport(port, None, heartbeat_of(SYSID))
    duration_ms, sent, got, rate_hz = fly_through_flood(link, port.getsockname()[1], 2.0)
    drain_ms = float(np.percentile(duration_ms, 95))  # a thread is also charged for packets that the kernel takes in
    print(f"flood {rate_hz:.0f}/s: drain {drain_ms:.2f} ms, {got} of {sent} frames")
    assert got < sent
    assert drain_ms < 8.0


def test_one_poll_takes_in_so_much_and_no_more(port: socket.socket) -> None:
    link = UdpTransport(port, None, anybody)
    vehicle = speaker()
    vehicle.sendto(b"first", port.getsockname())
    assert heard(link, 1) == [b"first"]
    for _ in range(200):
        vehicle.sendto(bytes(1500), port.getsockname())
    sizes: list[int] = []
    while not sizes or sizes[-1]:
        sizes.append(sum(len(d.data) for d in link.receive(now())))
    assert max(sizes) <= 131_072 + 1500
    assert sum(size > 0 for size in sizes) > 1, "the rest comes with the next"
    vehicle.close()
