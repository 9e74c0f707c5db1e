"""Who is believed under a sender's name, where anybody on the bus can write that name. Pure: no bus, no clock.

A sender numbers its messages; the numbers start anew when its process does, under another boot id. So a message of
another boot id may be a restart, or a forgery that would silence the sender whose next words then look like those of
a former life. The rules of `SenderVerifier`:

1. Boot id and number go on from the message before, and the number is not farther ahead than its sender's rate allows
   for the time between them, as received or as stamped, whichever is longer: believed.
2. Otherwise it begins, or goes on, a *claim*. When the believed stream goes on with something said after a claim
   began, the claim is dropped as contradicted: a process that has been replaced says nothing more.
3. A claim is believed instead of the believed stream after `CONFIRMATIONS` messages that go on from one another, while
   the sender's token is on the bus, and
   a. the token has come (back) since the last word of the believed stream: a restart, believed with its third message;
   b. or the believed stream has been silent for `SILENCE_US`, longer than a token outlives its process: a restart whose
      token was never seen to leave (the old process was frozen or cut off while the new one started), or a believed
      stream that was itself a forgery.

Absence of news is no news: a token that is gone proves nothing by itself, nor does silence; only what is said does.
Token and messages race, and neither order hurts: messages that overtake the token are a claim until it comes, words of
the former life that come late (said before the token came, by their stamp) don't count as the stream going on since.
What this can't tell is a forger who goes on from the newest message as its sender would: that takes signatures. It
leaves traces, for then one number has two contents.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from swarmctl.bus.refusals import BOOT, REPLAYED, SEQUENCE, UNCONFIRMED, Refusals

CONFIRMATIONS = 3
SILENCE_US = 2_000_000
_AHEAD_S = 0.2  # of messages that a change of delay may pile up
_RATE_ERROR = 1.1
_CLAIMS = 4  # kept at once
_REMEMBERED = 64  # numbers of the believed stream whose content is known


class Arrivals(Protocol):
    """What of a bus `Attendance` needs."""

    def alive(self) -> frozenset[str]:
        """Senders that are attached now."""

    def arrivals(self) -> Mapping[str, int]:
        """How often each sender has come, counted from when this one came."""


class Attendance:
    """Since when each sender has been on the bus without a break."""

    def __init__(self, bus: Arrivals) -> None:
        self._bus = bus
        self._counts: dict[str, int] = {}
        self._since_us: dict[str, int] = {}

    def look(self, utc_us: int) -> None:
        """Take in who has come and gone."""
        alive, counts = self._bus.alive(), self._bus.arrivals()
        for sender in alive:
            if counts.get(sender) != self._counts.get(sender) or sender not in self._since_us:
                self._since_us[sender] = utc_us
        for sender in self._since_us.keys() - alive:
            del self._since_us[sender]
        self._counts = dict(counts)

    def since_us(self, sender: str) -> int | None:
        """Own UTC when it came; None while it is not there."""
        return self._since_us.get(sender)


class ReceivedMessage(NamedTuple):
    """Of a message, what tells whether it is its sender's."""

    boot_id: int
    seq: int
    sent_utc_us: int  # by its stamp, or when it came if it has none
    payload: bytes


@dataclass(slots=True)
class _Stream:
    boot_id: int
    seq: int
    sent_utc_us: int
    received_utc_us: int
    began_utc_us: int  # stamp of the first
    count: int = 1

    def continues(self, received: ReceivedMessage, utc_us: int, rate_hz: float) -> bool:
        """Whether a message may be the next, or one after some that were lost."""
        passed_s = max(utc_us - self.received_utc_us, received.sent_utc_us - self.sent_utc_us) * 1e-6
        ahead = (_AHEAD_S + _RATE_ERROR * passed_s) * rate_hz
        return received.boot_id == self.boot_id and 0 < received.seq - self.seq <= ahead

    def take(self, received: ReceivedMessage, utc_us: int) -> None:
        self.seq, self.sent_utc_us, self.received_utc_us = received.seq, received.sent_utc_us, utc_us
        self.count += 1


