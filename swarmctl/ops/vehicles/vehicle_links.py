"""Opens the links of vehicles of a configuration for a check, which receives from every sender.

A configured built-in simulator is started for the time they are open, and ended with them.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.check.parameters import names_to_read
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.check.scan.listener import NOWHERE, Address, Listener, UdpListener, open_listener
from swarmctl.check.scan.scan_facts import facts_of, unreached
from swarmctl.check.scan.scanner import SCANNER_COMPID, VehicleScan
from swarmctl.check.scan.signed_listener import SignedListener
from swarmctl.config import Config
from swarmctl.core.types import GeoOrigin
from swarmctl.errors import StartError
from swarmctl.mavlink.signing.channel import CHECK_LINK, SigningChannel
from swarmctl.mavlink.signing.recognition import SignedRecognition
from swarmctl.mavlink.signing.stamp_file import kept_channel
from swarmctl.ops.preflight import claim_ports
from swarmctl.ops.processes import Child, RunContext, end_all, run_name, sitl_command, wants_realtime
from swarmctl.signing_keys import read_keys, read_own_key
from swarmctl.wall_clock import WallClock, monotonic_us

_SIMULATOR_S = 20.0  # to start on a busy machine
_PATIENCE_S = 3.0  # for a vehicle that is not ready yet
_SIMULATOR_PATIENCE_S = 15.0
_STOP_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """The opened link of one vehicle, or why it can't be opened."""

    url: str
    listener: Listener | None
    there: Address
    problem: str = ""


@dataclass(frozen=True, slots=True)
class VehicleLinks:
    """The links of vehicles."""

    links: Mapping[int, Link]  # by agent
    connect_s: float
    simulator: Child | None = None

    @property
    def patience_s(self) -> float:
        """Additional time for vehicles that are not ready to arm yet."""
        return _PATIENCE_S if self.simulator is None else _SIMULATOR_PATIENCE_S

    def ended(self) -> bool:
        """Return whether a simulator that was started here has ended."""
        return self.simulator is not None and self.simulator.poll() is not None

    def scans(self, config: Config, seconds: float) -> dict[int, VehicleScan]:
        """Return a scan for each agent whose link is open, which listens for so long after the first heartbeat."""
        sysids, names = config.sysids(), partial(names_to_read, config=config)
        return {
            agent: VehicleScan(
                link.listener, link.there, sysids[agent], names, seconds=seconds, patience_s=self.patience_s
            )
            for agent, link in self.links.items()
            if link.listener is not None
        }

    def facts(self, config: Config, scans: Mapping[int, VehicleScan]) -> list[VehicleFacts]:
        """Return what the scans have found out until now, by agent."""
        swarm, sysids, now_us = config.swarm, config.sysids(), monotonic_us()
        shared = GeoOrigin(swarm.origin_lat_deg, swarm.origin_lon_deg, swarm.origin_alt_m)
        return [
            facts_of(scans[agent], agent, link.url, sysids[agent], shared=shared, now_us=now_us)
            if agent in scans
            else unreached(agent, link.url, sysids[agent], link.problem)
            for agent, link in self.links.items()
        ]


@contextlib.contextmanager
def open_links(config: Config, connect_s: float, agents: Sequence[int] | None = None) -> Iterator[VehicleLinks]:
    """Open links, and close them afterwards.

    Args:
        config: of all vehicles.
        connect_s: time to wait for a heartbeat.
        agents: those whose vehicles are asked; None: all.
    """
    names, sysids = config.mavlink.signing_keys, config.sysids()
    if agents is None:
        agents = range(config.swarm.agents)
        keys = dict(enumerate(read_keys(names, config.swarm.agents)))
    else:  # those of the others may be on other computers
        keys = {agent: read_own_key(names, agent) for agent in agents}
    with contextlib.ExitStack() as kept:
        clock = WallClock()
        channels = {
            agent: None if key is None else kept.enter_context(kept_channel(key, CHECK_LINK, clock.utc_us))
            for agent, key in keys.items()
        }
        of_all = _simulator(config, agents) if config.sitl.enabled else _vehicles(config, agents, connect_s)
        opened = kept.enter_context(of_all)
        links = {a: _signed(link, channels[a], sysids[a], clock) for a, link in opened.links.items()}
        yield replace(opened, links=links)


@contextlib.contextmanager
def _vehicles(config: Config, agents: Sequence[int], connect_s: float) -> Iterator[VehicleLinks]:
    links = {agent: _open(config.vehicles[agent].url) for agent in agents}
    try:
        yield VehicleLinks(links, connect_s)
    finally:
        _close(links.values())


def _signed(link: Link, channel: SigningChannel | None, sysid: int, clock: WallClock) -> Link:
    """Return a link whose frames are signed and verified where there is a key."""
    if channel is None or link.listener is None:
        return link
    vehicle = SignedRecognition(channel, sysid, SCANNER_COMPID, clock.utc_us)
    return replace(link, listener=SignedListener(link.listener, channel, vehicle))


def _open(url: str) -> Link:
    try:
        listener, there = open_listener(url)
    except StartError as error:
        return Link(url=url, listener=None, there=NOWHERE, problem=str(error))
    return Link(url=url, listener=listener, there=there)


def _close(links: Iterable[Link]) -> None:
    for link in links:
        if link.listener is not None:
            link.listener.close()


@contextlib.contextmanager
def _simulator(config: Config, agents: Sequence[int]) -> Iterator[VehicleLinks]:
    """Start the simulator of a launch on separate ports, and yield its links."""
    sockets = claim_ports(len(agents))
    ports = [sock.getsockname()[1] for sock in sockets]
    links = {
        agent: Link(url=f"built-in simulator, port {p}", listener=UdpListener(s), there=NOWHERE)
        for agent, s, p in zip(agents, sockets, ports, strict=True)
    }
    directory = Path(tempfile.mkdtemp(prefix="swarm-check-"))
    children: list[Child] = []
    context = RunContext(
        run_name(config.name),
        f"{SCHEME}{directory / 'bus.sock'}",
        directory,
        tuple(agents),
        realtime=wants_realtime(config, agents),
    )
    try:
        children.append(Child(sitl_command(config, context, ports), directory))
        yield VehicleLinks(links, _SIMULATOR_S, children[0])
    finally:
        end_all(children, _STOP_S)
        _close(links.values())
        shutil.rmtree(directory, ignore_errors=True)
