"""The links of one router to those of other computers, as its process is told of them and as it tells Zenoh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarmctl.bus.network.access import access_settings
from swarmctl.bus.network.identity_files import AUTHORITY, certificate_file, key_file
from swarmctl.bus.network.roster import OwnIdentity, split_address

LINK_LEASE_MS = 1500  # silence of another router after which its link counts as cut


def link_endpoint(address: str) -> str:
    """Return what Zenoh is told of `IP:PORT`: without brackets, with which it takes an IPv6 address for a name."""
    ip, port = split_address(address)
    return f"quic/{ip}:{port}"


@dataclass(frozen=True, slots=True, kw_only=True)
class RouterLinks:
    """The links of a router to those of other computers.

    Attributes:
        identity: whom this router proves to be, and whom it lets say what.
        listen: own `ADDRESS:PORT` for others; "" accepts none.
        connect: addresses of others to connect to, again and again while they do not answer.
    """

    identity: OwnIdentity
    listen: str = ""
    connect: tuple[str, ...] = ()

    def settings(self, common_names: Mapping[str, str]) -> dict[str, Any]:
        """Return what Zenoh is told of these links; `common_names` are those of trusted certificates, by identity."""
        name, folder = self.identity.name, Path(self.identity.folder)
        own = {"certificate": certificate_file(name), "private_key": key_file(name)}
        tls = {"root_ca_certificate": certificate_file(AUTHORITY)}
        tls |= {f"{side}_{kind}": file for side in ("listen", "connect") for kind, file in own.items()}
        return {
            **{f"transport/link/tls/{key}": str(folder / file) for key, file in tls.items()},
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/verify_name_on_connect": True,
            "transport/link/tx/lease": LINK_LEASE_MS,
            "connect/endpoints": [link_endpoint(address) for address in self.connect],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
            **access_settings(self.identity.roster, name, common_names),
        }

    def arguments(self) -> tuple[str, ...]:
        """Return the command-line options of a router with these links."""
        listen = ("--listen", self.listen) if self.listen else ()
        connect = (argument for address in self.connect for argument in ("--connect", address))
        return ("--identity", self.identity.as_json(), *listen, *connect)
