"""Which datagrams carry the messages of one computer to the others, and what is delivered of theirs. Pure.

Every computer tells every other one, ten times a second, whom it hears. Who does not hear this one directly is also
sent what it says by a third computer that is heard by this one and hears both, where the roster allows relays; the
third one can't read it.

The station may be anywhere, so there may be two by mistake. The first one keeps its place while it is heard.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from swarmctl.bus.network.datagrams import (
    MOST_DATAGRAM_BYTES,
    OVERHEAD_BYTES,
    DatagramChannel,
    Route,
    route_of,
)
from swarmctl.bus.network.roster import Roster
from swarmctl.bus.network.seals import PairKeys, overhead_bytes
from swarmctl.bus.refusals import FORGED, MALFORMED
from swarmctl.bus.topics import TICK, TOPICS

BEAT_S = 0.1
HEARD_S = 0.5  # a computer of which nothing has come for so long is not heard
GONE_S = 5.0  # the station, silent for so long, is told nothing until it is heard again
HELD_S = 2.0  # silent for so long, it gives way to another one
TOO_LONG_TO_SEND = "too_long_to_send"  # by a client of this computer
_BODY = struct.Struct("<BQ")  # kind, mask of who is heard directly: a bit for each of MOST_HOSTS and the station
_BEAT, _MESSAGE, _FOR_ANOTHER = 0, 1, 2
_RUN = re.compile(r"[A-Za-z0-9_.-]{1,100}")
_BY_NAME = {topic.name: topic for topic in TOPICS if not topic.reliable}
_FOR_STATIONS_ONLY = frozenset((TICK.name,))
# A message is passed on in the body of another datagram
_MOST_BODY_BYTES = MOST_DATAGRAM_BYTES - 2 * OVERHEAD_BYTES - _BODY.size

Address = tuple[str, int]
Outgoing = list[tuple[bytes, Address]]


@dataclass(slots=True, kw_only=True)
class _Link:
    """What is known of one other computer."""

    channel: DatagramChannel
    address: Address | None  # None: it has not been heard yet, and nobody knows where it is
    is_fixed: bool  # the address is the configured one
    listens_to_ticks: bool
    senders: frozenset[str]
    heard_s: float = float("-inf")  # directly
    told_s: float = float("-inf")  # last time of which its mask is, also by a third one
    mask: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """Holds what came of a datagram: messages by key without prefix, and datagrams to send because of it."""

    messages: tuple[tuple[str, bytes], ...] = ()
    outgoing: Outgoing = field(default_factory=Outgoing)


class DatagramRoutes:
    """Carries messages of the topics that may be lost, between one computer and all others.

    Args:
        roster: everybody.
        me: name of the own identity.
        keys: shared with each identity of the roster; who has none is told nothing.
        addresses: of the computers that are at configured ones; the others are answered where they send from.
        session: random number of this process, not 0.

    Attributes:
        refused: datagrams by reason.
    """

    def __init__(
        self, roster: Roster, me: str, keys: PairKeys, addresses: Mapping[str, Address], *, session: int
    ) -> None:
        self._keys, self._began_s = keys, float("-inf")
        self._names = roster.names
        self._me = self._names.index(me)
        self._relay = roster.relay
        self._own = frozenset(roster.speaker(me).senders)
        self._sealed_bytes = overhead_bytes(roster)
        self._links = {
            place: _Link(
                channel=DatagramChannel(key, me=self._me, other=place, session=session),
                address=addresses.get(speaker.name),
                is_fixed=speaker.name in addresses,
                listens_to_ticks=not speaker.agents,
                senders=frozenset(speaker.senders),
            )
            for place, (speaker, key) in enumerate(zip(roster.speakers, keys, strict=True))
            if place != self._me and key is not None
        }
        self.refused: Counter[str] = Counter()

    def is_cut_off(self, now_s: float) -> bool:
        """Return whether those that were heard are heard no more, as once another one has taken this one's place."""
        heard_s = max((link.heard_s for link in self._links.values()), default=float("-inf"))
        return heard_s > float("-inf") and now_s - max(heard_s, self._began_s) >= GONE_S

    def begin_anew(self, session: int, now_s: float) -> None:
        """Go on as a new process would: who has ended this one's session takes nothing of it any more."""
        self._began_s = now_s
        for place, link in self._links.items():
            key = self._keys[place]
            assert key is not None  # or there would be no link
            link.channel = DatagramChannel(key, me=self._me, other=place, session=session)

    def heard(self, now_s: float) -> frozenset[str]:
        """Return the names of the computers that are heard directly."""
        return frozenset(self._names[p] for p, link in self._links.items() if now_s - link.heard_s < HEARD_S)

    def send(self, key: str, payload: bytes, now_s: float) -> Outgoing:
        """Return the datagrams by which an own message reaches the others; none for one that is not carried.

        Args:
            key: `RUN/SENDER/TOPIC`.
            payload: what is sent.
            now_s: monotonic time [s].
        """
        run, sender, topic = key.split("/")
        if sender not in self._own or topic not in _BY_NAME or not _RUN.fullmatch(run):
            return []
        name = key.encode()
        body = _BODY.pack(_MESSAGE, self._mask(now_s)) + bytes((len(name),)) + name + payload
        if len(body) > _MOST_BODY_BYTES:
            self.refused[TOO_LONG_TO_SEND] += 1
            return []
        found = Outgoing()
        for place, link in self._links.items():
            if topic in _FOR_STATIONS_ONLY and not link.listens_to_ticks:
                continue
            if link.channel.is_open and (link.is_fixed or now_s - link.told_s < GONE_S):
                found += self._to(place, link.address, body, now_s)
        return found

    def beat(self, now_s: float) -> Outgoing:
        """Return the datagrams that tell the others whom this computer hears; due every `BEAT_S`."""
        body = _BODY.pack(_BEAT, self._mask(now_s))
        found = Outgoing()
        for place, link in self._links.items():
            found += self._to(place, link.address, body, now_s)
        return found

    def take(self, datagram: bytes, source: Address, now_s: float) -> Taken:
        """Return what a datagram brings, whoever has sent it."""
        route = route_of(datagram)
        link = None if route is None or route.receiver != self._me else self._links.get(route.sender)
        if route is None or link is None:
            return self._refuse(MALFORMED if route is None else FORGED)
        is_free = link.is_fixed or now_s - link.told_s >= HELD_S
        opened = link.channel.open(datagram, may_begin=is_free)
        if opened.refused:
            return self._refuse(opened.refused)
        if opened.wants_answer:
            at = link.address if link.is_fixed or opened.relayed else source
            beat = _BODY.pack(_BEAT, self._mask(now_s))
            return Taken(outgoing=self._to(route.sender, at, beat, now_s, answer=True))
        if not (opened.relayed or link.is_fixed):
            link.address = source
        return self._believe(route, link, opened.body, opened.relayed, now_s)

    def _believe(self, route: Route, link: _Link, body: bytes, relayed: bool, now_s: float) -> Taken:
        if len(body) < _BODY.size:
            return self._refuse(MALFORMED)
        kind, link.mask = _BODY.unpack_from(body)
        link.told_s = now_s
        if not relayed:
            link.heard_s = now_s
        if kind == _MESSAGE:
            return self._message(link, body[_BODY.size :])
        if kind == _FOR_ANOTHER:
            return self._pass_on(route, body[_BODY.size :])
        return Taken()

    def _message(self, link: _Link, body: bytes) -> Taken:
        key_end = 1 + body[0] if body else 0
        key, payload = body[1:key_end].decode("ascii", "replace"), body[key_end:]
        run, sender, name = key.split("/") if key.count("/") == 2 else ("", "", "")
        topic = _BY_NAME.get(name)
        if topic is None or not _RUN.fullmatch(run) or len(body) < key_end:
            return self._refuse(MALFORMED)
        if sender not in link.senders:
            return self._refuse(FORGED)
        # Receivers are told of longer ones as of too long ones, by one byte
        return Taken(messages=((key, payload[: topic.max_bytes + self._sealed_bytes + 1]),))

    def _pass_on(self, route: Route, inner: bytes) -> Taken:
        """Return the datagram that another computer wants to reach a third one."""
        beyond = route_of(inner)
        to = None if beyond is None or beyond.sender != route.sender else self._links.get(beyond.receiver)
        if not self._relay or to is None:
            return self._refuse(FORGED)
        return Taken(outgoing=[] if to.address is None else [(inner, to.address)])

    def _to(self, place: int, address: Address | None, body: bytes, now_s: float, *, answer: bool = False) -> Outgoing:
        """Return the datagrams that bring a body to another computer: to `address`, and by a third one if need be."""
        link, found = self._links[place], Outgoing()
        if address is not None:
            found.append((link.channel.seal(body, answer=answer), address))
        hears_me = bool(link.mask >> self._me & 1) and now_s - link.told_s < HEARD_S
        third = None if hears_me else self._third(place, now_s)
        if third is not None and third.address is not None:
            inner = link.channel.seal(body, relayed=True, answer=answer)
            found.append((third.channel.seal(_BODY.pack(_FOR_ANOTHER, self._mask(now_s)) + inner), third.address))
        return found

    def _third(self, place: int, now_s: float) -> _Link | None:
        """Return a computer that is heard and hears both this one and that at `place`; None where there is none."""
        both = 1 << self._me | 1 << place
        for other, link in self._links.items():
            if self._relay and other != place and now_s - link.heard_s < HEARD_S and link.mask & both == both:
                return link
        return None

    def _mask(self, now_s: float) -> int:
        return sum(1 << place for place, link in self._links.items() if now_s - link.heard_s < HEARD_S)

    def _refuse(self, reason: str) -> Taken:
        self.refused[reason] += 1
        return Taken()
