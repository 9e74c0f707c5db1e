"""Delivery of an operator's order: repeated until every agent asked has answered, and a stop is seen to begin.

An order is obeyed once, however often it is repeated: its number stays, only its stamp is new, so that it never becomes
too old (`swarmctl.bus.orders`). What an agent has not answered in time is unknown, and is said so.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import StatusMessage, decode_answer, decode_status
from swarmctl.bus.orders import EVERYBODY, order_messages
from swarmctl.bus.topics import ANSWER, COMMAND, STATUS, Topic
from swarmctl.core.operator_verbs import OPERATOR_VERBS, PEER, Answer, Order
from swarmctl.core.text import printable
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.orders.operator import ANSWER_S, HAS_ENDED, REPEAT_S, GoneAgents, joined, vouchers
from swarmctl.ops.running_launches import RunningLaunch, refuse_ending

_POLL_S = 0.02
_IS_DOWN = Phase.DONE.name  # what is obeyed in this phase asks nothing of a vehicle on the ground
_GONE = f"it {HAS_ENDED}"
_MOST_MESSAGES = 32  # of one repetition, so that they fit into an agent's ring


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """Describes what has become of an order to one agent."""

    agent: int
    verb: str
    answer: Answer | None  # None: it was silent
    phase: Phase | None = None  # by its newest status
    stopping: bool = True  # false: a stop it has accepted is not seen to have begun
    is_gone: bool = False  # it has ended, and left its vehicle on the ground

    @property
    def problem(self) -> str:
        """Return why the order is not known to be obeyed, or ""."""
        if self.answer is None and self.is_gone:
            return "" if _IS_DOWN in OPERATOR_VERBS[self.verb].phases else f"{agent_name(self.agent)}: {_GONE}"
        if self.answer is None:
            return f"{agent_name(self.agent)} did not answer within {ANSWER_S:.0f} s"
        if not self.answer.accepted:
            return f"{agent_name(self.agent)} refuses: {printable(self.answer.reason)}"
        if not self.stopping:
            where = "" if self.phase is None else f"; it is in {self.phase.name}"
            return f"{agent_name(self.agent)} accepts, but is not seen to {self.verb} within {ANSWER_S:.0f} s{where}"
        return ""

    @property
    def comes_to(self) -> str:
        """Return what an accepted order comes to, as the agent says it; "" where its name says it."""
        if self.answer is None and self.is_gone and not self.problem:
            return _GONE
        return printable(self.answer.reason) if self.answer is not None and self.answer.accepted else ""

    @property
    def line(self) -> str:
        """Return one line for the operator."""
        if self.answer is None:
            return self.problem or f"{agent_name(self.agent)}: {self.comes_to}"
        where = "" if self.phase is None else f", {self.phase.name}"
        comes_to = f"; {self.comes_to}" if self.comes_to else ""
        return self.problem or f"{agent_name(self.agent)} accepts{where}{comes_to}"

    def as_dict(self) -> dict[str, Any]:
        """Return the same for programs; `accepted` is None of an agent that was silent."""
        return {
            "agent": self.agent,
            "accepted": None if self.answer is None else self.answer.accepted,
            "phase": None if self.phase is None else self.phase.name,
            "problem": self.problem,
            "comes_to": self.comes_to,
        }


def numbered(order: Order) -> Order:
    """Return an order under a number of its own, by which its copies by several clocks are known to be one order."""
    return replace(order, number=secrets.randbits(53) | 1)


class OrderDelivery:
    """Keeps track of who has answered one order, and who is seen to obey it.

    Args:
        order: what is asked; it gets a number of its own.
        agents: numbers of the agents asked.
        everybody: whether these are all there are.
        gone: who has ended; nobody is known to have by default.
    """

    def __init__(self, order: Order, agents: Sequence[int], everybody: bool, gone: GoneAgents | None = None) -> None:
        self._gone = gone or GoneAgents({})
        self._order = numbered(order)
        self._is_stop = OPERATOR_VERBS[order.verb].is_stop
        self._agents, self._everybody = agents, everybody
        self._answers: dict[int, Answer] = {}
        self._statuses: dict[int, StatusMessage] = {}
        self._ahead_us: dict[int, int] = {}  # of each agent's clock over ours

    def receive(self, bus: Bus, utc_us: int) -> None:
        """Take in the answers and statuses that have arrived."""
        for sender, payload in bus.receive(STATUS):
            status = decode_status(payload)
            if status is not None and status.agent in self._agents and sender == agent_name(status.agent):
                self._statuses[status.agent] = status
                self._ahead_us[status.agent] = status.utc_us - utc_us
                self._gone.hear(status.agent)
        self._gone.receive(bus, utc_us)
        for sender, payload in bus.receive(ANSWER):
            message = decode_answer(payload)
            if message is None or message.agent not in self._agents or sender != agent_name(message.agent):
                continue
            if (message.number, message.verb) == (self._order.number, self._order.verb):
                self._answers[message.agent] = message.answer

    @property
    def open(self) -> list[int]:
        """Return the agents that the order has to be repeated to."""
        return [agent for agent in self._agents if not self._is_settled(agent)]

    def messages(self, utc_us: int) -> list[bytes]:
        """Return one repetition of the order, stamped now, to the agents that have not answered it."""
        asked = self.open
        if self._everybody and len(asked) == len(self._agents):
            return order_messages(self._order, EVERYBODY, utc_us, [utc_us + us for us in self._ahead_us.values()])
        found: list[bytes] = []
        for agent in asked:
            clocks_us = [utc_us + self._ahead_us[agent]] if agent in self._ahead_us else []
            found += order_messages(self._order, agent, utc_us, clocks_us)
        return found[:_MOST_MESSAGES]

    def replies(self) -> list[Reply]:
        """Return what is known of each agent asked."""
        return [
            Reply(
                agent=agent,
                verb=self._order.verb,
                answer=self._answers.get(agent),
                phase=Phase(self._statuses[agent].phase) if agent in self._statuses else None,
                stopping=self._is_stopping(agent),
                is_gone=self._gone.has(agent),
            )
            for agent in self._agents
        ]

    def _is_settled(self, agent: int) -> bool:
        answer = self._answers.get(agent)
        if answer is None:
            return self._gone.has(agent)
        return not answer.accepted or self._is_stopping(agent)

    def _is_stopping(self, agent: int) -> bool:
        """Return whether the order is no stop, or the agent is seen to land or to be on its way there."""
        status = self._statuses.get(agent)
        if not self._is_stop:
            return True
        return status is not None and status.phase >= Phase.GOTO_LAND and not status.held


def addressed(launch: RunningLaunch, order: Order, agents: Sequence[int]) -> list[int]:
    """Return the agents an order is for: those named, or all but one that it says has ended.

    Raises:
        ConfigError: there is no such agent, or it does not obey this computer.
        StartError: there is nobody to be told.
    """
    peer = order.arguments.get(PEER)
    if peer is not None and not float(peer).is_integer():
        raise ConfigError(order.verb, [f"--peer {peer:g}: expected the number of an agent"])
    if peer in agents:
        raise ConfigError(
            order.verb, [f"agent {peer:g} is not asked whether it has ended itself; name others, or none"]
        )
    named = [*agents, *([] if peer is None else [int(peer)])]
    unknown = [agent for agent in dict.fromkeys(named) if not 0 <= agent < launch.agents]
    if unknown:
        known = "agent 0 only" if launch.agents == 1 else f"agents 0 to {launch.agents - 1}"
        raise ConfigError(order.verb, [f"there is no agent {agent}; {launch.run} has {known}" for agent in unknown])
    obeying = obeying_agents(launch)
    if deaf := [agent for agent in dict.fromkeys(agents) if agent not in obeying]:
        raise ConfigError(order.verb, [f"agent {agent} does not obey: {no_operator(launch)}" for agent in deaf])
    asked = sorted(set(agents)) or [i for i in obeying if i != peer]
    if not asked:
        raise StartError(f"{order.verb}: {launch.run} has no other agent that could be told")
    return asked


def obeying_agents(launch: RunningLaunch) -> tuple[int, ...]:
    """Return the agents that obey operators of a launch: all, or a host's own where it has no operator's identity."""
    own = launch.identity
    return tuple(range(launch.agents)) if own is None or own.speaker.operator else own.speaker.agents


def no_operator(launch: RunningLaunch) -> str:
    """Return why agents of other computers do not obey, in words."""
    name = "" if launch.identity is None else launch.identity.name
    return f"{name} has no operator's identity. Say it at the station, or set operator = true in [[hosts]] of {name}"


def deliver(
    launch: RunningLaunch, order: Order, agents: Sequence[int], before: Sequence[tuple[Topic, bytes]] = ()
) -> list[Reply]:
    """Give an order to agents of a launch, or to all; returns what each has answered, at the latest after `ANSWER_S`.

    Args:
        launch: whose agents are asked.
        order: what is asked.
        agents: numbers of the agents asked; none: all.
        before: messages that have to be there before each repetition of the order.

    Raises:
        ConfigError: there is no such agent.
        StartError: the bus can't be joined, or the launch is ending and nobody is left to answer.
    """
    asked = addressed(launch, order, agents)
    gone = GoneAgents(vouchers(launch), launch.down)
    delivery = OrderDelivery(order, asked, len(asked) == launch.agents, gone)
    with joined(launch) as bus:
        began_s = repeated_s = time.monotonic()
        while delivery.open and time.monotonic() - began_s < ANSWER_S:
            if time.monotonic() >= repeated_s:
                repeated_s = time.monotonic() + REPEAT_S
                for topic, payload in before:
                    bus.publish(topic, payload)
                for message in delivery.messages(launch.utc_us()):
                    bus.publish(COMMAND, message)
            time.sleep(_POLL_S)
            delivery.receive(bus, launch.utc_us())
        _wait_for_phases(launch, delivery, bus)
    replies = delivery.replies()
    if not any(reply.answer for reply in replies):
        refuse_ending(launch)
    return replies


def _wait_for_phases(launch: RunningLaunch, delivery: OrderDelivery, bus: Bus) -> None:
    """Wait until every agent that has answered has published its phase too, at most two periods of the status."""
    until_s = time.monotonic() + 0.5
    while time.monotonic() < until_s and any(r.answer is not None and r.phase is None for r in delivery.replies()):
        time.sleep(_POLL_S)
        delivery.receive(bus, launch.utc_us())
