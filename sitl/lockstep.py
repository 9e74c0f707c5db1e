"""Flies a run on a simulated clock: real agents, real MAVLink bytes, faster than real time.

Nothing depends on wall time, and `swarmctl.kernels` makes results independent of the processor: a seed gives the same
states bit for bit, in whatever order agents are ticked, and in however many processes (`sitl.lockstep_processes`).
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.flight_log import FlightLog
from sitl.flight_parts import NoParts, OtherParts, OutgoingBus, SentMessage, carry
from sitl.lockstep_rates import steps_per_tick
from sitl.world import SitlWorld
from swarmctl.agent.agent import Agent
from swarmctl.agent.assembly import make_agent
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, Subscriptions, agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.local.links import Impairments
from swarmctl.bus.messages.json_messages import CommandMessage, EndedMessage, encode_message, first_list
from swarmctl.bus.relay import RelayingBus
from swarmctl.bus.traffic import CountedBus
from swarmctl.config import Config
from swarmctl.core.clock import ClockError, OffsetClock, SimClock
from swarmctl.core.json_safe import json_safe
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import TRUTH_DTYPE
from swarmctl.core.types import Phase
from swarmctl.files import write_each
from swarmctl.kernels import why_not_repeatable
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.signing_keys import read_keys
from swarmctl.telemetry.evaluation.referee import RunData
from swarmctl.telemetry.recording.file_names import ticks_file

_TAIL_S = 120.0  # time allowed before and after the mission, and beyond what ends by itself
_LAST_S = 5.0  # time in which one that has landed is done, and heard by its peers
_SINKS_M_S = 0.1  # of vehicles that land, at least: another one rests, or is flown by a pilot
_LANDS_M_S = 0.5  # of autopilots that land, at least
_TRUTH_EVERY_US = 20_000
_OBSTACLES_EVERY_US = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """Holds what a flight, or a part of one, has recorded, after its agents' files were written."""

    ticks: dict[int, NDArray[np.void]]  # agent -> (T,) of `TICK_DTYPE`
    truth: NDArray[np.void]  # (T * N,) of `TRUTH_DTYPE`
    events: list[dict[str, Any]]  # of the agents
    fault_events: list[dict[str, Any]]
    problems: list[str]  # why the mission is not complete; none: it is
    unwritten: tuple[str, ...]  # files that the disk did not take, and why

    def run_data(self) -> RunData:
        """Return what a run folder holds of it."""
        return RunData(self.ticks, self.truth, [json_safe(event) for event in self.events + self.fault_events])


