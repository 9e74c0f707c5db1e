"""Identities of a small swarm on several hosts, its routers, and clients of them, for tests of who is believed."""

from __future__ import annotations

import ipaddress
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from swarmctl.bus.network.hosts import HostParams, links_of, roster_of
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.topics import Topic
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import SCHEME

LOOPBACK, LOOPBACK_6 = ipaddress.ip_address("127.0.0.1"), ipaddress.ip_address("::1")

Ip = ipaddress.IPv4Address | ipaddress.IPv6Address


@dataclass(frozen=True, kw_only=True)
class SwarmOfHosts:
    """Hosts alpha, bravo and charlie with one agent each, on loopback; alpha is an operator's.

    Attributes:
        folder: identities, as every host has them.
        hosts: their entries in a configuration.
        relay: see `Roster`.
        places: private folders of routers' sockets.
    """

    folder: Path
    hosts: tuple[HostParams, ...]
    relay: bool = False
    places: dict[str, Path] = field(default_factory=dict)

    @classmethod
    def of(
        cls, folder: Path, ports: Sequence[int] = (1, 2, 3), *, relay: bool = False, at: Ip = LOOPBACK
    ) -> SwarmOfHosts:
        """Return a swarm with the identities of a folder, which are made apart."""
        ip = f"[{at}]" if at.version == 6 else at
        names = ("alpha", "bravo", "charlie")
        hosts = tuple(
            HostParams(name=name, address=f"{ip}:{port}", agents=(number,), operator=name == "alpha")
            for number, (name, port) in enumerate(zip(names, ports, strict=True))
        )
        return cls(folder=folder, hosts=hosts, relay=relay)

    def identity(self, name: str, folder: Path | None = None) -> OwnIdentity:
        """Return an identity, with the files of another folder where one is given."""
        roster = roster_of(self.hosts, relay=self.relay)
        return OwnIdentity(folder=str(folder or self.folder), name=name, roster=roster)

    @contextmanager
    def router(self, name: str, *options: str, folder: Path | None = None) -> Iterator[None]:
        """Run the router of a host or of the station; `options` replace its module."""
        self.places[name] = place = Path(tempfile.mkdtemp(prefix="sw"))
        links = links_of(self.hosts, self.identity(name, folder))
        module = options or ("-m", "swarmctl.bus.network.router")
        command = [sys.executable, *module, f"{SCHEME}{place}/bus.sock", "--die-with-parent", *links.arguments()]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline().startswith("router ready")
        try:
            yield
        finally:
            process.terminate()
            process.wait(20)
            process.stdout.close()
        assert process.returncode == 0
        assert not place.exists()

    def endpoint(self, name: str) -> str:
        """Return the socket of a host's router."""
        return f"{SCHEME}{self.places[name]}/bus.sock"

    def plain(self, at: str, sender: str, listen: dict[Topic, list[str]] | None = None) -> ZenohBus:
        """Join a host's router without seals, as one who has only its user's rights."""
        return ZenohBus(self.endpoint(at), "run", sender, listen or {})
