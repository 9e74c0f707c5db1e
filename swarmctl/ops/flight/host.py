"""One computer of a swarm that flies from several: what it is told, its identity, and the flight of its agents.

Every computer has the same configuration, from which the name of the run follows. So swarms with other configurations
are on other keys of the bus, even where their routers are linked, and computers need to agree on nothing else.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Sequence
from ipaddress import IPv4Address, IPv6Address
from pathlib import Path

import tomli_w

from swarmctl.bus.network.hosts import HostParams, ip_of, links_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.config import Config, load, own_identity
from swarmctl.errors import ConfigError
from swarmctl.ops.flight.launch import LaunchOptions, SwarmPart, launch_part

_DIGEST_CHARACTERS = 8
# Folders and processes differ between computers, flights do not.
_OF_A_COMPUTER = (
    ("own_folder",),
    ("mavlink", "signing_keys"),
    ("bus", "identities"),
    ("swarm", "agents_per_process"),
)


def load_host(path: Path, agents: Sequence[int], overrides: Sequence[str] = ()) -> tuple[Config, HostParams]:
    """Return a configuration and its host that has these agents.

    Raises:
        ConfigError: the configuration is invalid, has no such host, or the host's identity can't be used.
    """
    config = load(path, overrides, only_agents=agents)
    refuse_no_hosts(config)
    host = next((host for host in config.hosts if sorted(host.agents) == sorted(agents)), None)
    if host is None:
        known = "; ".join(f"{host.name}: {','.join(map(str, host.agents))}" for host in config.hosts)
        raise ConfigError("--agents", [f"no host has just agents {list(agents)}; hosts of {path}: {known}"])
    if any(obstacle.moves for obstacle in config.obstacles):
        problem = "one moves, from a time at which every host starts it apart; add it in flight: swarmctl obstacle add"
        raise ConfigError("obstacles", [problem])
    refuse_unidentified(config, host.name)
    return config, host


def refuse_no_hosts(config: Config) -> None:
    """Check that a swarm has several computers.

    Raises:
        ConfigError: it has not.
    """
    if not config.hosts:
        raise ConfigError("hosts", ["the configuration lists none; a swarm on one computer flies by: swarmctl launch"])


def fly_host(config: Config, host: HostParams, options: LaunchOptions) -> int:
    """Fly the agents of one computer and return the exit code, as a launch does for the whole swarm.

    Raises:
        ConfigError, StartError: it was refused, or did not come up; nothing is left running.
    """
    links = links_of(config.hosts, own_identity(config, host.name))
    part = SwarmPart(run=shared_run_name(config), agents=tuple(sorted(host.agents)), links=links)
    telemetry = config.telemetry.model_copy(update={"enabled": False})  # the station has the view
    return launch_part(config.model_copy(update={"telemetry": telemetry}), options, part)


def shared_run_name(config: Config) -> str:
    """Return the name of the run, which is the same on every computer that has the same configuration."""
    tree = config.model_dump(exclude_none=True)
    for *sections, key in _OF_A_COMPUTER:
        section = tree
        for name in sections:
            section = section[name]
        del section[key]
    return f"{config.name}-{hashlib.sha256(tomli_w.dumps(tree).encode()).hexdigest()[:_DIGEST_CHARACTERS]}"


def make_host_identities(path: Path, overrides: Sequence[str] = ()) -> tuple[Path, list[str]]:
    """Make the missing identities of a configuration's hosts and of its station; returns their folder and names.

    Raises:
        ConfigError: the configuration is invalid or names no hosts or no folder, or files can't be read.
        StartError: files can't be written.
    """
    from swarmctl.bus.network.identities import make_identities  # loads cryptography

    config = load(path, overrides, only_agents=())
    folder = _folder_of(config)
    if not config.hosts:
        raise ConfigError(str(path), ["hosts: none is listed; add one [[hosts]] for each computer"])
    return folder, make_identities(folder, _addresses(config))


def add_host_identity(path: Path, name: str, overrides: Sequence[str] = ()) -> Path:
    """Make the identity of one of a configuration's hosts, or of its station; returns its folder.

    Raises:
        ConfigError: the configuration is invalid or names no such host or no folder, the host has an identity that
            counts, or files can't be read.
        StartError: files can't be written.
    """
    from swarmctl.bus.network.identities import add_identity  # loads cryptography

    config = load(path, overrides, only_agents=())
    folder, addresses = _folder_of(config), _addresses(config)
    if name not in addresses:
        raise ConfigError("keys add", [f"{name} is none of {', '.join(addresses)} ([[hosts]] of {path})"])
    add_identity(folder, name, addresses[name])
    return folder


def revoke_host_identity(path: Path, name: str, overrides: Sequence[str] = ()) -> Path:
    """Revoke an identity, also of a host that the configuration no longer names; returns the list of what is revoked.

    Raises:
        ConfigError: the configuration is invalid or names no folder, or there is no such identity.
        StartError: files can't be written.
    """
    from swarmctl.bus.network.identities import revoke_identity  # loads cryptography

    return revoke_identity(_folder_of(load(path, overrides, only_agents=())), name)


def _addresses(config: Config) -> dict[str, IPv4Address | IPv6Address | None]:
    return {**{host.name: ip_of(host.address) for host in config.hosts}, STATION: None}


def systemd_unit(path: Path, host: HostParams, overrides: Sequence[str] = ()) -> str:
    """Return a unit that flies the agents of a host when it is started, and lands them when it is stopped.

    Args:
        path: configuration of the swarm.
        host: the host.
        overrides: keys that are set besides, which have to be the same on every computer.
    """
    agents = ",".join(map(str, host.agents))
    options = ("--config", str(path.resolve()), "--agents", agents, *(f"--set={override}" for override in overrides))
    command = " ".join(_unit_word(word) for word in (sys.executable, "-m", "swarmctl", "host", *options))
    return f"""# Start it by hand, or by a program of yours: it arms and takes off as soon as the whole swarm is ready.
# So it has no [Install] section, by which it would fly at every boot, and it is not restarted.
[Unit]
Description=swarmctl host {host.name}: agents {agents}
Wants=network-online.target
After=network-online.target

[Service]
ExecStart={command}
WorkingDirectory=%h
Restart=no
KillMode=mixed
KillSignal=SIGINT
TimeoutStopSec=420
LimitRTPRIO=20
"""


def _unit_word(word: str) -> str:
    """Return a word as systemd reads it back: its quotes and escapes are not those of a shell."""
    literal = word.replace("%", "%%").replace("$", "$$")
    if re.fullmatch(r"[\w%$@=+:,./-]+", literal):
        return literal
    escaped = literal.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
    return f'"{escaped}"'


def refuse_unidentified(config: Config, name: str) -> None:
    """Check that this computer can prove that it belongs to the swarm, and has the certificates of the others.

    Raises:
        ConfigError: it can't, or has not.
    """
    from swarmctl.bus.network.keyring import (
        refuse_distrusted,  # loads cryptography, which one computer alone does not need
    )

    _folder_of(config)
    refuse_distrusted(own_identity(config, name))


def _folder_of(config: Config) -> Path:
    if not config.bus.identities:
        problem = "not set: hosts are linked by certificates only; name a folder, then: swarmctl keys init CONFIG"
        raise ConfigError("bus.identities", [problem])
    return Path(config.bus.identities)
