"""Signed links: the standard's bytes, as pymavlink has them, and whose frames are taken: a vehicle's, no intruder's.

Each row of `INTRUDERS` names the protection that stands against it; with that one switched off it gets through.
"""

from __future__ import annotations

import contextlib
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.types import GeoOrigin
from swarmctl.mavlink.codec import Codec, heartbeat_of
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.latch import anybody
from swarmctl.mavlink.signing import channel as channels
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel, Stamps
from swarmctl.mavlink.signing.recognition import SignedRecognition
from swarmctl.mavlink.signing.refusals import DAMAGED, FUTURE, OLD, REPLAYED, UNSIGNED, WRONG_SIGNATURE, in_words
from swarmctl.mavlink.signing.signature import (
    STAMPS_PER_S,
    SigningKey,
    Stream,
    is_authentic,
    is_signed,
    origin,
    sign,
    stamp_at,
    strip,
)
from swarmctl.mavlink.signing.signed_transport import SignedTransport
from swarmctl.mavlink.transport import UdpTransport, bind_udp, pipe_pair
from swarmctl.mavlink.vehicle.autopilot import Autopilot

SYSID = 3
SECRET, OTHER_SECRET = bytes(range(32)), bytes(range(1, 33))
KEY = SigningKey(SECRET)
UTC_US = 1_790_000_000_000_000
START = stamp_at(UTC_US)
PX4, ARMED, DISARMED = 12, 128, 0


class Partner:
    """A vehicle that signs and verifies by pymavlink's own implementation."""

    def __init__(self, secret: bytes = SECRET, sysid: int = SYSID, compid: int = 1, stamp: int = START + 10) -> None:
        self.mav = dialect.MAVLink(None, srcSystem=sysid, srcComponent=compid)
        self.mav.signing.secret_key, self.mav.signing.timestamp = secret, stamp
        self.mav.signing.link_id, self.mav.signing.sign_outgoing = 0, True

    def frame(self, message: Any = None) -> bytes:
        if message is None:
            message = dialect.MAVLink_heartbeat_message(2, PX4, DISARMED, 0, 4, 3)
        return bytes(message.pack(self.mav))

    def takes(self, frame: bytes) -> bool:
        with contextlib.suppress(dialect.MAVError):
            return self.mav.decode(bytearray(frame)) is not None
        return False


def beat(base_mode: int = DISARMED) -> Any:
    return dialect.MAVLink_heartbeat_message(2, PX4, base_mode, 0, 4, 3)


def plain(message: Any = None, sysid: int = SYSID) -> bytes:
    return Codec(sysid, 1).encode(beat() if message is None else message)


# -- bytes ------------------------------------------------------------------------------------------------------------

MESSAGES = [
    dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
    dialect.MAVLink_set_attitude_target_message(1, 1, 1, 7, [1, 0, 0, 0], 0.0, 0.0, 0.0, 0.5),
    dialect.MAVLink_timesync_message(0, 123456789),
    dialect.MAVLink_statustext_message(6, b"x" * 50, 1, 0),
    dialect.MAVLink_odometry_message(1, 1, 12, 1, 2, 3, [1, 0, 0, 0], 1, 2, 3, 0, 0, 0, [0.5] * 21, [2] * 21, 1, 1, 1),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.get_type())
def test_each_side_takes_what_the_other_has_signed(message: Any) -> None:
    frame, partner = plain(message), Partner()
    ours = sign(frame, KEY, AGENT_LINK, START + 100)
    assert partner.takes(ours)
    assert strip(ours) == frame, "and the plain frame is regained byte for byte"
    theirs = partner.frame(message)
    assert is_signed(theirs)
    assert is_authentic(theirs, KEY)
    decoded = Codec(SYSID, 1).decode(strip(theirs))
    assert decoded is not None
    assert decoded.to_dict() == message.to_dict()


