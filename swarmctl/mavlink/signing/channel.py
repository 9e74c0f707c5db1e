"""The signed side of one link: signs what is sent, and decides which frames of the vehicle are taken.

A frame is taken if the shared key has signed it, and only then does its time stamp count: a forged one can't shut out
its real sender. Time stamps of a stream must increase, and must not be a minute ahead. They must also be newer than the
start of this program: a vehicle takes over the newest time stamp that it receives, as the standard says, so what it
sends after our first frame is newer, and what was recorded before is not. Nothing unsigned is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from swarmctl.mavlink.codec import is_intact
from swarmctl.mavlink.signing.refusals import DAMAGED, FUTURE, OLD, REPLAYED, UNSIGNED, WRONG_SIGNATURE, FrameRefusals
from swarmctl.mavlink.signing.signature import (
    MOST_STAMP,
    STAMPS_PER_S,
    SigningKey,
    Stream,
    is_authentic,
    is_plain,
    is_signed,
    origin,
    sign,
    stamp_at,
    strip,
)

AGENT_LINK, CHECK_LINK = 1, 2  # link ids: vehicles remember time stamps by them, so programs have one each
_NO_STREAM = Stream(0, 0, 0)
_AHEAD = 60 * STAMPS_PER_S  # largest lead of a vehicle's time stamp over ours


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamps:
    """Time stamps that must not be used or taken again."""

    sent: int = 0  # newest one of ours
    received: Mapping[Stream, int] = field(default_factory=dict)  # newest one of each stream


NO_STAMPS = Stamps()


class SigningChannel:
    """Signs and verifies the frames of one link.

    Args:
        key: shared with the vehicle.
        link_id: of the frames that are sent.
        utc_us: returns disciplined UTC [us]; it may be wrong, time stamps increase all the same.
        known: time stamps of earlier programs with this key.

    Attributes:
        refusals: frames that were not taken.
    """

    def __init__(self, key: SigningKey, link_id: int, utc_us: Callable[[], int], known: Stamps = NO_STAMPS) -> None:
        self._key, self._link_id, self._utc_us = key, link_id, utc_us
        self._sent = self._began = max(known.sent, stamp_at(utc_us()))
        self._newest = dict(known.received)
        self.refusals = FrameRefusals()

    def stamps(self) -> Stamps:
        """Return the newest time stamps; another thread may ask."""
        return Stamps(sent=self._sent, received=dict(self._newest))

    def sign(self, frame: bytes) -> bytes:
        """Return a frame as it is to be sent; what can't be signed, as of MAVLink 1, is returned as it is."""
        if not is_plain(frame):
            return frame
        return sign(frame, self._key, self._link_id, self.next_stamp())

    def next_stamp(self) -> int:
        """Return a time stamp newer than every one before."""
        self._sent = min(MOST_STAMP, max(self._sent + 1, stamp_at(self._utc_us())))
        return self._sent

    def fault(self, frame: bytes) -> str:
        """Return why a frame would not be taken now, or "". Changes nothing."""
        return self._examined(frame)[0]

    def take(self, frame: bytes) -> bytes | None:
        """Return a received frame without its signature, or None for a refused one, which is counted."""
        fault, stream, stamp = self._examined(frame)
        if fault:
            self.refuse(fault)
            return None
        self._newest[stream] = stamp
        return strip(frame)

    def _examined(self, frame: bytes) -> tuple[str, Stream, int]:
        """Return why a frame would not be taken now, or "", and of one that is authentic its stream and time stamp."""
        if not is_signed(frame):
            return UNSIGNED, _NO_STREAM, 0
        if not is_authentic(frame, self._key):
            return (DAMAGED if is_intact(frame) is False else WRONG_SIGNATURE), _NO_STREAM, 0
        stream, stamp = origin(frame)
        if stamp <= self._began:
            return OLD, stream, stamp
        if stamp <= self._newest.get(stream, 0):
            return REPLAYED, stream, stamp
        return (FUTURE if self._is_ahead(stamp) else ""), stream, stamp

    def refuse(self, fault: str) -> None:
        """Count a frame that was refused."""
        self.refusals.add(fault, self._utc_us())

    def _is_ahead(self, stamp: int) -> bool:
        """Return whether a time stamp is too far ahead; the clock, whose reading costs, is asked last."""
        return stamp - self._sent > _AHEAD and stamp - stamp_at(self._utc_us()) > _AHEAD
