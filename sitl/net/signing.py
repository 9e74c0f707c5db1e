"""MAVLink 2 signing of a simulated autopilot, as PX4 1.18 and ArduCopter 4.6 do it.

Without a key every frame passes. SETUP_SIGNING sets one, and with zeros removes it; then every frame is signed and
verified, on all links. An autopilot has no clock here: its time stamps go on from the newest one that it has received,
and after a reboot from the one that came with its key, as those of PX4.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.net.mavlink_values import Severity
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.signing.signature import (
    STAMPS_PER_S,
    SigningKey,
    Stream,
    is_authentic,
    is_plain,
    is_signed,
    origin,
    sign,
    strip,
)
from swarmctl.mavlink.transport import Datagram, Transport

_AUTOPILOT = 1  # component
_MAGIC_V1 = 0xFE
_LATE = 60 * STAMPS_PER_S  # what a new stream may lag behind
_SETUP_ID = mav.MAVLINK_MSG_ID_SETUP_SIGNING.to_bytes(3, "little")  # as in a frame


class Setup(Enum):
    """What became of a SETUP_SIGNING."""

    ACCEPTED = auto()
    DISABLED = auto()
    ARMED = auto()  # refused, because the vehicle is armed


@dataclass(frozen=True, slots=True, kw_only=True)
class SigningRules:
    """What one kind of autopilot takes without a signature, and says."""

    takes_unsigned: frozenset[int]  # ids of messages
    texts: Mapping[Setup, tuple[Severity, str]]


PX4_RULES = SigningRules(
    takes_unsigned=frozenset(
        {
            mav.MAVLINK_MSG_ID_HEARTBEAT,
            mav.MAVLINK_MSG_ID_RADIO_STATUS,
            mav.MAVLINK_MSG_ID_ADSB_VEHICLE,
            mav.MAVLINK_MSG_ID_COLLISION,
        }
    ),
    texts={
        Setup.ACCEPTED: (Severity.INFO, "MAVLink signing key accepted"),
        Setup.DISABLED: (Severity.INFO, "MAVLink signing disabled"),
        Setup.ARMED: (Severity.WARNING, "MAVLink signing: rejected while armed"),
    },
)
ARDUCOPTER_RULES = SigningRules(
    takes_unsigned=frozenset({mav.MAVLINK_MSG_ID_RADIO_STATUS}),
    texts={Setup.ARMED: (Severity.ERROR, "ERROR: Won't setup signing when armed")},
)


@dataclass(kw_only=True)
class VehicleSigning:
    """The key of one autopilot, and what it remembers of time stamps; its links share it.

    Attributes:
        rules: of this kind of autopilot.
        armed: returns whether it is armed.
        boot_us: returns the time of its last boot.
        tell: sends a text.
        key: None until it is set up.
        refused: received frames, by reason.
    """

    rules: SigningRules
    armed: Callable[[], bool]
    boot_us: Callable[[], int]
    tell: Callable[[Severity, str], None]
    key: SigningKey | None = None
    refused: Counter[str] = field(default_factory=Counter)
    _stored: int = 0  # time stamp that came with the key
    _stamp: int = 0  # newest that was sent or received
    _streams: dict[Stream, int] = field(default_factory=dict)
    _booted_us: int = 0

    def set_up(self, secret: bytes, stamp: int) -> None:
        """Handle a SETUP_SIGNING with this key and time stamp; zeros remove the key."""
        outcome = self._set_up(secret, stamp)
        if outcome in self.rules.texts:
            self.tell(*self.rules.texts[outcome])

    def _set_up(self, secret: bytes, stamp: int) -> Setup:
        if self.armed():
            return Setup.ARMED
        if stamp == 0 and not any(secret):
            self.key = None
            return Setup.DISABLED
        self.key, self._stored = SigningKey(secret), stamp
        self._begin()
        return Setup.ACCEPTED

    def _begin(self) -> None:
        self._stamp, self._booted_us = self._stored, self.boot_us()
        self._streams.clear()

    def signed(self, frame: bytes, link_id: int) -> bytes:
        """Return a frame as it leaves."""
        if self.key is None or not is_plain(frame):
            return frame
        if self.boot_us() != self._booted_us:
            self._begin()
        self._stamp += 1
        return sign(frame, self.key, link_id, self._stamp)

    def taken(self, frame: bytes) -> bytes:
        """Return a received frame without its signature, or b"" for a refused one, which is counted."""
        refusal = self._refusal(frame)
        if refusal:
            self.refused[refusal] += 1
            return b""
        return strip(frame) if is_signed(frame) else frame

    def _refusal(self, frame: bytes) -> str:
        """Return why a frame is not taken, or "" after its time stamp has been noted."""
        if self.key is None:
            return ""
        if not is_signed(frame):
            allowed = frame[0] != _MAGIC_V1 and message_id(frame) in self.rules.takes_unsigned
            return "" if allowed else "unsigned"
        if not is_authentic(frame, self.key):
            return "wrong signature"
        if self.boot_us() != self._booted_us:
            self._begin()
        stream, stamp = origin(frame)
        known = self._streams.get(stream)
        if stamp + _LATE < self._stamp if known is None else stamp <= known:
            return "old"
        self._streams[stream] = stamp
        self._stamp = max(self._stamp, stamp)
        return ""


class SigningLink:
    """One link of an autopilot, with its signatures; handles SETUP_SIGNING.

    Args:
        inner: the link.
        signing: of the autopilot.
        link_id: number of the link.
        sysid: system id of the autopilot.
    """

    def __init__(self, inner: Transport, signing: VehicleSigning, link_id: int, sysid: int) -> None:
        self._inner, self._signing, self._link_id = inner, signing, link_id
        self._codec = Codec(sysid, _AUTOPILOT)

    def send(self, data: bytes) -> None:
        self._inner.send(data if self._signing.key is None else self._signing.signed(data, self._link_id))

    def receive(self, now_us: int) -> list[Datagram]:
        arrived = self._inner.receive(now_us)
        if not arrived:
            return arrived
        return [
            Datagram(datagram.t_us, self._taken(datagram.data)) if self._concerns(datagram.data) else datagram
            for datagram in arrived
        ]

    def close(self) -> None:
        self._inner.close()

    def _concerns(self, data: bytes) -> bool:
        """Return whether a datagram may hold anything else than frames that pass; most flights have no key."""
        return self._signing.key is not None or _SETUP_ID in data

    def _taken(self, data: bytes) -> bytes:
        kept = []
        for frame in frames(data, version_1=True):
            taken = self._signing.taken(frame)
            kept.append(taken)
            if taken and taken[0] != _MAGIC_V1 and taken[7:10] == _SETUP_ID:
                self._set_up(self._codec.decode(taken))
        return b"".join(kept)

    def _set_up(self, message: Any) -> None:
        if message is None or message.target_system not in (0, self._codec.sysid):
            return
        self._signing.set_up(bytes(message.secret_key), message.initial_timestamp)