@given(payload=st.binary(max_size=255), number=st.integers(0, 2**24 - 1), data=st.data())
@settings(max_examples=150, deadline=None)
def test_messages_of_every_dialect_are_signed_and_a_changed_byte_is_noticed(
    payload: bytes, number: int, data: st.DataObject
) -> None:
    header = bytes((0xFD, len(payload), 0, 0, 7, SYSID, 1)) + number.to_bytes(3, "little")
    frame = header + payload + b"\x12\x34"  # a checksum whose seed nobody here knows
    signed = sign(frame, KEY, 5, START)
    assert is_signed(signed)
    assert is_authentic(signed, KEY)
    assert strip(signed) == frame
    place = data.draw(st.integers(0, len(signed) - 1))
    changed = signed[:place] + bytes((signed[place] ^ data.draw(st.integers(1, 255)),)) + signed[place + 1 :]
    assert not (is_signed(changed) and is_authentic(changed, KEY))
    assert not is_authentic(signed, SigningKey(OTHER_SECRET))


def test_a_key_does_not_show_itself() -> None:
    text = f"{KEY!r} {KEY} {vars(KEY).get('fingerprint')}"
    assert SECRET.hex()[:8] not in text
    assert SigningKey(OTHER_SECRET).fingerprint != KEY.fingerprint


# -- what is taken ----------------------------------------------------------------------------------------------------


class Bench:
    """An agent's signed link over a pipe, on a clock that the test sets."""

    def __init__(self, known: Stamps | None = None) -> None:
        self.utc_us = UTC_US
        self.channel = SigningChannel(KEY, AGENT_LINK, lambda: self.utc_us, known or Stamps())
        ours, self.far = pipe_pair(lambda: 0)
        self.link = SignedTransport(ours, self.channel, SYSID, 1)

    def taken(self, *sent: bytes) -> list[bytes]:
        for frame in sent:
            self.far.send(frame)
        return [datagram.data for datagram in self.link.receive(0)]

    @property
    def refused(self) -> dict[str, int]:
        return dict(self.channel.refusals.by_reason)


def test_signed_frames_of_the_vehicle_are_taken_without_their_signatures() -> None:
    bench, vehicle = Bench(), Partner()
    sent = [vehicle.frame(message) for message in MESSAGES]
    assert bench.taken(*sent, sent[0][:-1]) == [strip(frame) for frame in sent], "a cut frame is none"
    assert not bench.refused


def test_what_is_sent_is_signed_with_time_stamps_that_only_increase() -> None:
    bench, vehicle = Bench(Stamps(sent=START + 5 * STAMPS_PER_S)), Partner()
    stamps = []
    for step_us in (0, 0, 20_000, -3_600_000_000, 7_200_000_000):  # a clock that is set back by an hour
        bench.utc_us += step_us
        bench.link.send(plain())
        [datagram] = bench.far.receive(0)
        assert vehicle.takes(datagram.data)
        stamps.append(vehicle.mav.signing.stream_timestamps[AGENT_LINK, SYSID, 1])
    assert stamps == sorted(set(stamps))
    assert stamps[0] == START + 5 * STAMPS_PER_S + 1, "not older than the newest one of an earlier program"
    assert stamps[-1] == stamp_at(bench.utc_us)


@dataclass(frozen=True)
class Intruder:
    """What an intruder sends after the vehicle's first frame, and why it must not be taken."""

    sends: Callable[[Partner, list[bytes]], bytes]  # from the vehicle and what it has sent so far
    reason: str
    without: str  # the protection that stands against it


def _changed(frame: bytes, place: int) -> bytes:
    return frame[:place] + bytes((frame[place] ^ 1,)) + frame[place + 1 :]


def _later(secret: bytes = SECRET, sysid: int = SYSID) -> Partner:
    return Partner(secret, sysid, stamp=START + 50)


def _ahead(seconds: float, secret: bytes = SECRET) -> bytes:
    return Partner(secret, stamp=START + round(seconds * STAMPS_PER_S)).frame(beat(ARMED))


def _largest(secret: bytes) -> bytes:
    return Partner(secret, stamp=2**48 - 1).frame(beat(ARMED))


