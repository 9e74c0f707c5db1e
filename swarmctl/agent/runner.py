"""The real-time loop around one agent: absolute deadlines; missed ticks are skipped and counted, never caught up.

Setpoints are sent from the tick only. If this loop stalls they stop, and the autopilot's own failsafe acts.
"""

from __future__ import annotations

import gc
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from swarmctl.agent.agent import Agent
from swarmctl.agent.assembly import make_agent
from swarmctl.agent.flight_priority import FlightPriority
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US
from swarmctl.bus.relay import RelayingBus
from swarmctl.bus.silence import SessionWatch
from swarmctl.bus.traffic import CountedBus
from swarmctl.bus.zenoh.client import NO_BUS, socket_file
from swarmctl.bus.zenoh.session import ZenohSession
from swarmctl.config import Config, load, own_identity
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.core.operator_verbs import Order
from swarmctl.core.types import Mode
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION, EXIT_OK, EXIT_START, ConfigError, MissionError, StartError
from swarmctl.mavlink.codec import heartbeat_of
from swarmctl.mavlink.commands import OWN_COMPID
from swarmctl.mavlink.forwarding import Forwarding
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel
from swarmctl.mavlink.signing.recognition import SignedRecognition
from swarmctl.mavlink.signing.refusals import in_words
from swarmctl.mavlink.signing.stamp_file import kept_channel
from swarmctl.mavlink.transport import Transport, open_transport, parse_url, resolve
from swarmctl.process_lifetime import StopRequest
from swarmctl.signing_keys import read_own_key
from swarmctl.telemetry.recording.recorder import Recorder
from swarmctl.telemetry.recording.shared_events import SharedEvents
from swarmctl.wall_clock import WallClock

_LOOPBACK = "127.0.0.1"
_RUN, _RUN_IN_WORDS = re.compile(r"^[^/*$#?\s]+$"), "without spaces and / * $ # ?, which keys of the bus are made of"
_LINGER_S = 1.0  # time the process lives on after its end, so that peers receive the last status
_STOP_REPEAT_US = 1_000_000
NOTHING_REFUSED: Mapping[str, int] = MappingProxyType({})
_VEHICLE_LOST_S = 15.0  # time without any frame of the vehicle after which the process gives up


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
        self._taken = 0  # requests that were seen
        self._due_us: int | None = None

    def step(self, stop: StopRequest, now_us: int) -> None:
        """Give the order if it is due. Called once in every tick."""
        if stop.count > self._taken:
            self._taken, self._due_us = stop.count, now_us
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


class Ending(NamedTuple):
    """How an agent has ended: its exit code, and why its mission was not completed, "" if it was."""

    exit_code: int
    words: str = ""


