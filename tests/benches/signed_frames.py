"""Signed frames and those who send them, for tests."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import development as dialect

from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel, Stamps
from swarmctl.mavlink.signing.refusals import DAMAGED, FUTURE, OLD, REPLAYED, UNSIGNED, WRONG_SIGNATURE
from swarmctl.mavlink.signing.signature import (
    STAMPS_PER_S,
    SigningKey,
    stamp_at,
    strip,
)
from swarmctl.mavlink.signing.signed_transport import SignedTransport
from swarmctl.mavlink.transport import pipe_pair

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


MESSAGES = [
    dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
    dialect.MAVLink_set_attitude_target_message(1, 1, 1, 7, [1, 0, 0, 0], 0.0, 0.0, 0.0, 0.5),
    dialect.MAVLink_timesync_message(0, 123456789),
    dialect.MAVLink_statustext_message(6, b"x" * 50, 1, 0),
    dialect.MAVLink_odometry_message(1, 1, 12, 1, 2, 3, [1, 0, 0, 0], 1, 2, 3, 0, 0, 0, [0.5] * 21, [2] * 21, 1, 1, 1),
]


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
