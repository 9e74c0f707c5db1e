"""Builds one `Agent` from a whole configuration; real time and lockstep differ only in the arguments they pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from swarmctl.agent.agent import Agent
from swarmctl.agent.ports import Ports, TickSink
from swarmctl.agent.setup import AgentSetup
from swarmctl.bus.topics import OPERATOR
from swarmctl.bus.traffic import CountedBus
from swarmctl.config import Config
from swarmctl.core.clock import Clock, TickClock
from swarmctl.core.mavlink_values import AUTOPILOT_COMPID
from swarmctl.core.types import GeoOrigin
from swarmctl.flown_code import code_in_words
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.commands import OWN_COMPID, CommandPort
from swarmctl.mavlink.signing.channel import SigningChannel
from swarmctl.mavlink.signing.signed_transport import SignedTransport
from swarmctl.mavlink.transport import Transport
from swarmctl.mavlink.vehicle.autopilot import Autopilot


def make_agent(
    config: Config,
    agent: int,
    boot_id: int,
    transport: Transport,
    *,
    bus: CountedBus,
    clock: Clock,
    sink: TickSink,
    on_frame: Callable[[bytes], None],
    stopwatch_ns: Callable[[], int],
    rehearses: bool = True,
    signing: SigningChannel | None = None,
    originals: Mapping[str, int | float] | None = None,
) -> Agent:
    """Build an agent and connect it to its vehicle, its peers and its recorder.

    Args:
        config: configuration of the run.
        agent: index of this agent, from 0.
        boot_id: differs between restarts of the same agent.
        transport, bus, clock, sink, rehearses: see `Ports`.
        on_frame: called with every MAVLink frame sent or received.
        stopwatch_ns: measures the tick [ns].
        signing: signs and verifies the frames of the link; None: they are plain.
        originals: see `AgentSetup`.
    """
    autopilot, commands = _connect_vehicle(config, agent, transport, on_frame, signing)
    ports = Ports(
        autopilot=autopilot,
        commands=commands,
        bus=bus,
        clock=TickClock(clock),
        sink=sink,
        stopwatch_ns=stopwatch_ns,
        rehearses=rehearses,
    )
    return Agent(_setup_of(config, agent, boot_id, originals or {}), ports)


def _connect_vehicle(
    config: Config,
    agent: int,
    transport: Transport,
    on_frame: Callable[[bytes], None],
    signing: SigningChannel | None,
) -> tuple[Autopilot, CommandPort]:
    """Return the hot path and the slow path to one vehicle, which share its link."""
    sysid, swarm = config.sysids()[agent], config.swarm
    codec = Codec(sysid, OWN_COMPID)
    origin = GeoOrigin(swarm.origin_lat_deg, swarm.origin_lon_deg, swarm.origin_alt_m)
    link = transport if signing is None else SignedTransport(transport, signing, sysid, AUTOPILOT_COMPID)
    refusals = None if signing is None else signing.refusals
    autopilot = Autopilot(link, codec, sysid, origin, on_frame=on_frame, refusals=refusals)
    commands = CommandPort(autopilot.send_frame, codec, sysid, lambda: autopilot.dialect)
    autopilot.connect(commands)
    return autopilot, commands


def _setup_of(config: Config, agent: int, boot_id: int, originals: Mapping[str, int | float]) -> AgentSetup:
    swarm = config.swarm
    return AgentSetup(
        agent=agent,
        boot_id=boot_id,
        sysid=config.sysids()[agent],
        vouchers={OPERATOR: frozenset(range(swarm.agents)), **{h.name: frozenset(h.agents) for h in config.hosts}},
        code=shared_code(config),
        quorum=_quorum(config),
        params=config.agent,
        mission=config.mission,
        starts_ned_m=np.array(config.starts_ned_m()),
        controller=config.controller,
        separation=config.separation,
        vehicle_model=config.model_of(agent),
        max_obstacles=min(max(1, len(config.obstacles)), config.separation.max_obstacles),
        volume=config.volume.flight_volume(),
        fence=config.geofence.area(),
        drift_m=config.drift_m,
        has_ground=not config.sitl.enabled or config.sitl.start == "ground",
        originals=originals,
    )


def shared_code(config: Config) -> str:
    """Return what code flies here, which has to be the same on every computer; "" on one alone, where it is."""
    return code_in_words(config.own_folder) if config.hosts else ""


def _quorum(config: Config) -> int:
    """Return how many agents one has to see on the bus, itself included, to take a silent one that has left for dead.

    On one computer it is. From another computer it may be cut off, and fly on. Where routers pass on what others say,
    the bus falls into parts that see none of each other, and one part at most has a majority: the others rest. Where
    they don't, two computers may both see a third one and not each other, so nobody is taken for dead.
    """
    agents = config.swarm.agents
    if len(config.hosts) < 2:
        return 1
    return agents // 2 + 1 if config.bus.relay else agents
