"""The computers of a swarm that flies from several: `[[hosts]]` of the configuration, and how their routers link up."""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Annotated

from pydantic import Field

from swarmctl.bus.bus import agent_name
from swarmctl.bus.network.identity_files import AUTHORITY, STATION
from swarmctl.bus.network.roster import MOST_HOSTS, OwnIdentity, Roster, Speaker, split_address
from swarmctl.bus.network.router_links import RouterLinks
from swarmctl.bus.topics import OPERATOR
from swarmctl.core.params import Params

_RESERVED = (AUTHORITY, STATION, "revoked", OPERATOR)


class HostParams(Params):
    """One computer of a swarm that flies from several, and its agents."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")  # of its identity, and in messages
    address: str  # IP:PORT at which the routers of other computers reach its router, over UDP; PORT + 1 for datagrams
    agents: Annotated[tuple[int, ...], Field(strict=False, min_length=1)]  # numbers of those that run there
    operator: bool = False  # agents of other hosts obey what is ordered there; its own ones and the station's always do


def host_problems(hosts: Sequence[HostParams], agents: int) -> Iterator[str]:
    """Yield why these hosts are not those of a swarm of so many agents; none for no hosts."""
    for i, host in enumerate(hosts):
        if host.name in _RESERVED or host.name.startswith("agent-"):
            yield f"hosts.{i}.name = {host.name!r}: reserved; choose another"
        if problem := _address_problem(host.address):
            yield f"hosts.{i}.address = {host.address!r}: {problem}; write IP:PORT, for example 192.168.1.20:7448"
    if len(hosts) > MOST_HOSTS:
        yield f"hosts: {len(hosts)} are listed; largest allowed: {MOST_HOSTS}; let several agents share a computer"
    yield from _clashes(hosts)
    names = Counter(host.name for host in hosts)
    yield from (f"hosts: name {name!r} is given {n} times" for name, n in names.items() if n > 1)
    counts = Counter(agent for host in hosts for agent in host.agents)
    if hosts and (missing := [agent for agent in range(agents) if not counts[agent]]):
        yield f"hosts: agents {missing} run nowhere; list each of swarm.agents = {agents} at one host"
    yield from (f"hosts: agent {agent} runs at {n} hosts; list it once" for agent, n in counts.items() if n > 1)
    if unknown := sorted(agent for agent in counts if not 0 <= agent < agents):
        yield f"hosts: there are no agents {unknown}; swarm.agents = {agents}"


def _clashes(hosts: Sequence[HostParams]) -> Iterator[str]:
    """Yield addresses that are one, and where datagrams, which go to the port after, would meet something else."""
    valid = [host for host in hosts if not _address_problem(host.address)]
    counts = Counter(split_address(host.address) for host in valid)  # one address has several spellings
    yield from (f"hosts: address {_spelt(place)!r} is given {n} times" for place, n in counts.items() if n > 1)
    places = {split_address(host.address): host.name for host in valid}
    for (ip, port), name in places.items():
        if other := places.get((ip, port + 1)):
            yield f"hosts: port {port + 1} of {ip} is {other}'s and that of datagrams to {name}; leave one port between"
    if len({ip.version for ip, _ in places}) > 1:
        yield "hosts: addresses are of IPv4 and of IPv6; use one kind for all"


def _spelt(place: tuple[ipaddress.IPv4Address | ipaddress.IPv6Address, int]) -> str:
    ip, port = place
    return f"[{ip}]:{port}" if ip.version == 6 else f"{ip}:{port}"


def roster_of(hosts: Sequence[HostParams], *, relay: bool) -> Roster:
    """Return the identities of these hosts, and the station's, which is always an operator's."""
    speakers = [
        Speaker(
            name=host.name,
            agents=host.agents,
            senders=(host.name, *map(agent_name, host.agents)),
            operator=host.operator,
            address=host.address,
        )
        for host in hosts
    ]
    station = Speaker(name=STATION, agents=(), senders=(STATION,), operator=True)
    return Roster(speakers=(*speakers, station), relay=relay)


def links_of(hosts: Sequence[HostParams], identity: OwnIdentity) -> RouterLinks:
    """Return the links of a host's router, or of the station's.

    Of two hosts the later in the list connects, so that there is one link for each pair; the station connects to all.
    """
    names = [host.name for host in hosts]
    own = names.index(identity.name) if identity.name in names else len(hosts)
    listen = hosts[own].address if own < len(hosts) else ""
    return RouterLinks(identity=identity, listen=listen, connect=tuple(host.address for host in hosts[:own]))


def ip_of(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Return the IP of `IP:PORT`; IPv6 is in brackets.

    Raises:
        ValueError: it is not of this form.
    """
    return split_address(address)[0]


def _address_problem(address: str) -> str:
    try:
        split_address(address)
    except ValueError as error:
        return str(error)
    return ""
