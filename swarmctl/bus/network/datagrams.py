"""Datagrams between two computers, encrypted and authenticated by the key that these two alone share. Pure.

Every process that sends has a random session number, and numbers its datagrams. The cipher (ChaCha20-Poly1305, RFC
8439) has a key of its own for each session and direction, and the number as nonce, so none is used twice. What is
delivered has to name the session of the receiving process as well: it was sent to this one, not to one before it.
Both learn the other's session from datagrams that do not do so yet, which are good for nothing else:

1. A, which has just started, sends one that names no session of B. B learns A's, and delivers nothing.
2. B answers with one that names A's. A believes it, and knows B's now.
3. From then on A's name B's. B delivers them, and what A's session before has sent no more.

A recording of step 1 makes B answer to a session that is no more; the answer is refused, and nothing changes.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from dataclasses import dataclass
from hashlib import blake2b

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from swarmctl.bus.network.seals import KEY_BYTES
from swarmctl.bus.refusals import FORGED, MALFORMED, REPLAYED

DATAGRAM_VERSION = 1
MOST_DATAGRAM_BYTES = 65_507  # of UDP over IPv4; what exceeds the link's packets is fragmented by IP
OCCUPIED = "occupied"  # refused: by another computer of the same identity, which is there
_MAGIC = b"SD"
_HEADER = struct.Struct("<2sBBBBQQQ")  # magic, version, from, to, whether relayed, session, receiver's session, number
_TAG_BYTES = 16
OVERHEAD_BYTES = _HEADER.size + _TAG_BYTES
_NONCE = struct.Struct("<4xQ")
_PERSON = b"swarmctl dgrams"
_MOST_ENDED = 256  # sessions of one computer's former processes that are remembered
_WINDOW_NUMBERS = 1024  # datagrams are late by fewer than so many others


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """Names who has sent a datagram to whom, by their places in the roster, as it says itself; nothing is proven."""

    sender: int
    receiver: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Opened:
    """Holds what came of a datagram.

    Attributes:
        body: what was sent; empty unless it is to be believed.
        refused: why it is not, "" where it is, or was good for learning a session.
        relayed: it came by a third computer.
        wants_answer: its sender does not know the session of this process.
    """

    body: bytes = b""
    refused: str = ""
    relayed: bool = False
    wants_answer: bool = False


def route_of(datagram: bytes) -> Route | None:
    """Return the ends that a datagram names; None where it is none of this version."""
    if not OVERHEAD_BYTES <= len(datagram) <= MOST_DATAGRAM_BYTES or not datagram.startswith(_MAGIC):
        return None
    _, version, sender, receiver, *_ = _HEADER.unpack_from(datagram)
    return Route(sender=sender, receiver=receiver) if version == DATAGRAM_VERSION else None


class DatagramChannel:
    """Seals datagrams to one other computer, and opens those from it.

    Args:
        key: shared with that computer alone.
        me, other: places of both in the roster.
        session: random number of this process, not 0.
    """

    def __init__(self, key: bytes, *, me: int, other: int, session: int) -> None:
        self._key, self._me, self._other, self._session = key, me, other, session
        self._sending = self._cipher(session, sender=me)
        self._number = 0
        self._known, self._receiving = 0, self._sending  # the other's session that is believed, and its cipher
        self._learnt = 0  # the other's session of which the newest datagram was that does not name this one
        self._ended = OrderedDict[int, None]()
        self._newest, self._window = 0, 0  # greatest number of that session, and a bit for each of those before it

    @property
    def is_open(self) -> bool:
        """Return whether the other one's session is known, so that it believes what it is sent."""
        return bool(self._known)

    def seal(self, body: bytes, *, relayed: bool = False, answer: bool = False) -> bytes:
        """Return the datagram of a body; an `answer` names the session that was learnt last."""
        self._number += 1
        theirs = self._learnt if (answer or not self._known) else self._known
        header = _HEADER.pack(
            _MAGIC, DATAGRAM_VERSION, self._me, self._other, relayed, self._session, theirs, self._number
        )
        return header + self._sending.encrypt(_NONCE.pack(self._number), body, header)

    def open(self, datagram: bytes, *, may_begin: bool = True) -> Opened:
        """Open a datagram whose route is from the other computer to this one.

        Another session of it is believed, and ends the one before, with `may_begin` alone.
        """
        *_, relayed, session, named, number = _HEADER.unpack_from(datagram)
        if session in self._ended:
            return Opened(refused=REPLAYED)
        is_known = session == self._known
        cipher = self._receiving if is_known else self._cipher(session, sender=self._other)
        header = datagram[: _HEADER.size]
        try:
            body = cipher.decrypt(_NONCE.pack(number), datagram[_HEADER.size :], header)
        except InvalidTag:
            return Opened(refused=FORGED)
        if named != self._session:
            self._learnt = session
            return Opened(wants_answer=True, relayed=bool(relayed))
        if not is_known:
            if self._known and not may_begin:
                return Opened(refused=OCCUPIED)
            self._begin(session, cipher)
        if not self._is_new(number):
            return Opened(refused=REPLAYED)
        return Opened(body=body, relayed=bool(relayed)) if body else Opened(refused=MALFORMED)

    def _begin(self, session: int, cipher: ChaCha20Poly1305) -> None:
        """Believe another session of the other computer; the one before has ended."""
        if self._known:
            self._ended[self._known] = None
            if len(self._ended) > _MOST_ENDED:
                self._ended.popitem(last=False)
        self._known, self._receiving = session, cipher
        self._newest = self._window = 0

    def _is_new(self, number: int) -> bool:
        """Return whether a number of the session that is believed comes for the first time, and note it."""
        ahead = number - self._newest
        if ahead > 0:
            self._window = (self._window << ahead | 1) & ((1 << _WINDOW_NUMBERS) - 1) if ahead < _WINDOW_NUMBERS else 1
            self._newest = number
            return True
        bit = 1 << -ahead
        if -ahead >= _WINDOW_NUMBERS or self._window & bit:
            return False
        self._window |= bit
        return True

    def _cipher(self, session: int, *, sender: int) -> ChaCha20Poly1305:
        salted = session.to_bytes(8, "little") + bytes((sender,))
        return ChaCha20Poly1305(blake2b(salted, key=self._key, digest_size=KEY_BYTES, person=_PERSON).digest())
