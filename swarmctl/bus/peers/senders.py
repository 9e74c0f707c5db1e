"""Acceptance of messages by sender, on a bus where every process can publish under every name. Pure: no bus, no clock.

A sender numbers its messages; the numbers restart with its process, under another boot id. So a message of another boot
id may come from a restart, or be a forgery that would lock out the sender whose next messages then look like those of
an earlier process. The rules of `SenderVerifier`:

1. A message is accepted if boot id and number continue the accepted stream, and the number is not farther ahead than
   the sender's rate allows for the time in between, as received or as stamped, whichever is longer.
2. Otherwise it begins, or continues, a *claim*. When the accepted stream continues with a message sent after a claim
   began, the claim is dropped as contradicted: a process that has been replaced sends nothing more.
3. A claim replaces the accepted stream after `CONFIRMATIONS` messages that continue one another, while the sender's
   token is on the bus, and
   a. the token has (re)appeared since the last message of the accepted stream: a restart, accepted with its third
      message;
   b. or the accepted stream has been silent for `SILENCE_US`, longer than a token outlives its process: a restart whose
      token was never seen to leave (the old process was frozen or cut off while the new one started), or an accepted
      stream that was itself a forgery.

Absence proves nothing: neither a missing token nor silence is evidence, only messages are. Token and messages race, and
both orders work: messages that overtake the token are a claim until it appears, and late messages of the earlier
process (sent before the token appeared, by their stamp) do not count as a continued stream. A forger that continues
the newest message exactly as its sender would cannot be detected without signatures. It leaves traces, because one
number then has two contents.

Messages of another boot id that are stamped before the accepted stream began are refused as replayed, whatever else
speaks for them: a recording of an earlier process is just that. So is what a restarted process says by a clock that was
set back, until that clock has passed the begin of the process before. They are never accepted for it, but
`SenderVerifier.gone_back_us` tells of them where nothing else is heard of a sender that is on the bus.
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
_BURST_S = 0.2  # a change of delay may bunch messages of this time
_RATE_ERROR = 1.1  # tolerated factor on the rate
_MAX_CLAIMS = 4  # kept at the same time
_MAX_CONTENTS = 64  # numbers of the accepted stream whose content is remembered


class Arrivals(Protocol):
    """The part of a bus that `Presence` needs."""

    def alive(self) -> frozenset[str]:
        """Return senders that are attached now."""

    def arrivals(self) -> Mapping[str, int]:
        """Return how often each sender has joined, counted since this one joined."""


class Presence:
    """Tracks since when each sender has been on the bus without a break."""

    def __init__(self, bus: Arrivals) -> None:
        self._bus = bus
        self._alive: frozenset[str] = frozenset()
        self._counts: dict[str, int] = {}
        self._since_us: dict[str, int] = {}

    def update(self, utc_us: int) -> None:
        """Take in which senders have joined and left."""
        alive, counts = self._bus.alive(), self._bus.arrivals()
        if alive == self._alive and counts == self._counts:
            return
        for sender in alive:
            if counts.get(sender) != self._counts.get(sender) or sender not in self._since_us:
                self._since_us[sender] = utc_us
        for sender in self._since_us.keys() - alive:
            del self._since_us[sender]
        self._alive, self._counts = alive, dict(counts)

    def since_us(self, sender: str) -> int | None:
        """Return the own UTC at which a sender joined; None while it is absent."""
        return self._since_us.get(sender)


class ReceivedMessage(NamedTuple):
    """Holds the properties of a message by which its sender is verified."""

    boot_id: int
    seq: int
    sent_utc_us: int  # by its stamp
    payload: bytes


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The newest message of a sequence of messages that continue one another."""

    boot_id: int
    seq: int
    sent_utc_us: int
    received_utc_us: int
    began_utc_us: int  # stamp of the first message
    count: int = 1

    def continues(self, received: ReceivedMessage, utc_us: int, rate_hz: float) -> bool:
        """Tell whether a message may be the next one, or a later one after losses."""
        passed_s = max(utc_us - self.received_utc_us, received.sent_utc_us - self.sent_utc_us) * 1e-6
        ahead = (_BURST_S + _RATE_ERROR * passed_s) * rate_hz
        return received.boot_id == self.boot_id and 0 < received.seq - self.seq <= ahead

    def take(self, received: ReceivedMessage, utc_us: int) -> None:
        """Make a message the newest one."""
        self.seq, self.sent_utc_us, self.received_utc_us = received.seq, received.sent_utc_us, utc_us
        self.count += 1


