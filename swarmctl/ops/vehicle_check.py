"""`swarmctl check`: scans all vehicles of a configuration at once, and prints one table and what to fix.

Nothing is changed without `--apply`, and with it only wanted parameters of vehicles that are disarmed on the ground. A
configured built-in simulator is started for the check and ended with it.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from swarmctl.bus.zenoh_bus import SCHEME
from swarmctl.check.change import Change
from swarmctl.check.link_facts import VehicleFacts
from swarmctl.check.listener import NOWHERE, Address, Listener, UdpListener, open_listener
from swarmctl.check.parameters import Number, changes, names_to_read, unchangeable
from swarmctl.check.scan_facts import facts_of, unreached
from swarmctl.check.scanner import VehicleScan, run_scans
from swarmctl.check.swarm import exit_code, findings, standing
from swarmctl.check.table import as_json, print_check
from swarmctl.config import Config
from swarmctl.core.types import GeoOrigin
from swarmctl.errors import StartError
from swarmctl.ops.preflight import claim_ports
from swarmctl.ops.processes import Child, RunContext, end_all, run_name, sitl_command
from swarmctl.process_lifetime import StopRequest
from swarmctl.wall_clock import monotonic_us

_CONNECT_S = 5.0  # heartbeats come once a second
_SIMULATOR_S = 20.0  # to start on a busy machine
_PATIENCE_S = 3.0  # for a vehicle that is not ready yet
_SIMULATOR_PATIENCE_S = 15.0
_LONGER_S = 8.0  # for parameters over a slow link
_APPLY_S = 15.0
_STOP_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckOptions:
    """Options of the check that are not part of the configuration."""

    apply: bool = False
    seconds: float = 3.0  # time to listen to every vehicle after its first heartbeat
    json: Path | None = None
    connect_s: float = _CONNECT_S
    to_fly: bool = False  # a flight follows: armed vehicles are findings, because another party flies them


def check(config: Config, options: CheckOptions) -> int:
    """Check the vehicles of a configuration and return the exit code.

    Raises:
        StartError: the built-in simulator does not come up, or the JSON file can't be written.
    """
    ended_cleanly = StopRequest(signal.SIGTERM, signal.SIGHUP, raise_at=1)  # so that started processes are ended
    with ended_cleanly, _vehicle_links(config, options) as opened:
        vehicles, changed = _scan(config, options, opened)
    lines = findings(vehicles, config) + [change.finding() for change in changed if not change.done]
    if options.to_fly:
        lines += standing(vehicles)
    code = exit_code(vehicles, lines)
    print_check(vehicles, lines, changed)
    if options.json is not None:
        text = as_json(vehicles, lines, changed, code)
        try:
            options.json.write_text(text, encoding="utf-8")
        except OSError as error:
            raise StartError(f"{options.json}: can't be written: {error}. Choose another with --json") from error
    return code


@dataclass(frozen=True, slots=True, kw_only=True)
class _Link:
    """The opened link of one vehicle, or why it can't be opened."""

    url: str
    listener: Listener | None
    there: Address
    problem: str = ""


@dataclass(frozen=True, slots=True)
class _VehicleLinks:
    """The links of all vehicles."""

    links: Sequence[_Link]
    connect_s: float
    simulator: Child | None = None

    def ended(self) -> bool:
        """Return whether a simulator that was started here has ended."""
        return self.simulator is not None and self.simulator.poll() is not None


def _scan(config: Config, options: CheckOptions, opened: _VehicleLinks) -> tuple[list[VehicleFacts], list[Change]]:
    links = opened.links
    sysids = config.sysids()
    names = partial(names_to_read, config=config)
    patience_s = _PATIENCE_S if opened.simulator is None else _SIMULATOR_PATIENCE_S
    scans = {
        agent: VehicleScan(link.listener, link.there, sysids[agent], names, options.seconds, patience_s)
        for agent, link in enumerate(links)
        if link.listener is not None
    }
    longest_s = opened.connect_s + options.seconds + patience_s + _LONGER_S
    run_scans(list(scans.values()), opened.connect_s, longest_s, opened.ended)
    if opened.simulator is not None and opened.ended():
        raise StartError(f"built-in simulator {opened.simulator.how_it_ended()}")
    vehicles = _facts(config, links, scans)
    if not options.apply:
        return vehicles, []
    wanted = {facts.agent: changes(facts, config) for facts in vehicles}
    for facts in vehicles:
        if wanted[facts.agent] and not unchangeable(facts):
            scans[facts.agent].set_parameters(wanted[facts.agent])
    run_scans(list(scans.values()), 0.0, _APPLY_S, opened.ended)
    after = _facts(config, links, scans)
    return after, [
        _changed(before, now, name, value, scans[before.agent])
        for before, now in zip(vehicles, after, strict=True)
        for name, value in wanted[before.agent].items()
    ]


def _facts(config: Config, links: Sequence[_Link], scans: dict[int, VehicleScan]) -> list[VehicleFacts]:
    swarm, sysids, now_us = config.swarm, config.sysids(), monotonic_us()
    shared = GeoOrigin(swarm.origin_lat_deg, swarm.origin_lon_deg, swarm.origin_alt_m)
    return [
        facts_of(scans[agent], agent, link.url, sysids[agent], shared, now_us)
        if agent in scans
        else unreached(agent, link.url, sysids[agent], link.problem)
        for agent, link in enumerate(links)
    ]


def _changed(before: VehicleFacts, now: VehicleFacts, name: str, wanted: Number, scan: VehicleScan) -> Change:
    refused = unchangeable(before)
    if not refused and scan.parameters is not None and scan.parameters.interrupted:
        refused = "it was armed, or fell silent, meanwhile"
    was = before.number(name)
    assert was is not None  # `changes` leaves out unknown values
    return Change(agent=before.agent, name=name, before=was, wanted=wanted, after=now.number(name), refused=refused)


# --- vehicle links ---


@contextlib.contextmanager
def _vehicle_links(config: Config, options: CheckOptions) -> Iterator[_VehicleLinks]:
    if config.sitl.enabled:
        with _simulator(config) as opened:
            yield opened
        return
    links = [_open(vehicle.url) for vehicle in config.vehicles[: config.swarm.agents]]
    try:
        yield _VehicleLinks(links, options.connect_s)
    finally:
        _close(links)


def _open(url: str) -> _Link:
    try:
        listener, there = open_listener(url)
    except StartError as error:
        return _Link(url=url, listener=None, there=NOWHERE, problem=str(error))
    return _Link(url=url, listener=listener, there=there)


def _close(links: Sequence[_Link]) -> None:
    for link in links:
        if link.listener is not None:
            link.listener.close()


@contextlib.contextmanager
def _simulator(config: Config) -> Iterator[_VehicleLinks]:
    """Start the simulator of a launch on separate ports, and yield its links."""
    sockets = claim_ports(config.swarm.agents)
    ports = [sock.getsockname()[1] for sock in sockets]
    links = [
        _Link(url=f"built-in simulator, port {p}", listener=UdpListener(s), there=NOWHERE)
        for s, p in zip(sockets, ports, strict=True)
    ]
    directory = Path(tempfile.mkdtemp(prefix="swarm-check-"))
    children: list[Child] = []
    context = RunContext(run_name(config.name), f"{SCHEME}{directory / 'bus.sock'}", directory)
    try:
        children.append(Child(sitl_command(config, context, ports), directory))
        yield _VehicleLinks(links, _SIMULATOR_S, children[0])
    finally:
        end_all(children, _STOP_S)
        _close(links)
        shutil.rmtree(directory, ignore_errors=True)
