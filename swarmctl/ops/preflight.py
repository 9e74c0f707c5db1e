"""Preflight: checks packages, ports and vehicle links before a launch, and reports all problems at once.

Free vehicle ports are bound here and passed on, so that no other launch can take them between the check and the flight.
A vehicle that is spoken to at an address of its own, as behind a router, is claimed for as long as the launch runs: two
launches there would both get answers, and both command it.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import socket
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from swarmctl.config import Config
from swarmctl.errors import StartError
from swarmctl.mavlink.serial_devices import serial_problem
from swarmctl.mavlink.transport import bind_udp, parse_url
from swarmctl.telemetry.view.view_ports import PORTS_TRIED, held_view_port

LOOPBACK = "127.0.0.1"
_NEEDED = {
    "numpy": (2, 2),
    "scipy": (1, 14),
    "osqp": (1, 1),
    "pymavlink": (2, 4),
    "eclipse-zenoh": (1, 10),
    "msgspec": (0, 19),
    "pyarrow": (18,),
}
_NEEDED_TO_VIEW = {"rerun-sdk": (0, 41)}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReservedPorts:
    """Ports that the preflight has bound for the launch."""

    sockets: tuple[socket.socket, ...]  # with the built-in simulator one bound socket per agent, else none
    ports: tuple[int, ...]  # ports of these sockets
    view_port: int  # 0 when telemetry is off
    vehicle_sockets: tuple[socket.socket, ...] = ()  # the simulator's ends of the same links
    claims: tuple[socket.socket, ...] = ()  # of vehicles by their addresses

    def release(self) -> None:
        """Close this process's copies of the sockets; agents keep theirs."""
        for sock in (*self.sockets, *self.vehicle_sockets, *self.claims):
            sock.close()


def inspect(config: Config, agents: Sequence[int]) -> ReservedPorts:
    """Check everything that these agents need on this computer, then bind the ports.

    Raises:
        StartError: with every problem, one line each: key, value, fix.
    """
    problems = list(_package_problems(config))
    sockets: tuple[socket.socket, ...] = ()
    claims: list[socket.socket] = []
    count = len(agents)
    if config.sitl.enabled:
        if importlib.util.find_spec("sitl") is None:
            problems.append("sitl.enabled = true: package 'sitl' is not installed; install the whole distribution")
        try:
            sockets = claim_ports(2 * count)  # both ends, so that an agent knows the address of its vehicle
        except StartError as error:
            problems.append(str(error))
    else:
        problems += _vehicle_problems(config, agents, claims)
    view_port = _view_port(config.telemetry.port) if config.telemetry.enabled else 0
    if config.telemetry.enabled and not view_port:
        problems.append(
            f"telemetry.port = {config.telemetry.port}: it and the {PORTS_TRIED - 1} after it are taken; "
            "choose another or set telemetry.enabled = false"
        )
    ports = tuple(sock.getsockname()[1] for sock in sockets[:count])
    reserved = ReservedPorts(
        sockets=sockets[:count],
        ports=ports,
        view_port=view_port,
        vehicle_sockets=sockets[count:],
        claims=tuple(claims),
    )
    if problems:
        reserved.release()
        raise StartError("\n".join(problems))
    return reserved


def claim_ports(count: int) -> tuple[socket.socket, ...]:
    """Bind `count` loopback UDP ports that no other program knows.

    PX4's usual ports from 14540 on are avoided: every other simulator on the machine sends there until it is answered,
    and an agent would take the first sender for its vehicle.

    Raises:
        StartError: the machine has no port left.
    """
    return tuple(bind_udp(LOOPBACK, 0) for _ in range(count))


def _package_problems(config: Config) -> Iterator[str]:
    needed = _NEEDED | (_NEEDED_TO_VIEW if config.telemetry.enabled else {})
    for name, least in needed.items():
        wanted = ".".join(map(str, least))
        try:
            found = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            yield f"package {name}: not installed; pip install '{name}>={wanted}'"
            continue
        numbers = tuple(int(part) for part in re.findall(r"\d+", found)[: len(least)])
        if numbers < least:
            yield f"package {name} = {found}: too old; pip install '{name}>={wanted}'"


def _view_port(first: int) -> int:
    """Return a port that is free now, and which no viewer is about to bind; the viewer looks again."""
    with held_view_port(first) as port:
        return port


def _vehicle_problems(config: Config, agents: Sequence[int], claims: list[socket.socket]) -> Iterator[str]:
    """Yield why links to vehicles can't be used; what is claimed of vehicles is added to `claims`."""
    for agent in agents:
        vehicle = config.vehicles[agent]
        endpoint = parse_url(vehicle.url)
        key = f"vehicles.{agent}.url = {vehicle.url!r}"
        if endpoint.scheme == "serial":
            if problem := serial_problem(endpoint.where):
                yield f"{key}: {problem}"
        elif endpoint.scheme == "udpin":
            try:
                bind_udp(endpoint.where, endpoint.number).close()
            except StartError as error:
                yield f"{key}: {error}"
        else:
            try:
                found = socket.getaddrinfo(endpoint.where, endpoint.number, socket.AF_INET, socket.SOCK_DGRAM)
            except OSError as error:
                yield f"{key}: {endpoint.where} has no address: {error}; check the host"
                continue
            claim = _claimed(f"{found[0][4][0]}:{endpoint.number} {vehicle.sysid}")
            if claim is not None:
                claims.append(claim)
            elif sys.platform == "linux":
                yield f"{key}: another launch on this computer flies the vehicle of sysid {vehicle.sysid} there; end it"


def _claimed(vehicle: str) -> socket.socket | None:
    """Return what claims a vehicle until it is closed, at the latest as this process ends; None where it is taken.

    It is a name of Linux' abstract namespace, which leaves no file and is the network's: one of each namespace.
    """
    if sys.platform != "linux":
        return None
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0swarmctl vehicle {vehicle}")
    except OSError:
        claim.close()
        return None
    return claim
