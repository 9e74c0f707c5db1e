"""The real-time loop around one agent: absolute deadlines; missed ticks are skipped and counted, never caught up.

Setpoints are sent from the tick only. If this loop stalls they stop, and the autopilot's own failsafe acts.
"""

from __future__ import annotations

import gc
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from swarmctl.agent.agent import Agent
from swarmctl.agent.assembly import make_agent
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US
from swarmctl.bus.relay import RelayingBus
from swarmctl.bus.silence import SessionWatch
from swarmctl.bus.zenoh_bus import NO_BUS
from swarmctl.config import Config, load, own_identity
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.core.operator_verbs import Order
from swarmctl.core.types import Mode
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION, EXIT_OK, EXIT_START, MissionError, StartError
from swarmctl.mavlink.codec import heartbeat_of
from swarmctl.mavlink.commands import OWN_COMPID
from swarmctl.mavlink.forwarding import Forwarding
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel
from swarmctl.mavlink.signing.recognition import SignedRecognition
from swarmctl.mavlink.signing.refusals import in_words
from swarmctl.mavlink.signing.stamp_file import kept_channel
from swarmctl.mavlink.transport import Transport, open_transport, parse_url, resolve
from swarmctl.process_lifetime import StopRequest
from swarmctl.process_priority import request_realtime
from swarmctl.signing_keys import read_own_key
from swarmctl.telemetry.recording.recorder import Recorder
from swarmctl.wall_clock import WallClock

_LOOPBACK = "127.0.0.1"
_LINGER_S = 1.0  # time the process lives on after its end, so that peers receive the last status
_STOP_REPEAT_US = 1_000_000
NOTHING_REFUSED: Mapping[str, int] = MappingProxyType({})
_VEHICLE_LOST_S = 15.0  # time without any vehicle state after which the process gives up


