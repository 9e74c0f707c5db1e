"""Who speaks on the bus of a swarm of several computers, under which names, and what each may say. Pure.

A computer speaks under the name of its identity, and each of its agents under the agent's. Orders and obstacles are
taken from identities with an operator's rights; every computer commands its own agents, and may say of these alone that
they have ended.
"""

from __future__ import annotations

import ipaddress
import json
from dataclasses import asdict, dataclass

MOST_HOSTS = 63  # datagrams tell in 64 bits who is heard, the station included


@dataclass(frozen=True, slots=True, kw_only=True)
class Speaker:
    """Describes one identity.

    Attributes:
        name: also the sender name of its supervisor and of verbs.
        agents: numbers of those that run there.
        senders: every name under which it speaks, its own first.
        operator: agents of other computers obey it.
        address: `IP:PORT` of its router; "" for the station, which may be anywhere.
    """

    name: str
    agents: tuple[int, ...]
    senders: tuple[str, ...]
    operator: bool
    address: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Roster:
    """Lists the identities of a swarm, in the same order on every computer.

    Attributes:
        speakers: those that there are.
        relay: routers pass on what others say; seals alone tell who has said it.
    """

    speakers: tuple[Speaker, ...]
    relay: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all identities."""
        return tuple(speaker.name for speaker in self.speakers)

    @property
    def hosts(self) -> tuple[str, ...]:
        """Return the names of the identities that have agents."""
        return tuple(speaker.name for speaker in self.speakers if speaker.agents)

    def speaker(self, name: str) -> Speaker:
        """Return the identity of this name; there is one."""
        return next(speaker for speaker in self.speakers if speaker.name == name)

    def commanders(self, name: str) -> tuple[str, ...]:
        """Return the names whose orders the agents of an identity obey."""
        return tuple(speaker.name for speaker in self.speakers if speaker.operator or speaker.name == name)


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnIdentity:
    """Holds what a process needs to speak as one identity, and to know the others; it names files, and holds no key.

    Attributes:
        folder: of certificates and the own key.
        name: the own one.
        roster: everybody.
    """

    folder: str
    name: str
    roster: Roster

    @property
    def speaker(self) -> Speaker:
        """Return the own entry of the roster."""
        return self.roster.speaker(self.name)

    def as_json(self) -> str:
        """Return it as text for a command line."""
        return json.dumps(asdict(self))


def identity_of_json(text: str) -> OwnIdentity:
    """Return the identity that `OwnIdentity.as_json` has written."""
    tree = json.loads(text)
    speakers = tuple(
        Speaker(
            name=item["name"],
            agents=tuple(item["agents"]),
            senders=tuple(item["senders"]),
            operator=item["operator"],
            address=item["address"],
        )
        for item in tree["roster"]["speakers"]
    )
    roster = Roster(speakers=speakers, relay=tree["roster"]["relay"])
    return OwnIdentity(folder=tree["folder"], name=tree["name"], roster=roster)


def split_address(address: str) -> tuple[ipaddress.IPv4Address | ipaddress.IPv6Address, int]:
    """Return IP and port of `IP:PORT`; IPv6 is in brackets, and the port has a next one, for datagrams.

    Raises:
        ValueError: it is not of this form, or no computer is at this address.
    """
    written, _, port = address.rpartition(":")
    if not port.isascii() or not port.isdigit() or not 0 < int(port) < 65535:
        raise ValueError(f"{port!r} is no port from 1 to 65534")
    is_bracketed = written.startswith("[") and written.endswith("]")
    ip = ipaddress.ip_address(written[1:-1] if is_bracketed else written)
    if is_bracketed is not (ip.version == 6):
        raise ValueError("an IPv6 address is in brackets, an IPv4 address is not")
    if ip.is_unspecified or ip.is_multicast or getattr(ip, "scope_id", None):
        raise ValueError(f"{ip} is not the address of one computer, the same for all others")
    return ip, int(port)
