"""An operator's order is repeated until each agent asked has answered; who refuses or is silent is named."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import AnswerMessage, EndedMessage, decode_command, encode_message
from swarmctl.bus.orders import Orders
from swarmctl.bus.refusals import Refusals
from swarmctl.bus.topics import ANSWER, COMMAND, ENDED, OPERATOR, STATUS
from swarmctl.core.operator_verbs import PEER, Order
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.orders.operator import GoneAgents
from swarmctl.ops.orders.order_delivery import OrderDelivery, Reply, addressed
from swarmctl.ops.running_launches import RunningLaunch
from tests import builders
from tests.benches.swarm_of_hosts import SwarmOfHosts

UTC_US = 1_700_000_000_000_000
LAUNCH = RunningLaunch("circle-1a", "unixsock-stream//x", 1, 0.0, 3, "runs/x")


class Scene:
    """An operator, and agents with real filters of orders: some refuse, and those who are `lost` hear nothing."""

    def __init__(
        self, verb: str, refusals: Mapping[int, str] | None = None, agents: int = 3, down: Collection[int] = ()
    ) -> None:
        self.ended: dict[int, EndedMessage] = {}  # agents that publish nothing, as their supervisor says
        self.now_us = UTC_US
        self.hub = LocalHub(lambda: self.now_us)
        self.bus = self.hub.connect(OPERATOR)
        self.agents = [self.hub.connect(agent_name(i)) for i in range(agents)]
        self.orders = [Orders(i, Refusals(lambda *_, **__: None)) for i in range(agents)]
        self.refusals = refusals or {}
        self.lost: set[int] = set()
        self.silent: set[int] = set()  # agents that hear and publish nothing, and of which nothing is said
        self.obeyed: list[int] = []
        self.phases = [Phase.TRACK] * agents
        self.lands = True
        gone = GoneAgents({"alpha": frozenset(range(agents))}, down)
        self.supervisor = self.hub.connect("alpha")
        self.delivery = OrderDelivery(Order(verb), range(agents), everybody=True, gone=gone)
        self.sent = 0

    def repeat(self, times: int = 1) -> None:
        for _ in range(times):
            for message in self.delivery.messages(self.now_us):
                self.sent += 1
                self.bus.publish(COMMAND, message)
            self.now_us += 100_000
            for i, bus in enumerate(self.agents):
                for sender, payload in bus.receive(COMMAND):
                    if i not in self.lost | self.silent and i not in self.ended:
                        self.take(i, sender, payload)
                if i not in self.ended and i not in self.silent:
                    self.publish(i)
            for end in self.ended.values():
                self.supervisor.publish(ENDED, encode_message(end))
            self.now_us += 100_000
            self.delivery.receive(self.bus, self.now_us)

    def take(self, i: int, sender: str, payload: bytes) -> None:
        if order := self.orders[i].take(sender, payload, self.now_us):
            self.orders[i].answer(order, self.refusals.get(i, ""))
            if i not in self.refusals:
                self.obeyed.append(i)
                if self.lands and order.verb == "land":
                    self.phases[i] = Phase.GOTO_LAND

    def publish(self, i: int) -> None:
        for answer in self.orders[i].due_answers():
            self.answer(i, i, answer.number, accepted=answer.accepted, reason=answer.reason)
        self.agents[i].publish(STATUS, encode_message(builders.status_message(agent=i, phase=self.phases[i])))

    def answer(self, sender: int, agent: int, number: int, accepted: bool = True, reason: str = "") -> None:
        message = AnswerMessage(
            agent=agent, boot_id=1, verb="hold", number=number, accepted=accepted, reason=reason, utc_us=self.now_us
        )
        verb = self.delivery.replies()[0].verb
        self.agents[sender].publish(ANSWER, encode_message(message).replace(b'"hold"', f'"{verb}"'.encode()))

    @property
    def problems(self) -> list[str]:
        return [reply.problem for reply in self.delivery.replies() if reply.problem]


def test_everybody_accepts() -> None:
    scene = Scene("hold")
    scene.repeat()
    assert scene.delivery.open == []
    assert [reply.line for reply in scene.delivery.replies()] == [f"agent-{i} accepts, TRACK" for i in range(3)]


def test_who_refuses_is_named_with_its_reason_and_not_asked_again() -> None:
    scene = Scene("hold", {1: "it is in STANDBY"})
    scene.repeat()
    assert scene.delivery.open == []
    assert scene.problems == ["agent-1 refuses: it is in STANDBY"]


def test_who_is_silent_is_asked_again_for_longer_than_an_order_is_valid_and_obeys_once() -> None:
    scene = Scene("hold")
    scene.lost = {2}
    scene.repeat(30)
    assert scene.delivery.open == [2]
    assert scene.problems == ["agent-2 did not answer within 5 s"]
    scene.lost = set()
    scene.repeat(3)
    assert scene.problems == []
    assert sorted(scene.obeyed) == [0, 1, 2]


def end_of(agent: int, *, is_down: bool) -> EndedMessage:
    return EndedMessage(agent=agent, boot_id=1, is_down=is_down)


def test_who_has_ended_with_its_vehicle_down_is_not_waited_for_and_fails_no_landing() -> None:
    scene = Scene("land")
    scene.ended = {1: end_of(1, is_down=True)}
    scene.repeat(10)
    assert scene.delivery.open == []
    assert scene.problems == []
    reply = scene.delivery.replies()[1]
    assert reply.line == "agent-1: it has ended, its vehicle is on the ground"
    assert reply.as_dict() == {
        "agent": 1,
        "accepted": None,
        "phase": None,
        "problem": "",
        "comes_to": "it has ended, its vehicle is on the ground",
    }


def test_who_was_known_to_have_ended_with_its_vehicle_down_fails_no_landing_unless_it_is_heard_otherwise() -> None:
    """Its host has ended too, and says nothing more."""
    scene = Scene("land", down=(1,))
    scene.silent = {1}
    scene.repeat(4)
    assert scene.delivery.open == [1], "another process of it may not have been heard yet"
    scene.repeat(6)
    assert (scene.delivery.open, scene.problems) == ([], [])
    scene.ended = {1: end_of(1, is_down=False)}
    scene.repeat()
    assert scene.delivery.open == [1]
    spoken = Scene("land", down=(1,))
    spoken.lost = {1}
    spoken.repeat(10)
    assert spoken.delivery.open == [1]


def test_who_has_ended_can_not_hold() -> None:
    scene = Scene("hold")
    scene.ended = {1: end_of(1, is_down=True)}
    scene.repeat(10)
    assert scene.delivery.open == []
    assert scene.problems == ["agent-1: it has ended, its vehicle is on the ground"]


def test_who_has_ended_and_may_be_in_the_air_is_asked_on_as_another_process_may_land_it() -> None:
    scene = Scene("land")
    scene.ended = {1: end_of(1, is_down=False)}
    scene.repeat(10)
    assert scene.delivery.open == [1]
    assert scene.problems == ["agent-1 did not answer within 5 s"]


def test_who_speaks_has_not_ended_whatever_is_said_of_a_process_before_it() -> None:
    scene = Scene("land")
    scene.lost = {1}
    scene.repeat()
    scene.ended = {1: end_of(1, is_down=True)}
    scene.repeat(10)
    assert scene.delivery.open == [1]
    assert scene.problems == ["agent-1 did not answer within 5 s"]


def test_a_lost_answer_is_given_again_and_the_order_is_obeyed_once() -> None:
    scene = Scene("hold")
    scene.hub.cut(agent_name(1), OPERATOR)
    scene.agents[1].publish = lambda *_: None  # type: ignore[method-assign]  # lost, not delayed
    scene.repeat(20)
    assert scene.delivery.open == [1]
    scene.hub.mend(agent_name(1), OPERATOR)
    del scene.agents[1].publish
    scene.repeat()
    assert scene.delivery.open == []
    assert sorted(scene.obeyed) == [0, 1, 2]


def test_a_stop_is_repeated_until_it_is_seen_to_begin() -> None:
    scene = Scene("land")
    scene.lands = False
    scene.repeat(3)
    assert scene.delivery.open == [0, 1, 2], "accepted, but none of them is on its way to land"
    assert scene.problems[0] == "agent-0 accepts, but is not seen to land within 5 s; it is in TRACK"
    assert scene.sent > 3
    scene.phases = [Phase.GOTO_LAND, Phase.LAND, Phase.DONE]
    scene.repeat()
    assert scene.delivery.open == []
    assert scene.problems == []


def test_an_answer_counts_only_under_its_senders_name_and_the_number_of_the_order() -> None:
    scene = Scene("hold")
    scene.lost = {0, 1, 2}
    scene.repeat()
    message = decode_command(scene.delivery.messages(scene.now_us)[0])
    assert message is not None
    scene.answer(0, 1, message.number)  # in the name of another
    scene.answer(2, 2, message.number + 1)  # to another order
    scene.repeat()
    assert scene.delivery.open == [0, 1, 2]
    scene.answer(1, 1, message.number)
    scene.repeat()
    assert scene.delivery.open == [0, 2]


def test_what_an_agent_answers_controls_no_terminal() -> None:
    scene = Scene("hold", {0: "\x1b]0;owned\x07"})
    scene.repeat()
    assert scene.problems == [r"agent-0 refuses: \x1b]0;owned\x07"]


def test_who_is_asked() -> None:
    assert addressed(LAUNCH, Order("hold"), []) == [0, 1, 2]
    assert addressed(LAUNCH, Order("hold"), [2, 0, 2]) == [0, 2]
    assert addressed(LAUNCH, Order("exclude", {PEER: 1.0}), []) == [0, 2], "it has ended"
    alone = RunningLaunch("alone-1a", "unixsock-stream//x", 1, 0.0, 1, "runs/x")
    with pytest.raises(StartError, match="no other agent"):
        addressed(alone, Order("exclude", {PEER: 0.0}), [])
    for wrong in (-1, 3):
        with pytest.raises(ConfigError, match=f"hold: there is no agent {wrong}; circle-1a has agents 0 to 2"):
            addressed(LAUNCH, Order("hold"), [0, wrong])
    with pytest.raises(ConfigError, match="there is no agent 9; circle-1a has agents 0 to 2"):
        addressed(LAUNCH, Order("exclude", {PEER: 9.0}), [])
    with pytest.raises(ConfigError, match="there is no agent 1; alone-1a has agent 0 only"):
        addressed(alone, Order("hold"), [1])
    with pytest.raises(ConfigError, match=r"--peer 1\.2: expected the number of an agent"):
        addressed(LAUNCH, Order("exclude", {PEER: 1.2}), [])
    with pytest.raises(ConfigError, match="agent 1 is not asked whether it has ended itself"):
        addressed(LAUNCH, Order("exclude", {PEER: 1.0}), [1])
    with pytest.raises(ConfigError) as caught:
        addressed(LAUNCH, Order("hold"), [7, 1, 9, 7])
    assert len(caught.value.problems) == 2, "each once"


def test_a_host_without_an_operators_identity_asks_its_own_agents_only() -> None:
    swarm = SwarmOfHosts.of(Path("nowhere"))
    at = {
        name: RunningLaunch("hosts-1a", "unixsock-stream//x", 1, 0.0, 3, "runs/x", "", swarm.identity(name))
        for name in ("alpha", "bravo", "station")
    }
    assert addressed(at["bravo"], Order("land"), []) == addressed(at["bravo"], Order("land"), [1]) == [1]
    assert addressed(at["alpha"], Order("land"), []) == addressed(at["station"], Order("land"), []) == [0, 1, 2]
    with pytest.raises(ConfigError, match="agent 2 does not obey: bravo has no operator's identity"):
        addressed(at["bravo"], Order("hold"), [1, 2])
    assert addressed(at["bravo"], Order("exclude", {PEER: 2.0}), []) == [1]


def test_a_repetition_to_many_fits_into_the_ring_of_each_agent() -> None:
    delivery = OrderDelivery(Order("hold"), range(90), everybody=False)
    assert len(delivery.messages(UTC_US)) <= COMMAND.ring // 2


def test_a_reply_without_a_status_says_no_phase() -> None:
    assert Reply(agent=1, verb="hold", answer=None).line == "agent-1 did not answer within 5 s"
