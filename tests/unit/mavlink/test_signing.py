"""Signed links: the standard's bytes, as pymavlink has them, and whose frames are taken: a vehicle's, no intruder's.

Each row of `INTRUDERS` names the protection that stands against it; with that one switched off it gets through.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.signing import channel as channels
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel, Stamps
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
from tests.benches.signed_frames import (
    INTRUDERS,
    KEY,
    MESSAGES,
    OTHER_SECRET,
    SECRET,
    START,
    SYSID,
    UTC_US,
    Bench,
    Partner,
    attacked,
    plain,
)


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


def test_a_program_that_has_sent_nothing_for_minutes_takes_what_is_stamped_now() -> None:
    """An agent that knows no state pauses its heartbeats, while its vehicle goes on."""
    bench, vehicle = Bench(), Partner(stamp=START + 120 * STAMPS_PER_S)
    assert not bench.taken(vehicle.frame())
    bench.utc_us += 120_000_000
    assert bench.taken(vehicle.frame())