class Lockstep:
    """Steps the world and all agents of one flight, or of a part of it, tick by tick.

    Args:
        config: the run.
        directory: folder for the agents' files; None keeps everything in memory.
        order: order of ticking agents within a step; has no effect on the result.
        own: configurations of agents that differ from the run's.
        clocks: errors of the UTC of agents whose clocks are wrong. An agent stamps its messages and records with its
            own; the operator, the simulator and everything on monotonic time are right.
        rehearses: agents plan on the ground as in the air, as they do in real time. It takes a tenth of a flight's
            computation and changes nothing, except for agents that the caller makes as slow as their plans would be.
        part: numbers of the agents that are stepped here, with their vehicles; none: all. The part with the first
            one has the operator.
        others: steps the other parts.

    Attributes:
        agents: those stepped here, in order; None for one that has died.
        logs: their records.
    """

    def __init__(
        self,
        config: Config,
        directory: Path | None = None,
        order: Sequence[int] | None = None,
        own: Mapping[int, Config] | None = None,
        clocks: Mapping[int, ClockError] | None = None,
        *,
        rehearses: bool = False,
        part: range = range(0),
        others: OtherParts | None = None,
    ) -> None:
        everyone = range(config.swarm.agents)
        self._part = part or everyone
        if self._has_operator and (reason := why_not_repeatable()):  # once for all parts
            warnings.warn(f"this flight may differ from the same one elsewhere: {reason}", stacklevel=2)
        self._others: OtherParts = others or NoParts()
        self.config = config
        self.clock = SimClock()
        self._physics_us = round(1e6 / config.sitl.physics_hz)
        self._tick_us = self._physics_us * steps_per_tick(config)
        latency_us = round(config.sitl.link_latency_ms * 1000)
        self.links = [pipe_pair(self.clock.now_us, latency_us) for _ in everyone]  # (agent's, vehicle's) ends
        self._keys = read_keys(config.mavlink.signing_keys, len(everyone))
        vehicles = [vehicle for _, vehicle in self.links]
        self.world = SitlWorld(config.simulator(), vehicles, keys=self._keys, stepped=self._part)
        self.hub = _hub(config, self.clock)
        errors = clocks or {}
        own_clocks = [OffsetClock(self.clock, errors[i]) if i in errors else self.clock for i in self._part]
        named = zip(self._part, own_clocks, strict=True)
        self.logs = [FlightLog(directory=directory, agent=i, clock=clock) for i, clock in named]
        self.fault_events: list[dict[str, Any]] = []
        self.world.faults.on_event = self._on_fault
        self._sent: list[SentMessage] = []  # in this step, for the others
        self._operator = self._outgoing(topics.OPERATOR, {})
        self._own, self._rehearses = dict(own or {}), rehearses
        self._starts = dict.fromkeys(self._part, 0)  # of further processes
        self.agents: list[Agent | None] = self._attach_agents()
        self.frozen: set[int] = set()  # agents whose process is stopped: alive on the bus, but not ticking
        self.starved: dict[int, int] = {}  # agent -> its processor executes one tick out of this many
        self._missed = dict.fromkeys(self._part, 0)
        self._steps = 0
        self._order = list(order) if order is not None else list(self._part)
        self._truth: list[NDArray[np.void]] = []
        self._obstacles = first_list(config.obstacles, self.clock.utc_us())

    def _attach_agents(self) -> list[Agent | None]:
        """Attach all agents to the bus, in every part in the same order; return those of this part."""
        agents: list[Agent | None] = []
        for i in range(self.config.swarm.agents):
            if i in self._part:
                agents.append(self._agent(i))
            else:
                self.hub.connect(agent_name(i), {})
        return agents

    def _outgoing(self, name: str, subscriptions: Subscriptions) -> Bus:
        """Return the bus of a participant that the other parts hear, too."""
        bus = self.hub.connect(name, subscriptions)
        return bus if isinstance(self._others, NoParts) else OutgoingBus(bus, name, self._sent)

    @property
    def _has_operator(self) -> bool:
        return self._part.start == 0

    def _on_fault(self, name: str, t_us: int, fields: dict[str, Any]) -> None:
        stamp = {"utc_us": self.clock.utc_us(), "t_us": self.clock.now_us(), "source": "sitl", "event": name}
        self.fault_events.append({**stamp, "since_boot_us": t_us, **fields})

    def _agent(self, index: int) -> Agent:
        log = self.logs[self._part.index(index)]
        others = [i for i in range(self.config.swarm.agents) if i != index]
        bus = RelayingBus(self._outgoing(agent_name(index), dict.fromkeys(topics.FOR_AGENTS)), others)
        config = self._own.get(index, self.config)
        key = self._keys[index]
        return make_agent(
            config,
            index,
            self._boot_id(index),
            self.links[index][0],
            bus=CountedBus(bus),
            clock=log.clock,
            sink=log,
            on_frame=log.frame,
            stopwatch_ns=time.perf_counter_ns,
            rehearses=self._rehearses,
            signing=None if key is None else SigningChannel(key, AGENT_LINK, log.clock.utc_us),
        )

    def _boot_id(self, index: int) -> int:
        return self.config.seed * 1000 + index + self._starts[index] * 1_000_000

    def step(self) -> None:
        """Tick every agent once, then step the physics to the next tick."""
        self._others.begin_step()
        now_us = self.clock.now_us()
        if self._has_operator and _is_due(now_us, self._tick_us, _OBSTACLES_EVERY_US):
            self._operator.publish(topics.OBSTACLES, encode_message(self._obstacles))
        first = self._part.start
        for i in self._order:
            agent = self.agents[i - first]
            if agent is None or i in self.frozen:
                continue
            if self._steps % self.starved.get(i, 1):
                self._missed[i] += 1
                continue
            agent.tick(now_us, self._missed[i])
        self._steps += 1
        carry(self.hub, self._others.exchange(self._sent, self._have_finished()))
        self._sent.clear()
        for _ in range(self._tick_us // self._physics_us):
            self.clock.advance(self._physics_us)
            self.world.step(self.clock.now_us())
            if _is_due(self.clock.now_us(), self._physics_us, _TRUTH_EVERY_US):
                self._truth.append(self.world.truth_rows()[self._part.start : self._part.stop])

    def kill(self, index: int) -> None:
        """End an agent's process: no more setpoints, its bus session closes, and the others are told as by a launch."""
        self.agents[self._part.index(index)] = None
        self.hub.detach(agent_name(index))
        ended = EndedMessage(agent=index, boot_id=self._boot_id(index), is_down=False)
        self._operator.publish(topics.ENDED, encode_message(ended))

    def recover(self, index: int) -> None:
        """End an agent's process and start another that only lands its vehicle, as a launch does with a frozen one."""
        self.kill(index)
        self.frozen.discard(index)
        self.start_again(index)
        self.command("land", index)

    def start_again(self, index: int) -> None:
        """Start another process for an agent that was killed: it finds its vehicle where it is."""
        self._starts[index] += 1
        self.agents[self._part.index(index)] = self._agent(index)

    def command(self, verb: str, agent: int = -1, **arguments: float) -> None:
        """Send an operator's order, as a verb does."""
        message = CommandMessage(verb, agent, self.clock.utc_us(), arguments)
        self._operator.publish(topics.COMMAND, encode_message(message))

    def set_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Replace the obstacle list by obstacles that are at their centres now, as an operator's verb does."""
        self._obstacles = first_list(obstacles, self.clock.utc_us(), self._obstacles.version + 1)
        self._operator.publish(topics.OBSTACLES, encode_message(self._obstacles))

    @property
    def finished(self) -> bool:
        """Whether every agent has finished, or died."""
        return self._have_finished() and self._others.finished

    def _have_finished(self) -> bool:
        return all(agent is None or agent.finished for agent in self.agents)

    def mission_is_over(self) -> bool:
        """Return whether no agent is on the way to its mission or in it any more."""
        return all(len(log.rows) and log.rows[-1]["phase"][0] > Phase.TRACK for log in self.logs)

    @property
    def truth(self) -> NDArray[np.void]:
        """True states of the vehicles stepped here, so far, (T * N,) of `TRUTH_DTYPE`."""
        return np.concatenate(self._truth) if self._truth else np.zeros(0, TRUTH_DTYPE)

    def recorded(self) -> RunData:
        """Return what a run folder would hold of the flight so far."""
        return self._flown(()).run_data()

    def end(self) -> Flown:
        """Note the totals of every agent, write their files if there is a folder, and return what was flown."""
        for log, agent in zip(self.logs, self.agents, strict=True):
            if agent is not None:
                for name, fields in agent.totals(lost=0).items():
                    log.event(name, log.clock.now_us(), log.clock.utc_us(), **fields)
        return self._flown(write_each({ticks_file(log.agent): log.close for log in self.logs}))

    def _flown(self, unwritten: tuple[str, ...]) -> Flown:
        return Flown(
            ticks={log.agent: log.ticks for log in self.logs},
            truth=self.truth,
            events=[event for log in self.logs for event in log.events],
            fault_events=self.fault_events,
            problems=self.problems(),
            unwritten=unwritten,
        )

    def problems(self) -> list[str]:
        """Return why the mission is not complete; empty when it is."""
        found = []
        for i, agent in zip(self._part, self.agents, strict=True):
            if agent is None:
                found.append(f"agent {i} died")
            elif not agent.finished or agent.outcome != "completed":
                found.append(f"agent {i}: {agent.outcome if agent.finished else 'did not finish'}")
        return found

    def run(self, on_step: Callable[[Lockstep], bool | None] | None = None) -> None:
        """Fly until every agent has landed, the time limit is reached, or `on_step` returns True."""
        limit_us, is_last = round((self.config.mission.duration_s + _TAIL_S) * 1e6), False
        while not self.finished:
            if self.clock.now_us() >= limit_us:
                left_s = max(self.ends_in_s(), self._others.ends_in_s())
                if is_last and not left_s:
                    return
                is_last = not left_s
                limit_us = self.clock.now_us() + round((left_s + _TAIL_S if left_s else _LAST_S) * 1e6)
            self.step()
            if on_step is not None and on_step(self):
                return

    def ends_in_s(self) -> float:
        """Return for how long agents of this part do what ends by itself, such as a long way back or down.

        It is 0 where nobody does.
        """
        left_s = [agent.ends_in_s for agent in self.agents if agent is not None]
        left_s += [
            self._lands_in_s(log) for log, agent in zip(self.logs, self.agents, strict=True) if agent is not None
        ]
        return max((seconds for seconds in left_s if seconds > 0.0), default=0.0)

    def _lands_in_s(self, log: FlightLog) -> float:
        """Return how long a vehicle that its autopilot lands may still sink; 0 where it does not."""
        rows, truth = log.rows, self.world.truth_rows()[log.agent]
        lands = bool(rows) and rows[-1]["phase"][0] == Phase.LAND and truth["vel_ned_m_s"][2] > _SINKS_M_S
        height_m = self.config.sitl.ground_z_m - float(truth["pos_ned_m"][2])
        return height_m / _LANDS_M_S if lands and self.config.sitl.start == "ground" else 0.0


def _is_due(now_us: int, step_us: int, every_us: int) -> bool:
    """Return whether this step, `step_us` after the one before, is the first at or after a multiple of `every_us`."""
    return now_us // every_us > (now_us - step_us) // every_us


def _hub(config: Config, clock: SimClock) -> LocalHub:
    bus = config.bus
    impairments = Impairments(
        delay_us=round(bus.delay_ms * 1000),
        loss_01=bus.loss_01,
        burst_01=bus.burst_01,
        burst_s=bus.burst_s,
        jitter_us=round(bus.jitter_ms * 1000),
    )
    return LocalHub(clock.now_us, config.seed, impairments, lease_us=1000 * bus.lease_ms)
