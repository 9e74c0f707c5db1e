"""Operators' orders are valid for seconds and obeyed once; the newest one counts, whatever clock stamps it."""

from __future__ import annotations

import pytest

from swarmctl.bus.messages.json_messages import CommandMessage, decode_command, encode_message
from swarmctl.bus.orders import EVERYBODY, MAX_LEAD_US, VALID_US, Orders, order_messages
from swarmctl.bus.refusals import Refusals
from swarmctl.bus.topics import OPERATOR
from swarmctl.core.operator_verbs import Answer, Order

NOW_US = 1_700_000_000_000_000


class Agent3:
    """Agent 3 and the orders it obeys."""

    def __init__(self) -> None:
        self.refusals = Refusals(lambda *_, **__: None)
        self.orders = Orders(3, self.refusals)

    def obeys(self, verb: str, stamp_us: int, now_us: int = NOW_US, agent: int = EVERYBODY) -> bool:
        payload = encode_message(CommandMessage(verb, agent, stamp_us))
        return self.orders.take(OPERATOR, payload, now_us) == Order(verb)


@pytest.mark.parametrize("verb", ["hold", "resume", "land", "rtl"])
def test_an_order_is_valid_for_two_seconds(verb: str) -> None:
    for stamp_us, reason in (
        (0, "stale_order"),
        (NOW_US - 2_000_001, "stale_order"),
        (NOW_US + MAX_LEAD_US + 1, "future_order"),
        (2**62, "future_order"),
    ):
        agent = Agent3()
        assert not agent.obeys(verb, stamp_us)
        assert agent.refusals.by_reason == {reason: 1}
        assert agent.refusals.alert(NOW_US) == f"command of operator refused: {reason}"
    for stamp_us in (NOW_US - 2_000_000, NOW_US, NOW_US + MAX_LEAD_US):
        assert Agent3().obeys(verb, stamp_us)


def test_an_order_that_is_repeated_is_obeyed_once_and_alarms_nobody() -> None:
    agent = Agent3()
    assert [agent.obeys("hold", NOW_US, NOW_US + 200_000 * i) for i in range(5)] == [True, *[False] * 4]
    assert agent.refusals.by_reason == {"replayed": 4}
    assert agent.refusals.alert(NOW_US + 1_000_000) == ""


def test_the_newest_order_counts_in_whatever_sequence_they_arrive() -> None:
    agent = Agent3()
    assert agent.obeys("hold", NOW_US)
    assert agent.obeys("resume", NOW_US + 300_000, NOW_US + 400_000)
    assert not agent.obeys("hold", NOW_US, NOW_US + 500_000)
    assert not agent.obeys("rtl", NOW_US + 200_000, NOW_US + 500_000)
    assert agent.refusals.by_reason == {"superseded_order": 2}


def test_nothing_holds_up_a_landing() -> None:
    agent = Agent3()
    assert agent.obeys("hold", NOW_US + MAX_LEAD_US)
    assert agent.obeys("land", NOW_US)
    assert not agent.obeys("resume", NOW_US + MAX_LEAD_US - 1), "the hold is newer still"


def test_orders_to_other_agents_are_ignored() -> None:
    agent = Agent3()
    assert not agent.obeys("hold", NOW_US + 1, agent=2)
    assert agent.obeys("hold", NOW_US, agent=3)
    assert agent.refusals.total == 0
    assert agent.orders.take(OPERATOR, b"{}", NOW_US) is None
    assert agent.refusals.by_reason == {"malformed": 1}


@pytest.mark.parametrize("step_us", [0, 400_000, 3_600_000_000, -3_600_000_000])
def test_agents_that_have_not_followed_a_step_of_utc_yet_obey_all_the_same(step_us: int) -> None:
    operators_us, agents_us = NOW_US + step_us, [NOW_US, NOW_US + 1000, NOW_US - 1000]
    messages = order_messages(Order("land"), EVERYBODY, operators_us, agents_us)
    assert len(messages) == (1 if abs(step_us) < 500_000 else 2)
    for now_us in agents_us:
        agent = Orders(0, Refusals(lambda *_, **__: None))
        assert Order("land") in [agent.take(OPERATOR, payload, now_us) for payload in messages]


def test_a_forged_clock_makes_no_order_invalid() -> None:
    payloads = order_messages(Order("land"), 0, NOW_US, [0, 2**62])
    stamps_us = [message.utc_us for message in map(decode_command, payloads) if message is not None]
    assert stamps_us == [NOW_US, 0, 2**62]


NUMBER = 77


def numbered(verb: str, stamp_us: int, number: int = NUMBER) -> bytes:
    return encode_message(CommandMessage(verb, EVERYBODY, stamp_us, {}, number))


