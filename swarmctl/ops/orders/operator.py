"""Operator client: joins the bus of a running launch, and reads what its agents say of themselves.

Verbs repeat their message until answered, because the router of a fresh session may not know the subscribers.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Collection, Iterator, Mapping, Set
from contextlib import contextmanager

import msgspec

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import StatusMessage, decode_status
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.network.sealed_bus import FOR_OPERATORS_US
from swarmctl.bus.peers.vouched_ends import VouchedEnds
from swarmctl.bus.topics import ANSWER, ENDED, OBSTACLES, OPERATOR, STATUS
from swarmctl.errors import StartError
from swarmctl.ops.running_launches import RunningLaunch, refuse_ending, runs
from swarmctl.wall_clock import monotonic_us

ANSWER_S = 5.0  # longest wait for what is asked over the bus
REPEAT_S = 0.2
HAS_ENDED = "has ended, its vehicle is on the ground"  # of whom `GoneAgents` has
_CONNECT_MS = 3000
_UNHEARD_US = 1_000_000  # after which an agent that has ended counts as gone: another process would have been heard


@contextmanager
def joined(launch: RunningLaunch) -> Iterator[Bus]:
    """Join the bus of a launch as its operator; what is not answered because it is ending is told so.

    Raises:
        StartError: it does not answer, or is ending.
    """
    senders = [agent_name(agent) for agent in range(launch.agents)]
    try:
        bus = join_bus(
            launch.bus,
            launch.run,
            OPERATOR if launch.identity is None else launch.identity.name,
            {
                STATUS: senders,
                ANSWER: senders,
                ENDED: tuple(vouchers(launch)),
                OBSTACLES: list_keepers(launch.identity),
            },
            identity=launch.identity,
            max_age_us=FOR_OPERATORS_US,
            utc_us=launch.utc_us,
            connect_timeout_ms=_CONNECT_MS,
        )
    except StartError as error:
        refuse_ending(launch)
        raise StartError(_unreachable(launch)) from error
    try:
        with contextlib.closing(bus):
            yield bus
    except StartError:
        refuse_ending(launch)
        raise


def _unreachable(launch: RunningLaunch) -> str:
    """Return what an operator has to know of a launch that runs, and whose bus can't be joined."""
    if not runs(launch):
        return f"{launch.run} has ended: its process {launch.pid} is gone"
    has_agents = launch.identity is None or launch.identity.speaker.agents
    advice = f". Its process lands all its agents: kill -INT {launch.pid}" if has_agents else ""
    waited_s = _CONNECT_MS / 1000
    return f"{launch.run} runs, but its bus does not answer within {waited_s:.0f} s: nobody has been told{advice}"


def vouchers(launch: RunningLaunch) -> Mapping[str, Set[int]]:
    """Return the agents of which each sender may say that they have ended: all, or those of a host."""
    if launch.identity is None:
        return {OPERATOR: frozenset(range(launch.agents))}
    return {speaker.name: frozenset(speaker.agents) for speaker in launch.identity.roster.speakers if speaker.agents}


def ends_heard(identity: OwnIdentity | None) -> Mapping[str, Set[int]]:
    """Return of which agents a computer hears from which other one that they have ended."""
    if identity is None:
        return {}
    others = (speaker for speaker in identity.roster.speakers if speaker.name != identity.name)
    return {other.name: frozenset(other.agents) for other in others if other.agents}


class GoneAgents:
    """Knows who has ended and left its vehicle on the ground, disarmed, as its supervisor says again and again.

    Args:
        vouchers: agents of which each sender may say so.
        known: of whom that was heard before; who said so may have ended too, and says nothing more.
    """

    def __init__(self, vouchers: Mapping[str, Set[int]], known: Collection[int] = ()) -> None:
        self._ends, self._known = VouchedEnds(vouchers), known
        self._heard: set[int] = set()
        self._began_us: int | None = None
        self._now_us = 0

    def receive(self, bus: Bus, now_us: int) -> None:
        """Take in what has arrived about ends."""
        self._now_us = now_us
        if self._began_us is None:
            self._began_us = now_us
        for sender, payload in bus.receive(ENDED):
            self._ends.take(sender, payload)

    def hear(self, agent: int) -> None:
        """Note that an agent speaks: it is another process than one that has ended."""
        self._heard.add(agent)

    def has(self, agent: int) -> bool:
        """Return whether an agent has ended, its vehicle is down, and no other process speaks for it."""
        listened_us = self._now_us - (self._now_us if self._began_us is None else self._began_us)
        if agent in self._heard or listened_us < _UNHEARD_US:
            return False
        return self._ends.is_down(agent, None) if self._ends.has_ended(agent, None) else agent in self._known