class SenderVerifier:
    """Accepts or refuses the messages of one topic of one sender.

    Args:
        sender, topic: names under which refusals are counted.
        rate_hz: largest rate of its numbers.
        refusals: counts refused messages.
        presence: presence of senders on the bus.
    """

    def __init__(self, sender: str, topic: str, rate_hz: float, refusals: Refusals, *, presence: Presence) -> None:
        self._sender, self._topic, self._rate_hz = sender, topic, rate_hz
        self._refusals, self._presence = refusals, presence
        self._accepted: _Stream | None = None
        self._claims: list[_Stream] = []
        self._past: _Stream | None = None  # refused messages of another process, stamped before the accepted one's
        self._contents: dict[int, int] = {}  # checksums of accepted messages, by number

    def accepts(self, received: ReceivedMessage, utc_us: int) -> bool:
        """Accept or refuse one well-formed message received at `utc_us`."""
        reason = self._refusal(received, utc_us)
        if not reason:
            self._contents[received.seq] = zlib.crc32(received.payload)
            if len(self._contents) > _MAX_CONTENTS:
                del self._contents[next(iter(self._contents))]
            return True
        self._refusals.add(self._sender, self._topic, reason, utc_us)
        return False

    def is_past(self, received: ReceivedMessage) -> bool:
        """Tell whether a message is an old one of the accepted stream, by a slower way; one that was changed is not."""
        accepted = self._accepted
        if accepted is None or received.boot_id != accepted.boot_id or received.seq > accepted.seq:
            return False
        checksum = zlib.crc32(received.payload)
        return self._contents.get(received.seq, checksum) == checksum

    def gone_back_us(self, utc_us: int) -> int:
        """Return by how much the sender's clock was set back between two processes, as it seems; 0: nothing says so.

        It seems so while messages of another process, which continue one another, are all that is heard of a sender
        that is on the bus, and are refused because they are stamped before the accepted ones began.
        """
        past, accepted = self._past, self._accepted
        if past is None or accepted is None or past.count < CONFIRMATIONS:
            return 0
        if utc_us - accepted.received_utc_us < SILENCE_US or self._presence.since_us(self._sender) is None:
            return 0
        delays_us = [stream.received_utc_us - stream.sent_utc_us for stream in (past, accepted)]
        return max(0, delays_us[0] - delays_us[1])

    def _refusal(self, received: ReceivedMessage, utc_us: int) -> str:
        accepted = self._accepted
        if accepted is None:
            self._accepted = _new_stream(received, utc_us)
            return ""
        if accepted.continues(received, utc_us, self._rate_hz):
            accepted.take(received, utc_us)
            if self._claims:
                self._drop([claim for claim in self._claims if claim.began_utc_us < received.sent_utc_us], utc_us)
            return ""
        same_boot = received.boot_id == accepted.boot_id
        if same_boot and received.seq in self._contents:
            return REPLAYED if self._contents[received.seq] == zlib.crc32(received.payload) else SEQUENCE
        if same_boot and received.seq <= accepted.seq and received.sent_utc_us <= accepted.sent_utc_us:
            return REPLAYED
        if not same_boot and received.sent_utc_us <= accepted.began_utc_us:  # of an earlier process, by its stamp
            self._follow_past(received, utc_us)
            return REPLAYED
        claim = self._claim(received, utc_us)
        if not self._is_confirmed(claim, accepted, utc_us):
            return UNCONFIRMED
        self._accepted, self._claims, self._past, self._contents = claim, [], None, {}
        return ""

    def _follow_past(self, received: ReceivedMessage, utc_us: int) -> None:
        """Note a message that is refused for its stamp; copies of it, and others out of order, change nothing."""
        past = self._past
        if past is None or past.boot_id != received.boot_id:
            self._past = _new_stream(received, utc_us)
        elif past.continues(received, utc_us, self._rate_hz):
            past.take(received, utc_us)

    def _claim(self, received: ReceivedMessage, utc_us: int) -> _Stream:
        """Return the claim that a message continues, or a new one in place of the one with the fewest messages."""
        for claim in self._claims:
            if claim.continues(received, utc_us, self._rate_hz):
                claim.take(received, utc_us)
                return claim
        if len(self._claims) == _MAX_CLAIMS:
            self._drop([min(self._claims, key=lambda claim: (claim.count, claim.received_utc_us))], utc_us)
        self._claims.append(_new_stream(received, utc_us))
        return self._claims[-1]

    def _is_confirmed(self, claim: _Stream, accepted: _Stream, utc_us: int) -> bool:
        since_us = self._presence.since_us(self._sender)
        if claim.count < CONFIRMATIONS or since_us is None:
            return False
        came_back = min(accepted.sent_utc_us, accepted.received_utc_us) < since_us
        return came_back or utc_us - accepted.received_utc_us >= SILENCE_US

    def _drop(self, claims: list[_Stream], utc_us: int) -> None:
        """Drop contradicted claims, and count their messages as forged."""
        if not claims:
            return
        assert self._accepted is not None
        reasons: Counter[str] = Counter()
        for claim in claims:
            reasons[SEQUENCE if claim.boot_id == self._accepted.boot_id else BOOT] += claim.count
            self._claims.remove(claim)
        self._refusals.reclassify(self._sender, self._topic, reasons, utc_us)


def _new_stream(received: ReceivedMessage, utc_us: int) -> _Stream:
    return _Stream(
        boot_id=received.boot_id,
        seq=received.seq,
        sent_utc_us=received.sent_utc_us,
        received_utc_us=utc_us,
        began_utc_us=received.sent_utc_us,
    )