INTRUDERS = {
    "unsigned": Intruder(lambda v, sent: plain(beat(ARMED)), UNSIGNED, "signatures are asked for"),
    "unsigned radio status": Intruder(
        lambda v, sent: plain(dialect.MAVLink_radio_status_message(1, 1, 1, 1, 1, 1, 1)),
        UNSIGNED,
        "signatures are asked for",
    ),
    "signature cut off": Intruder(lambda v, sent: strip(v.frame()), UNSIGNED, "signatures are asked for"),
    "wrong key": Intruder(lambda v, sent: _later(OTHER_SECRET).frame(), WRONG_SIGNATURE, "the key counts"),
    "signature of zeros": Intruder(lambda v, sent: v.frame()[:-6] + bytes(6), WRONG_SIGNATURE, "the key counts"),
    "damaged": Intruder(lambda v, sent: _changed(v.frame(), 12), DAMAGED, "the key counts"),
    "payload of one, signature of another": Intruder(
        lambda v, sent: v.frame(beat(ARMED))[:-13] + v.frame()[-13:], WRONG_SIGNATURE, "the key counts"
    ),
    "sender changed": Intruder(lambda v, sent: _changed(_later(sysid=SYSID ^ 1).frame(), 5), DAMAGED, "the key counts"),
    "time stamp changed": Intruder(lambda v, sent: _changed(_later().frame(), -12), WRONG_SIGNATURE, "the key counts"),
    "link changed": Intruder(lambda v, sent: _changed(_later().frame(), -13), WRONG_SIGNATURE, "the key counts"),
    "largest time stamp, wrong key": Intruder(
        lambda v, sent: _largest(OTHER_SECRET), WRONG_SIGNATURE, "the key counts"
    ),
    "replayed": Intruder(lambda v, sent: sent[-1], REPLAYED, "time stamps increase"),
    "replayed later": Intruder(lambda v, sent: sent[0], REPLAYED, "time stamps increase"),
    "overtaken by a newer one": Intruder(
        lambda v, sent: Partner(stamp=START + 9).frame(), REPLAYED, "time stamps increase"
    ),
    "recorded before the start": Intruder(lambda v, sent: _ahead(-1.0), OLD, "older than the start"),
    "recorded a day ago": Intruder(lambda v, sent: _ahead(-86_400.0), OLD, "older than the start"),
    "an hour ahead": Intruder(lambda v, sent: _ahead(3600.0), FUTURE, "not ahead"),
    "just over a minute ahead": Intruder(lambda v, sent: _ahead(60.01), FUTURE, "not ahead"),
    "largest time stamp": Intruder(lambda v, sent: _largest(SECRET), FUTURE, "not ahead"),
}


def attacked(name: str, bench: Bench) -> tuple[list[bytes], bool]:
    """Return what is taken of an intruder, and whether the vehicle is received before and afterwards."""
    vehicle = Partner()
    sent = [vehicle.frame() for _ in range(3)]
    before = bench.taken(*sent) == [strip(frame) for frame in sent]
    taken = bench.taken(INTRUDERS[name].sends(vehicle, sent))
    vehicle.mav.signing.timestamp += 10
    after = vehicle.frame()
    return taken, before and bench.taken(after) == [strip(after)]


@pytest.mark.parametrize("name", INTRUDERS)
def test_an_intruder_is_refused_counted_and_shuts_nobody_out(name: str) -> None:
    bench = Bench()
    taken, is_received = attacked(name, bench)
    assert not taken
    assert bench.refused == {INTRUDERS[name].reason: 1}
    assert is_received


@pytest.fixture
def off(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, Bench], None]:
    """Switches one protection of a channel off."""

    def switch(protection: str, bench: Bench) -> None:
        if protection == "signatures are asked for":
            monkeypatch.setattr(bench.channel, "take", lambda frame: strip(frame) if is_signed(frame) else frame)
        elif protection == "the key counts":
            monkeypatch.setattr(channels, "is_authentic", lambda frame, key: True)
            monkeypatch.setattr(channels, "_AHEAD", 2**48)
        elif protection == "time stamps increase":
            bench.channel._newest = NeverNewer()
        elif protection == "older than the start":
            bench.channel._began = 0
            bench.channel._newest = NeverNewer()
        elif protection == "not ahead":
            monkeypatch.setattr(channels, "_AHEAD", 2**48)

    return switch