def list_keepers(identity: OwnIdentity | None) -> tuple[str, ...]:
    """Return the senders whose list of obstacles is heard here: an operator has to know all lists, to change them."""
    if identity is None:
        return (OPERATOR,)
    return identity.roster.names if identity.speaker.operator else list_setters(identity)


def list_setters(identity: OwnIdentity | None) -> tuple[str, ...]:
    """Return the senders whose list of obstacles a computer adopts by itself."""
    return (OPERATOR,) if identity is None else identity.roster.commanders(identity.name)


def view_address(launch: RunningLaunch) -> str:
    """Return the address of the live view.

    Raises:
        StartError: this launch has none.
    """
    if not launch.view:
        why = "it was started with telemetry.enabled = false, or just now, or its viewer has ended"
        raise StartError(f"view: {launch.run} serves none; {why}")
    return launch.view


def read_statuses(launch: RunningLaunch) -> dict[int, StatusMessage]:
    """Return the newest status of every agent that publishes one in time, by agent.

    Raises:
        StartError: the launch is ending.
    """
    return read_agents(launch)[0]


def read_agents(launch: RunningLaunch) -> tuple[dict[int, StatusMessage], frozenset[int]]:
    """Return the newest status of every agent that publishes one in time, and who has ended with its vehicle down.

    Raises:
        StartError: the launch is ending.
    """
    agents, gone = range(launch.agents), GoneAgents(vouchers(launch), launch.down)
    with joined(launch) as bus:
        statuses = _statuses(bus, agents, ANSWER_S, gone)
    if len(statuses) < launch.agents:
        refuse_ending(launch)
    return statuses, frozenset(agent for agent in agents if gone.has(agent))


def watch_statuses(launch: RunningLaunch, every_s: float) -> Iterator[dict[int, StatusMessage]]:
    """Yield the statuses that have arrived since the last time, by agent, until the launch ends."""
    gone = GoneAgents(vouchers(launch), launch.down)
    with joined(launch) as bus:
        while runs(launch):
            yield _statuses(bus, range(launch.agents), 0.0, gone)
            time.sleep(every_s)


def vector(key: str, text: str, problems: list[str]) -> tuple[float, float, float]:
    """Return the vector that `north,east,down` describes; what is wrong with it is added to `problems`."""
    try:
        north, east, down = (float(part) for part in text.split(","))
    except ValueError:
        problems.append(f"{key} {text!r}: write three numbers, north,east,down, for example 1.5,0,-2")
        return (0.0, 0.0, 0.0)
    return (north, east, down)


def _statuses(bus: Bus, agents: range, timeout_s: float, gone: GoneAgents) -> dict[int, StatusMessage]:
    """Return the newest status of each of `agents`, once all but those gone have published one or the time is up."""
    heard: dict[int, StatusMessage] = {}
    deadline_s = time.monotonic() + timeout_s
    while True:
        for sender, payload in bus.receive(STATUS):
            status = decode_status(payload)
            if status is not None and status.agent in agents and sender == agent_name(status.agent):
                heard[status.agent] = status
                gone.hear(status.agent)
        gone.receive(bus, monotonic_us())
        missing = [agent for agent in agents if agent not in heard and not gone.has(agent)]
        if not missing or time.monotonic() >= deadline_s:
            break
        time.sleep(0.02)
    return dict(sorted(heard.items()))


def as_json(statuses: dict[int, StatusMessage], indent: int | None = 2) -> str:
    """Return statuses as a JSON list with one object per agent; without `indent` in one line."""
    return json.dumps(  # ASCII: an agent's text may contain anything
        msgspec.to_builtins(list(statuses.values())), indent=indent
    )