def test_a_numbered_order_is_obeyed_once_under_newer_stamps_and_answered_every_time() -> None:
    agent = Agent3()
    order = agent.orders.take(OPERATOR, numbered("hold", NOW_US), NOW_US)
    assert order == Order("hold", {}, NUMBER)
    agent.orders.answer(order, "")
    assert agent.orders.due_answers() == [Answer("hold", NUMBER, True)]
    assert agent.obeys("resume", NOW_US + 300_000, NOW_US + 300_000)
    for later_us in (400_000, 5_000_000):
        assert agent.orders.take(OPERATOR, numbered("hold", NOW_US + later_us), NOW_US + later_us) is None
        assert agent.orders.due_answers() == [Answer("hold", NUMBER, True)]
    assert agent.orders.due_answers() == []
    assert agent.refusals.alert(NOW_US + 5_000_000) == ""
    assert agent.obeys("hold", NOW_US + 4_000_000, NOW_US + 5_000_000), "repetitions make no later order too old"


def test_a_refusal_is_answered_with_its_reason_and_a_superseded_order_too() -> None:
    agent = Agent3()
    order = agent.orders.take(OPERATOR, numbered("hold", NOW_US), NOW_US)
    assert order is not None
    agent.orders.answer(order, "it is in STANDBY")
    assert agent.orders.due_answers() == [Answer("hold", NUMBER, False, "it is in STANDBY")]
    assert agent.orders.take(OPERATOR, numbered("rtl", NOW_US - 1, 78), NOW_US) is None
    assert agent.orders.due_answers() == [Answer("rtl", 78, False, "a newer order was obeyed")]


def test_neither_an_order_from_another_time_nor_one_without_a_number_is_answered() -> None:
    agent = Agent3()
    assert agent.orders.take(OPERATOR, numbered("hold", NOW_US - VALID_US - 1), NOW_US) is None
    assert agent.obeys("hold", NOW_US)
    agent.orders.answer(Order("hold"), "")
    assert not agent.obeys("hold", NOW_US)
    assert not agent.obeys("rtl", NOW_US - 1), "superseded"
    assert agent.orders.due_answers() == []


def test_one_number_with_two_contents_is_refused() -> None:
    agent = Agent3()
    assert agent.orders.take(OPERATOR, numbered("hold", NOW_US), NOW_US) is not None
    assert agent.orders.take(OPERATOR, numbered("land", NOW_US + 1), NOW_US) is None
    assert agent.refusals.by_reason == {"sequence": 1}


def test_many_numbered_orders_are_not_kept_for_ever() -> None:
    agent = Agent3()
    for number in range(1, 1000):
        order = agent.orders.take(OPERATOR, numbered("hold", NOW_US + number, number), NOW_US)
        assert order is not None
        agent.orders.answer(order, "")
        agent.orders.due_answers()
    assert len(agent.orders._numbered) == len(agent.orders._answers) == 64


def far_copies(operators_us: int, agents_us: int, number: int = NUMBER) -> list[bytes]:
    """The copies of one order by the clocks of operator and agent, in the order in which they are sent."""
    return order_messages(Order("hold", {}, number), EVERYBODY, operators_us, [agents_us])


@pytest.mark.parametrize("step_us", [600_000, 3_600_000_000, -3_600_000_000])
def test_the_copy_by_an_operators_other_clock_alarms_nobody(step_us: int) -> None:
    agent = Agent3()
    obeyed = []
    for later_us in range(0, 5_000_000, 200_000):
        copies = far_copies(NOW_US + step_us + later_us, NOW_US + later_us)
        copies = copies[:1] if later_us == 0 else copies  # before the operator has heard the agent's clock
        obeyed += [agent.orders.take(OPERATOR, payload, NOW_US + later_us) for payload in copies]
        agent.orders.refuse_misdated(NOW_US + later_us)
        assert agent.refusals.alert(NOW_US + later_us) == "", later_us
    assert [order for order in obeyed if order is not None] == [Order("hold", {}, NUMBER)]
    assert set(agent.refusals.by_reason) == {"replayed"}, "counted all the same"


@pytest.mark.parametrize(("step_us", "reason"), [(600_000, "future_order"), (-3_600_000_000, "stale_order")])
def test_an_order_of_another_time_that_no_copy_explains_alarms_after_two_seconds(step_us: int, reason: str) -> None:
    agent = Agent3()
    (copy,) = order_messages(Order("hold", {}, NUMBER), EVERYBODY, NOW_US + step_us, [])
    for _ in range(3):
        assert agent.orders.take(OPERATOR, copy, NOW_US) is None
    agent.orders.refuse_misdated(NOW_US + VALID_US)
    assert agent.refusals.total == 0
    agent.orders.refuse_misdated(NOW_US + VALID_US + 1)
    assert agent.refusals.by_reason == {reason: 3}
    assert agent.refusals.alert(NOW_US + VALID_US + 1) == f"command of operator refused: {reason}"
    assert agent.orders.take(OPERATOR, numbered("land", NOW_US + 1), NOW_US) is not None, "it was never obeyed"


def test_many_orders_of_another_time_are_not_kept_for_ever() -> None:
    agent = Agent3()
    for number in range(1, 1000):
        agent.orders.take(OPERATOR, numbered("hold", 0, number), NOW_US)
    assert agent.refusals.by_reason == {"stale_order": 999 - 64}
    assert len(agent.orders._misdated) == 64