def run_agent(process: AgentProcess) -> int:
    """Run one agent until its mission has ended; returns the exit code.

    Raises:
        StartError: link, bus or vehicle can't be reached.
        ConfigError: the configuration is not valid, has no such agent, or what the process is given can't be used.
    """
    stop = StopRequest(signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    clock = WallClock()
    with flying_agent(process, clock, stop) as flight:
        keep_from_collections()
        priority = FlightPriority(clock, flight.note)
        if process.realtime:
            priority.ask()
        ending = _fly(flight, clock, priority)
    if ending.words:
        print(ending.words, file=sys.stderr)
    return ending.exit_code


def _fly(flight: RealTimeAgent, clock: WallClock, priority: FlightPriority) -> Ending:
    flight.begin_at(clock.now_us())
    while True:
        priority.sleep_until(flight.due_us)
        ending = flight.step()
        if ending is not None:
            return ending


def keep_from_collections() -> None:
    """Keep objects of the start-up, during which the verb collects no garbage, out of collections during flight."""
    gc.collect()
    gc.freeze()
    gc.enable()


@contextmanager
def flying_agent(
    process: AgentProcess,
    clock: WallClock,
    stop: StopRequest,
    opens_bus: Callable[..., ZenohSession] = ZenohSession,
) -> Iterator[RealTimeAgent]:
    """Open the link, the bus and the recorder of one agent, and close them at the end.

    Args:
        process: what it is told.
        clock: time of this host.
        stop: a request to land.
        opens_bus: opens the session of its bus.

    Raises:
        StartError: link, bus or vehicle can't be reached.
        ConfigError: the configuration is not valid, has no such agent, or what the process is given can't be used.
    """
    agent = process.agent
    config = load(process.config_path, only_agents=(agent,))
    if not 0 <= agent < config.swarm.agents:
        raise ConfigError(f"--id {agent}", [f"allowed: 0..{config.swarm.agents - 1} (swarm.agents)"])
    _refuse_unusable(process)
    if process.only_land:
        stop.ask()
    key = read_own_key(config.mavlink.signing_keys, agent)
    with ExitStack() as opened:
        signing = None if key is None else opened.enter_context(kept_channel(key, AGENT_LINK, clock.utc_us))
        transport = _open_link(process, config, clock, signing)
        opened.callback(transport.close)
        recorder = Recorder(process.run_dir, agent)
        opened.callback(recorder.close)
        link = CountedBus(_join(process, config, clock, opens_bus))
        opened.callback(link.close)
        sink = SharedEvents(recorder, link, agent) if config.hosts else recorder
        flown = make_agent(
            config,
            agent,
            (clock.utc_us() // 1000) & 0xFFFFFFFF,
            transport,
            bus=link,
            clock=clock,
            sink=sink,
            on_frame=lambda frame: recorder.frame(clock.utc_us(), frame),
            stopwatch_ns=time.perf_counter_ns,
            signing=signing,
            originals=process.originals,
        )

        def note(name: str, **fields: Any) -> None:
            sink.event(name, clock.now_us(), clock.utc_us(), **fields)

        vehicle = _vehicle_in_words(config, agent)
        sessions = SessionWatch(link, note)
        try:
            yield RealTimeAgent(
                flown, config, clock, stop, sessions, note=note, vehicle=vehicle, only_land=process.only_land
            )
        finally:
            for name, fields in flown.totals(recorder.lost).items():
                note(name, **fields)


def _refuse_unusable(process: AgentProcess) -> None:
    """Check what a command line names, before anything is opened.

    Raises:
        ConfigError: bus, run, folder or socket is none.
    """
    if process.bus != NO_BUS:
        socket_file(process.bus)
    if not _RUN.match(process.run):
        raise ConfigError(f"--run {process.run!r}", [f"is no name of a run on the bus: {_RUN_IN_WORDS}"])
    if not process.run_dir.is_dir():  # nothing would be recorded
        raise ConfigError(f"--run-dir {process.run_dir}", ["no such folder; make it first"])
    if process.fd is not None and not _is_udp(process.fd):
        raise ConfigError(f"--fd {process.fd}", ["is no UDP socket that this process has inherited"])


def _is_udp(fd: int) -> bool:
    try:
        with socket.socket(fileno=os.dup(fd)) as sock:
            return sock.type == socket.SOCK_DGRAM
    except OSError:
        return False


def _vehicle_in_words(config: Config, agent: int) -> str:
    url = config.vehicles[agent].url if config.vehicles else ""
    return url or f"inherited socket of sysid {config.sysids()[agent]}"


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


def _join(process: AgentProcess, config: Config, clock: WallClock, opens: Callable[..., ZenohSession]) -> Bus:
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
        opens=opens,
    )


class RealTimeAgent:
    """Ticks one agent at absolute deadlines until its mission has ended.

    Args:
        agent: the agent.
        config: its configuration.
        clock: time of this host.
        stop: a request to land.
        sessions: records sessions of the bus that were replaced.
        note: records an event of this agent, given its name and fields.
        vehicle: where the vehicle is, in words.
        only_land: end when the vehicle is down, whatever the peers do.
    """

    def __init__(
        self,
        agent: Agent,
        config: Config,
        clock: WallClock,
        stop: StopRequest,
        sessions: SessionWatch,
        *,
        note: Callable[..., None],
        vehicle: str,
        only_land: bool,
    ) -> None:
        self._agent, self._config, self._clock, self._stop, self._sessions = agent, config, clock, stop, sessions
        self.note = note
        self._vehicle, self._only_land = vehicle, only_land
        self._landing = StopOrder(agent.ask)
        self.period_us = round(1e6 / config.agent.rate_hz)
        self.begin_at(clock.now_us())
        self._ever_seen = False
        self._finished_us: int | None = None

    def begin_at(self, first_us: int) -> None:
        """Set the monotonic time of the first tick, from which the vehicle's silence counts too."""
        self._pace = Pace(self.period_us, first_us)
        self._seen_us = first_us

    @property
    def due_us(self) -> int:
        """Monotonic time the next tick is due."""
        return self._pace.due_us

    def step(self) -> Ending | None:
        """Tick once, now; returns how the mission has ended, None while it has not.

        Raises:
            StartError: the vehicle was never heard.
            MissionError: the vehicle is silent.
        """
        agent, now_us = self._agent, self._clock.now_us()
        self._landing.step(self._stop, now_us)
        record = agent.tick(now_us, self._pace.missed)
        self._sessions.step()
        self._pace.done(now_us + round(record.timing.tick_ms * 1000), self._clock.now_us())
        self._ever_seen = self._ever_seen or record.mode is not Mode.STATE_STALE
        if self._ever_seen:  # who is heard without a position may be armed, and flown by somebody
            self._seen_us = max(self._seen_us, agent.heard_us)
        if not agent.done:  # who has landed waits for its peers, and may be switched off
            silent_us = now_us - self._seen_us
            _check_vehicle_silence(silent_us, self._ever_seen, self._config, self._vehicle, agent.refused_frames)
        if agent.done if self._only_land else agent.finished:
            self._finished_us = self._finished_us or now_us
            if now_us - self._finished_us > _LINGER_S * 1e6:
                return _ending(agent)
        return None


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


def _ending(agent: Agent) -> Ending:
    if agent.outcome == "completed":
        return Ending(EXIT_OK)
    words = f"mission not completed: {agent.outcome}"
    if agent.outcome == OPERATOR_STOP:
        return Ending(EXIT_INTERRUPTED, words)
    return Ending(EXIT_MISSION if agent.has_armed else EXIT_START, words)