class Pace:
    """Keeps the deadlines of a periodic loop and counts those that were missed.

    A deadline is missed when the setpoint leaves after the next tick was due; a skipped tick counts as missed.

    Attributes:
        due_us: monotonic time the next tick is due.
        missed: deadlines missed so far.
    """

    def __init__(self, period_us: int, first_us: int) -> None:
        self.period_us, self.due_us = period_us, first_us
        self.missed = 0

    def done(self, sent_us: int, now_us: int) -> None:
        """Count the tick that was due, whose setpoint left at `sent_us`, and set the next deadline after `now_us`."""
        if sent_us > self.due_us + self.period_us:
            self.missed += 1
        self.due_us += self.period_us
        skipped = max(0, (now_us - self.due_us) // self.period_us)
        self.missed += skipped
        self.due_us += skipped * self.period_us


class StopOrder:
    """Orders the landing that a signal asks for, again while it is refused: a pilot may give the vehicle back.

    Args:
        ask: gives an order at a time [us]; returns why it is refused, or "".
    """

    def __init__(self, ask: Callable[[Order, int], str]) -> None:
        self._ask = ask
        self._due_us: int | None = None

    def step(self, stop: StopRequest, now_us: int) -> None:
        """Give the order if it is due. Called once in every tick."""
        if stop.take():
            self._due_us = now_us
        if self._due_us is not None and now_us >= self._due_us:
            self._due_us = now_us + _STOP_REPEAT_US if self._ask(Order("land"), now_us) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentProcess:
    """Command-line arguments of one agent process."""

    config_path: Path  # resolved configuration
    agent: int  # index of this agent, from 0
    run: str  # name of the run on the bus
    bus: str  # endpoint of the router; `NO_BUS`: the agent flies without peers
    run_dir: Path  # folder to record into
    fd: int | None = None  # bound UDP socket inherited from the launcher
    vehicle_port: int | None = None  # loopback port of the vehicle; None if unknown
    only_land: bool = False  # land and disarm the vehicle, whatever it is doing, then end
    realtime: bool = False  # ask to be scheduled before other programs
    originals: Mapping[str, int | float] = field(default_factory=dict)  # of parameters that an ended agent has changed
    identity: str = ""  # name of the host it speaks for; "": messages are not sealed


def run_agent(process: AgentProcess) -> int:
    """Run one agent until its mission has ended; returns the exit code.

    Raises:
        StartError: link, bus or vehicle can't be reached.
        ConfigError: the configuration is not valid.
    """
    agent = process.agent
    config = load(process.config_path, only_agents=(agent,))
    if not 0 <= agent < config.swarm.agents:
        raise StartError(f"--id {agent}: allowed: 0..{config.swarm.agents - 1} (swarm.agents)")
    stop = StopRequest(signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    if process.only_land:
        stop.ask()
    clock = WallClock()
    key = read_own_key(config.mavlink.signing_keys, agent)
    with nullcontext() if key is None else kept_channel(key, AGENT_LINK, clock.utc_us) as signing:
        return _fly(process, config, clock, stop, signing)


def _fly(
    process: AgentProcess, config: Config, clock: WallClock, stop: StopRequest, signing: SigningChannel | None
) -> int:
    agent = process.agent
    url = config.vehicles[agent].url if config.vehicles else ""
    transport = _open_link(process, config, clock, signing)
    recorder = Recorder(process.run_dir, agent)
    link = _join(process, config, clock)
    boot_id = (clock.utc_us() // 1000) & 0xFFFFFFFF
    flown = make_agent(
        config,
        agent,
        boot_id,
        transport,
        bus=link,
        clock=clock,
        sink=recorder,
        on_frame=lambda frame: recorder.frame(clock.utc_us(), frame),
        stopwatch_ns=time.perf_counter_ns,
        signing=signing,
        originals=process.originals,
    )
    if process.realtime:
        granted, spent_s = request_realtime(), time.process_time()
        recorder.event("realtime", clock.now_us(), clock.utc_us(), granted=granted, start_up_s=round(spent_s, 3))
    try:
        vehicle = url or f"inherited socket of sysid {config.sysids()[agent]}"
        sessions = SessionWatch(link, lambda name, **f: recorder.event(name, clock.now_us(), clock.utc_us(), **f))
        return _loop(flown, config, clock, stop, sessions, vehicle=vehicle, only_land=process.only_land)
    finally:
        for name, fields in flown.totals(recorder.lost).items():
            recorder.event(name, clock.now_us(), clock.utc_us(), **fields)
        link.close()
        transport.close()
        recorder.close()


def _open_link(process: AgentProcess, config: Config, clock: WallClock, signing: SigningChannel | None) -> Transport:
    """Open the link to the vehicle, and forward it to the ground stations that are to listen."""
    url = config.vehicles[process.agent].url if config.vehicles else f"udpin://{_LOOPBACK}:14540"
    sysid = config.sysids()[process.agent]
    link = _open_vehicle(process, url, sysid, clock, signing)
    if not config.mavlink.forward:
        return link
    stations = [(resolve(there.where), there.number) for there in map(parse_url, config.mavlink.forward)]
    sign = bytes if signing is None else signing.sign
    return Forwarding(link, stations, sysid, commands=config.mavlink.forward_commands, sign=sign)


def _open_vehicle(
    process: AgentProcess, url: str, sysid: int, clock: WallClock, signing: SigningChannel | None
) -> Transport:
    """Open the link to the vehicle, which belongs to the sender of its HEARTBEAT, a signed one where there is a key."""
    remote = None if process.vehicle_port is None else (_LOOPBACK, process.vehicle_port)
    if signing is None:
        return open_transport(url, process.fd, heartbeat_of(sysid), remote)
    vehicle = SignedRecognition(signing, sysid, OWN_COMPID, clock.utc_us)
    return open_transport(url, process.fd, vehicle.is_vehicle, remote, greeting=vehicle.greeting)


def _join(process: AgentProcess, config: Config, clock: WallClock) -> Bus:
    """Connect to the bus of the run, or to an empty local one when there is no router."""
    me = agent_name(process.agent)
    if process.bus == NO_BUS:
        return LocalHub(clock.now_us).connect(me)
    identity = own_identity(config, process.identity) if process.identity else None
    others = [i for i in range(config.swarm.agents) if i != process.agent]
    peers = [agent_name(i) for i in others]
    far = peers if config.agent.path_sharing.far_hz else []
    launcher = (topics.OPERATOR,)
    listen = {
        topics.PATH: peers,
        topics.FAR_PATH: far,
        topics.FAR_TRAJECTORY: far,
        topics.STATUS: peers,
        topics.TRAJECTORY: peers,
        topics.RELAY: peers,
        topics.COMMAND: launcher if identity is None else identity.roster.commanders(identity.name),
        topics.ENDED: launcher if identity is None else identity.roster.hosts,
        topics.OBSTACLES: launcher if identity is None else (identity.name,),  # which hears the others
        topics.MISSION: launcher if identity is None else identity.roster.commanders(identity.name),
    }
    return join_bus(
        process.bus,
        process.run,
        me,
        listen,
        identity=identity,
        max_age_us=FOR_AGENTS_US,
        utc_us=clock.utc_us,
        lease_ms=config.bus.lease_ms,
        carrier=lambda bus: RelayingBus(bus, others),
    )


def _loop(
    agent: Agent,
    config: Config,
    clock: WallClock,
    stop: StopRequest,
    sessions: SessionWatch,
    *,
    vehicle: str,
    only_land: bool,
) -> int:
    gc.collect()
    gc.freeze()  # keep objects of the start-up out of collections during flight
    landing = StopOrder(agent.ask)
    pace = Pace(round(1e6 / config.agent.rate_hz), clock.now_us())
    seen_us = clock.now_us()
    ever_seen = False
    finished_us: int | None = None
    while True:
        clock.sleep_until(pace.due_us)
        now_us = clock.now_us()
        landing.step(stop, now_us)
        record = agent.tick(now_us, pace.missed)
        sessions.step()
        pace.done(now_us + round(record.timing.tick_ms * 1000), clock.now_us())
        if record.mode is not Mode.STATE_STALE:
            seen_us, ever_seen = now_us, True
        if not agent.done:  # who has landed waits for its peers, and may be switched off
            _check_vehicle_silence(now_us - seen_us, ever_seen, config, vehicle, agent.refused_frames)
        if agent.done if only_land else agent.finished:
            finished_us = finished_us or now_us
            if now_us - finished_us > _LINGER_S * 1e6:
                return _exit_code(agent)


def _check_vehicle_silence(
    silent_us: int, ever_seen: bool, config: Config, vehicle: str, refused: Mapping[str, int] = NOTHING_REFUSED
) -> None:
    seen = f"; frames refused: {in_words(refused)}; see mavlink.signing_keys" if refused else ""
    if not ever_seen and silent_us > config.agent.connect_timeout_s * 1e6:
        raise StartError(
            f"vehicle at {vehicle}: no heartbeat and position within {config.agent.connect_timeout_s:.0f} s{seen}. "
            "Is it running, sending to this port, and is its MAV_SYS_ID the configured sysid? "
            "PX4 answers only the first program that has ever spoken to it: end that one, or restart PX4"
        )
    if ever_seen and silent_us > _VEHICLE_LOST_S * 1e6:
        raise MissionError(f"vehicle at {vehicle}: silent for {_VEHICLE_LOST_S:.0f} s, given up{seen}")


def _exit_code(agent: Agent) -> int:
    if agent.outcome == "completed":
        return EXIT_OK
    print(f"mission not completed: {agent.outcome}", file=sys.stderr)
    if agent.outcome == OPERATOR_STOP:
        return EXIT_INTERRUPTED
    return EXIT_MISSION if agent.has_armed else EXIT_START