class NeverNewer(dict[Stream, int]):
    """Forgets every time stamp."""

    def __setitem__(self, stream: Stream, stamp: int) -> None:
        return


@pytest.mark.parametrize("name", INTRUDERS)
def test_negative_control_without_its_protection_the_intruder_gets_through(
    name: str, off: Callable[[str, Bench], None]
) -> None:
    bench = Bench()
    off(INTRUDERS[name].without, bench)
    taken, _ = attacked(name, bench)
    assert taken


def test_negative_control_a_time_stamp_taken_before_the_signature_is_checked_shuts_the_vehicle_out() -> None:
    class Hasty(SigningChannel):
        def take(self, frame: bytes) -> bytes | None:
            taken = super().take(frame)
            stream, stamp = origin(frame)
            self._newest[stream] = max(stamp, self._newest.get(stream, 0))
            return taken

    bench = Bench()
    bench.channel = Hasty(KEY, AGENT_LINK, lambda: UTC_US)
    bench.link = SignedTransport(bench.link._inner, bench.channel, SYSID, 1)
    assert attacked("largest time stamp, wrong key", bench) == ([], False)


def test_no_damage_to_a_signed_frame_gets_through_or_raises() -> None:
    bench, rng = Bench(), random.Random(7)
    good = [Partner(stamp=START + 100 + i).frame(message) for i, message in enumerate(MESSAGES)]
    for _ in range(3000):
        frame = bytearray(rng.choice(good))
        for _ in range(rng.randint(1, 4)):
            frame[rng.randrange(len(frame))] ^= rng.randint(1, 255)
        if bytes(frame) in good:
            continue
        assert not bench.taken(bytes(frame), rng.randbytes(rng.randint(0, 40)))
    assert len(bench.taken(*good)) == len(good), "and none of it shuts the vehicle out"


def test_other_senders_are_neither_taken_nor_counted() -> None:
    bench = Bench()
    assert not bench.taken(Partner(sysid=SYSID + 1).frame(), Partner(compid=191).frame(), plain(sysid=255))
    assert not bench.refused


def test_each_link_of_a_vehicle_has_time_stamps_of_its_own() -> None:
    bench, one, other = Bench(), Partner(stamp=START + 500), Partner(stamp=START + 100)
    other.mav.signing.link_id = 1
    assert len(bench.taken(one.frame(), other.frame())) == 2


def test_a_restarted_program_takes_nothing_that_was_sent_before() -> None:
    first, vehicle = Bench(), Partner(stamp=START + 30 * STAMPS_PER_S)  # half a minute ahead of our clock
    recorded = [vehicle.frame() for _ in range(3)]
    assert len(first.taken(*recorded)) == 3
    assert not Bench(first.channel.stamps()).taken(*recorded)
    forgetful = Bench()
    assert len(forgetful.taken(*recorded)) == 3, "negative control: without the kept time stamps they are taken"


def test_a_clock_that_is_wrong_when_the_program_starts_does_not_refuse_a_vehicle_that_it_has_flown_with() -> None:
    known = Stamps(sent=START + 86_400 * STAMPS_PER_S)  # yesterday the clock was right, or a day ahead
    bench = Bench(known)
    bench.link.send(plain())
    [ours] = bench.far.receive(0)
    vehicle = Partner(stamp=0)
    assert vehicle.takes(ours.data)
    assert bench.taken(vehicle.frame()), "it goes on from our time stamp"


# -- what the agent believes ------------------------------------------------------------------------------------------


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
    far.send(plain(dialect.MAVLink_heartbeat_message(2, PX4, ARMED, 6 << 16, 5, 3)))
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


# -- whose the port is, on real sockets -------------------------------------------------------------------------------


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
