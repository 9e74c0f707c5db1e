"""What an agent believes on a signed link, and whose the port is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.types import GeoOrigin
from swarmctl.mavlink.codec import Codec, heartbeat_of
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.latch import anybody
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel
from swarmctl.mavlink.signing.recognition import SignedRecognition
from swarmctl.mavlink.signing.refusals import DAMAGED, OLD, REPLAYED, UNSIGNED, in_words
from swarmctl.mavlink.signing.signature import (
    STAMPS_PER_S,
    strip,
)
from swarmctl.mavlink.signing.signed_transport import SignedTransport
from swarmctl.mavlink.transport import UdpTransport, bind_udp, pipe_pair
from swarmctl.mavlink.vehicle.autopilot import Autopilot
from tests.benches.signed_frames import (
    ARMED,
    KEY,
    MESSAGES,
    OTHER_SECRET,
    PX4,
    START,
    SYSID,
    UTC_US,
    Bench,
    Partner,
    _ahead,
    _changed,
    attacked,
    plain,
)


@pytest.mark.parametrize("signed", [True, False], ids=["signed link", "negative control: plain link"])
def test_a_forged_heartbeat_changes_neither_mode_nor_armed_state(signed: bool) -> None:
    utc_us = UTC_US
    channel = SigningChannel(KEY, AGENT_LINK, lambda: utc_us)
    ours, far = pipe_pair(lambda: 0)
    link = SignedTransport(ours, channel, SYSID, 1) if signed else ours
    autopilot = Autopilot(
        link,
        Codec(SYSID, 191),
        SYSID,
        GeoOrigin(47.0, 8.0, 400.0),
        on_frame=lambda frame: None,
        refusals=channel.refusals,
    )
    far.send(Partner().frame() if signed else plain())
    autopilot.poll(0)
    assert autopilot.received_us is not None
    before = autopilot.mode
    far.send(plain(dialect.MAVLink_heartbeat_message(2, PX4, ARMED, 6 << 16, 8, 3)))
    autopilot.poll(1000)
    is_believed = not signed
    assert (autopilot.armed, autopilot.failsafe, autopilot.mode != before) == (is_believed,) * 3
    assert autopilot.refusals.alert(utc_us) == ("frames of the vehicle refused: unsigned" if signed else "")
    assert autopilot.refusals.alert(utc_us + 10_000_000) == ""


def test_refusals_that_networks_cause_alone_raise_no_alert_and_all_are_reported_once_a_second() -> None:
    bench, told = Bench(), []
    for name in ("replayed", "recorded before the start", "damaged"):
        attacked(name, bench)
    refusals = bench.channel.refusals
    assert refusals.alert(UTC_US) == ""

    def note(name: str, **fields: Any) -> None:
        told.append((name, fields))

    for utc_us in range(UTC_US, UTC_US + 3_000_000, 20_000):
        bench.taken(plain())
        refusals.report(utc_us, note)
    assert [name for name, _ in told] == ["frames_refused"] * 6
    assert [fields["reason"] for _, fields in told] == [REPLAYED, OLD, DAMAGED, UNSIGNED, UNSIGNED, UNSIGNED]
    assert in_words({REPLAYED: 1, UNSIGNED: 2}) == "1 replayed, 2 unsigned"


def now_us() -> int:
    return time.monotonic_ns() // 1000


class Port:
    """A port of an agent whose vehicle sends first, and senders on other ports."""

    def __init__(self) -> None:
        self.utc_us = UTC_US
        self.channel = SigningChannel(KEY, AGENT_LINK, lambda: self.utc_us)
        self.seen = SignedRecognition(self.channel, SYSID, 191, lambda: self.utc_us)
        self.sock = bind_udp("127.0.0.1", 0)
        self.udp = UdpTransport(self.sock, None, self.seen.is_vehicle, self.seen.greeting)
        self.link = SignedTransport(self.udp, self.channel, SYSID, 1)
        self.vehicle, self.stranger = (bind_udp("127.0.0.1", 0) for _ in range(2))
        for sock in (self.vehicle, self.stranger):
            sock.settimeout(5.0)

    def said(self, who: Any, *sent: bytes, at_us: int | None = None) -> list[bytes]:
        """Return what the agent takes of these datagrams; loopback keeps their order."""
        for datagram in sent:
            who.sendto(datagram, self.sock.getsockname())
        return [datagram.data for datagram in self.link.receive(now_us() if at_us is None else at_us)]

    def answered(self, who: Any) -> bytes:
        who.setblocking(False)
        try:
            return bytes(who.recv(2048))
        except BlockingIOError:
            return b""

    def close(self) -> None:
        for sock in (self.sock, self.vehicle, self.stranger):
            sock.close()


@pytest.fixture
def port() -> Iterator[Port]:
    made = Port()
    yield made
    made.close()


STRANGERS: dict[str, Callable[[], bytes]] = {
    "one byte": lambda: b"x",
    "nothing": lambda: b"",
    "unsigned heartbeat": plain,
    "heartbeat with another key": lambda: Partner(OTHER_SECRET).frame(),
    "heartbeat of another system with the key": lambda: Partner(sysid=SYSID + 1).frame(),
    "heartbeat of a companion with the key": lambda: Partner(compid=191).frame(),
    "signed state without heartbeat": lambda: Partner().frame(MESSAGES[2]),
    "heartbeat an hour ahead": lambda: _ahead(3600.0),
    "recorded heartbeat": lambda: _ahead(-5.0),
    "changed heartbeat": lambda: _changed(Partner().frame(), 12),
}


@pytest.mark.parametrize("name", STRANGERS)
def test_a_stranger_who_speaks_first_does_not_get_the_port(port: Port, name: str) -> None:
    assert not port.said(port.stranger, STRANGERS[name]())
    assert port.udp.latch.remote is None
    first = Partner().frame()
    assert port.said(port.vehicle, first) == [strip(first)]
    assert port.udp.latch.remote == port.vehicle.getsockname()
    assert not port.said(port.stranger, Partner(stamp=START + 50).frame()), "nor later, with a signed one"


@pytest.mark.parametrize("name", STRANGERS)
def test_negative_control_without_recognition_the_first_sender_gets_the_port(port: Port, name: str) -> None:
    port.udp.latch._is_vehicle = anybody
    port.said(port.stranger, STRANGERS[name]())
    assert port.udp.latch.remote == port.stranger.getsockname()


def test_negative_control_recognition_of_plain_heartbeats_gives_a_stranger_the_port(port: Port) -> None:
    port.udp.latch._is_vehicle = heartbeat_of(SYSID)
    port.said(port.stranger, plain())
    assert port.udp.latch.remote == port.stranger.getsockname()


def test_a_silent_vehicle_is_followed_to_another_port_by_its_signed_heartbeat_alone(port: Port) -> None:
    vehicle, began_us = Partner(), now_us()
    heard = vehicle.frame()
    assert port.said(port.vehicle, heard, at_us=began_us)
    for after_us in range(0, 3_400_000, 200_000):
        port.said(port.vehicle, at_us=began_us + after_us)
    for name in STRANGERS:
        assert not port.said(port.stranger, STRANGERS[name](), at_us=began_us + 3_400_000), name
    assert not port.said(port.stranger, heard, at_us=began_us + 3_400_000), "replayed"
    assert port.udp.latch.remote == port.vehicle.getsockname()
    moved = bind_udp("127.0.0.1", 0)
    vehicle.mav.signing.timestamp += 100
    newer = vehicle.frame()
    assert port.said(moved, newer, at_us=began_us + 3_400_000) == [strip(newer)]
    assert port.udp.latch.remote == moved.getsockname()
    moved.close()


def test_a_vehicle_whose_time_stamps_are_of_long_ago_is_greeted_and_then_recognised(port: Port) -> None:
    booted = Partner(stamp=START - 86_400 * STAMPS_PER_S)  # PX4 begins with the time stamp that came with its key
    assert not port.said(port.vehicle, booted.frame())
    assert port.udp.latch.remote is None
    greeting = port.answered(port.vehicle)
    assert booted.takes(greeting)
    assert [frame[7:10] for frame in frames(greeting)] == [bytes(3)], "a HEARTBEAT alone"
    newer = booted.frame()
    assert port.said(port.vehicle, newer) == [strip(newer)]
    assert port.answered(port.vehicle) == b"", "the owner of the port is not greeted"


def test_only_old_authentic_heartbeats_are_greeted_and_not_often(port: Port) -> None:
    for name in set(STRANGERS) - {"recorded heartbeat"}:
        port.said(port.stranger, STRANGERS[name]())
        assert port.answered(port.stranger) == b"", name
    answers = 0
    for _ in range(50):
        port.utc_us += 10_000
        port.said(port.stranger, _ahead(-5.0))
        answers += bool(port.answered(port.stranger))
    assert answers == 3, "five a second"
