"""Carries topics that may be lost between the routers of several computers, beside Zenoh's own links.

A router's link is one ordered stream: where the network loses frames, everything waits for the lost ones to be sent
again, and a congested stream keeps seconds of paths that nobody needs any more. So links carry what has to arrive, and
each message of the other topics is a datagram (`swarmctl.bus.network.datagrams`) that arrives at once or never.

The socket is at the port after that of the router's own address; the station, which has none, sends from any.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import secrets
import socket
import sys
import threading
import time
from collections.abc import Set
from typing import Any

import zenoh

from swarmctl.bus.network.datagram_routes import BEAT_S, Address, DatagramRoutes, Outgoing
from swarmctl.bus.network.roster import OwnIdentity, split_address
from swarmctl.bus.network.seals import PairKeys
from swarmctl.bus.topics import TOPICS
from swarmctl.bus.zenoh.client import CLOSE_DEADLINE_S, close_within
from swarmctl.bus.zenoh.marked_keys import MarkedPublisher, is_misdelivered
from swarmctl.errors import StartError

_PREFIX = "swarm/"
_WAKE_S = 0.02
_BUFFER_BYTES = 1 << 20
_TOLD_EVERY_S = 10.0
_MOST_PUBLISHERS = 1024
_MOST_WAITING = 256  # messages of one topic that wait to be sent; the oldest gives way
_CLOSE_S = 1.0
_LOOKED_EVERY_S = 1.0
_MISSED_S = 5.0  # with datagrams and without a link; one that was cut is back in 3 s


def datagram_address(address: str) -> Address:
    """Return where the datagrams to a router go that is at `IP:PORT`: to the next port."""
    ip, port = split_address(address)
    return str(ip), port + 1


class MissedLinks:
    """Tells which computers are heard by datagrams while no link with them comes up."""

    def __init__(self) -> None:
        self._since_s: dict[str, float] = {}
        self._told: set[str] = set()

    def update(self, heard: Set[str], linked: Set[str], now_s: float) -> tuple[str, ...]:
        """Return whom to tell of now, each once until there is a link."""
        missed = heard - linked
        self._since_s = {name: self._since_s.get(name, now_s) for name in missed}
        self._told -= linked
        due = {name for name, since_s in self._since_s.items() if now_s - since_s >= _MISSED_S} - self._told
        self._told |= due
        return tuple(sorted(due))


class DatagramLinks:
    """Sends the messages of a router's clients to other routers, and theirs to the clients.

    Args:
        session: of the router.
        identity: own one, with everybody's addresses.
        keys: shared with each identity of the roster, in its order.
        sock: see `bind_datagrams`; is closed at the end.
    """

    def __init__(self, session: Any, identity: OwnIdentity, keys: PairKeys, sock: socket.socket) -> None:
        addresses = _addresses(identity)
        self._session, self._socket = session, sock
        self._routes = DatagramRoutes(identity.roster, identity.name, keys, addresses, session=_session_number())
        self._may_be_anywhere = identity.name not in addresses
        self._lock = threading.Lock()  # several threads send, one receives
        self._publishers: dict[str, MarkedPublisher] = {}
        self._ends = threading.Event()
        self._told_s, self._told = time.monotonic(), 0
        subscribers = [
            session.declare_subscriber(
                f"{_PREFIX}*/*/{topic.name}",
                zenoh.handlers.RingChannel(_MOST_WAITING),
                allowed_origin=zenoh.Locality.REMOTE,
            )
            for topic in TOPICS
            if not topic.reliable
        ]
        self._receiver = threading.Thread(target=self._run, name="datagrams", daemon=True)
        self._senders = [
            threading.Thread(target=self._send_from, args=(subscriber,), name="datagrams sent", daemon=True)
            for subscriber in subscribers
        ]
        looker = threading.Thread(target=self._tell_missed, name="links", daemon=True)
        for thread in (self._receiver, *self._senders, looker):
            thread.start()

    def close(self) -> None:
        """Publish nothing more, close the session, and send nothing more.

        Senders wait for what clients publish until then: a subscriber can't be undeclared while a thread waits for it.
        """
        self._ends.set()
        self._receiver.join(_CLOSE_S)
        close_within(self._session, CLOSE_DEADLINE_S)
        for sender in self._senders:
            sender.join(_CLOSE_S)
        self._socket.close()

    def _send_from(self, subscriber: Any) -> None:
        """Send what clients publish on one topic; the newest, where they publish faster than that."""
        while not self._ends.is_set():
            try:
                sample = subscriber.recv()
            except zenoh.ZError:
                return  # the session is closed
            self._send(sample)

    def _send(self, sample: Any) -> None:
        key = str(sample.key_expr)
        if is_misdelivered(sample, key):
            return
        with self._lock:
            outgoing = self._routes.send(key.removeprefix(_PREFIX), sample.payload.to_bytes(), time.monotonic())
        self._send_all(outgoing)

    def _send_all(self, outgoing: Outgoing) -> None:
        for datagram, address in outgoing:
            with contextlib.suppress(OSError):  # no route, or the buffer is full: it is lost, as others are
                self._socket.sendto(datagram, address)

    def _run(self) -> None:
        beat_s = time.monotonic()
        while not self._ends.is_set():
            now_s = time.monotonic()
            if now_s >= beat_s:
                beat_s = now_s + BEAT_S
                with self._lock:
                    if self._may_be_anywhere and self._routes.is_cut_off(now_s):
                        self._routes.begin_anew(_session_number(), now_s)
                    outgoing = self._routes.beat(now_s)
                self._send_all(outgoing)
                self._tell_refused(now_s)
            self._receive()

    def _receive(self) -> None:
        """Deliver what comes next; wait for it for a moment."""
        try:
            datagram, source = self._socket.recvfrom(_BUFFER_BYTES)
        except OSError:  # nothing has come, or a former datagram did not arrive
            return
        with self._lock:
            taken = self._routes.take(datagram, (source[0], source[1]), time.monotonic())
        self._send_all(taken.outgoing)
        for key, payload in taken.messages:
            self._publish(_PREFIX + key, payload)

    def _publish(self, key: str, payload: bytes) -> None:
        publisher = self._publishers.get(key)
        with contextlib.suppress(zenoh.ZError):
            if publisher is None:
                if len(self._publishers) >= _MOST_PUBLISHERS:
                    self._publishers.pop(next(iter(self._publishers))).undeclare()
                publisher = self._publishers[key] = MarkedPublisher(self._session, key, reliable=False)
            publisher.put(payload)

    def _tell_missed(self) -> None:
        """Look at the links, in a thread of its own: where Zenoh takes its time for that, no datagram waits."""
        missed = MissedLinks()
        while not self._ends.wait(_LOOKED_EVERY_S):
            try:
                certified = [str(link.auth_identifier) for link in self._session.info.links()]
            except zenoh.ZError:
                return  # the session is closed
            now_s = time.monotonic()
            with self._lock:
                heard = self._routes.heard(now_s)
            for name in missed.update(heard, {name.rpartition(".")[0] for name in certified}, now_s):
                print(
                    f"{name}: its datagrams come, and for {_MISSED_S:g} s no link, so no orders, events and lists of "
                    "obstacles. Let UDP at the port of the host's address pass, and compare the identities of both",
                    file=sys.stderr,
                    flush=True,
                )

    def _tell_refused(self, now_s: float) -> None:
        refused = self._routes.refused.total()
        if refused > self._told and now_s - self._told_s > _TOLD_EVERY_S:
            self._told, self._told_s = refused, now_s
            counts = ", ".join(f"{count} {reason}" for reason, count in self._routes.refused.most_common())
            print(f"datagrams refused so far: {counts}", file=sys.stderr, flush=True)


def _session_number() -> int:
    return secrets.randbits(64) or 1


def bind_datagrams(identity: OwnIdentity) -> socket.socket:
    """Return a socket at the address of an identity; at any port where it has none.

    Raises:
        StartError: the port is taken, or the address is not of this computer.
    """
    addresses = _addresses(identity)
    own, known = addresses.get(identity.name), next(iter(addresses.values()))
    version = ipaddress.ip_address((own or known)[0]).version
    sock = socket.socket(socket.AF_INET6 if version == 6 else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        sock.bind(own or ("::" if version == 6 else "0.0.0.0", 0))
    except OSError as error:
        sock.close()
        where = " port ".join(map(str, own or ()))
        if error.errno == errno.EADDRNOTAVAIL:
            fix = f"This computer has no such address; correct that of {identity.name} in [[hosts]], on every computer"
        else:
            fix = (
                "It is the port after that of the host's address in [[hosts]]; use another address, or end what uses it"
            )
        raise StartError(f"datagrams at {where}: {error.strerror}. {fix}") from error
    sock.settimeout(_WAKE_S)
    return sock


def _addresses(identity: OwnIdentity) -> dict[str, Address]:
    return {one.name: datagram_address(one.address) for one in identity.roster.speakers if one.address}