class SenderVerifier:
    """One topic of one sender; see the module.

    Args:
        sender, topic: names that refusals are counted under.
        rate_hz: how fast its numbers count up at most.
        refusals: is told what is refused.
        attendance: of the bus.
    """

    def __init__(self, sender: str, topic: str, rate_hz: float, refusals: Refusals, attendance: Attendance) -> None:
        self._sender, self._topic, self._rate_hz = sender, topic, rate_hz
        self._refusals, self._attendance = refusals, attendance
        self._believed: _Stream | None = None
        self._claims: list[_Stream] = []
        self._contents: dict[int, int] = {}  # checksums of what was believed, by number

    def accepts(self, received: ReceivedMessage, utc_us: int) -> bool:
        """Judge one message that is good in itself."""
        reason = self._refusal(received, utc_us)
        if not reason:
            self._contents[received.seq] = zlib.crc32(received.payload)
            if len(self._contents) > _REMEMBERED:
                del self._contents[next(iter(self._contents))]
            return True
        self._refusals.add(self._sender, self._topic, reason, utc_us)
        return False

    def _refusal(self, received: ReceivedMessage, utc_us: int) -> str:
        believed = self._believed
        if believed is None:
            self._believed = _new_stream(received, utc_us)
            return ""
        if believed.continues(received, utc_us, self._rate_hz):
            believed.take(received, utc_us)
            self._drop([claim for claim in self._claims if claim.began_utc_us < received.sent_utc_us], utc_us)
            return ""
        same_boot = received.boot_id == believed.boot_id
        if same_boot and received.seq in self._contents:
            return REPLAYED if self._contents[received.seq] == zlib.crc32(received.payload) else SEQUENCE
        repeats = same_boot and received.seq <= believed.seq and received.sent_utc_us <= believed.sent_utc_us
        if repeats or (not same_boot and received.sent_utc_us <= believed.began_utc_us):  # or is of a former life
            return REPLAYED
        claim = self._claim(received, utc_us)
        if not self._is_confirmed(claim, believed, utc_us):
            return UNCONFIRMED
        self._believed, self._claims, self._contents = claim, [], {}
        return ""

    def _claim(self, received: ReceivedMessage, utc_us: int) -> _Stream:
        """The claim that a message goes on with, or a new one in the place of that with the fewest messages."""
        for claim in self._claims:
            if claim.continues(received, utc_us, self._rate_hz):
                claim.take(received, utc_us)
                return claim
        if len(self._claims) == _CLAIMS:
            self._drop([min(self._claims, key=lambda claim: (claim.count, claim.received_utc_us))], utc_us)
        self._claims.append(_new_stream(received, utc_us))
        return self._claims[-1]

    def _is_confirmed(self, claim: _Stream, believed: _Stream, utc_us: int) -> bool:
        since_us = self._attendance.since_us(self._sender)
        if claim.count < CONFIRMATIONS or since_us is None:
            return False
        came_back = min(believed.sent_utc_us, believed.received_utc_us) < since_us
        return came_back or utc_us - believed.received_utc_us >= SILENCE_US

    def _drop(self, claims: list[_Stream], utc_us: int) -> None:
        """Of the believed stream nothing else is left to explain them: they were not its sender's."""
        if not claims:
            return
        assert self._believed is not None
        reasons: Counter[str] = Counter()
        for claim in claims:
            reasons[SEQUENCE if claim.boot_id == self._believed.boot_id else BOOT] += claim.count
            self._claims.remove(claim)
        self._refusals.turn(self._sender, self._topic, reasons, utc_us)


def _new_stream(received: ReceivedMessage, utc_us: int) -> _Stream:
    return _Stream(received.boot_id, received.seq, received.sent_utc_us, utc_us, received.sent_utc_us)
