"""A bus in memory whose participants do not all reach each other: who receives what, and who sees whose token when."""

from __future__ import annotations

import pytest

from swarmctl.bus.bus import DEFAULT_LEASE_MS
from swarmctl.bus.local.hub import LocalBus, LocalHub
from swarmctl.bus.topics import COMMAND, PATH, TOPICS, Topic
from swarmctl.core.clock import SimClock

A, B, C, D, OPERATOR = "agent-0", "agent-1", "agent-2", "agent-3", "operator"
NAMES = (A, B, C, D, OPERATOR)
GROUPS = (frozenset({A, B}), frozenset({C, D}))
EVERYBODY = frozenset(NAMES)
LEASE_US = 1000 * DEFAULT_LEASE_MS


class Network:
    """Four agents and an operator on one hub."""

    def __init__(self) -> None:
        self.clock = SimClock()
        self.hub = LocalHub(self.clock.now_us)
        self.buses = {name: self.hub.connect(name) for name in NAMES}

    def reached(self, topic: Topic, *, after_us: int = 1) -> set[tuple[str, str]]:
        """Let everybody publish once; return (sender, receiver) of all that arrived, older messages included."""
        for name, bus in self.buses.items():
            bus.publish(topic, name.encode())
        return self.received(topic, after_us=after_us)

    def received(self, topic: Topic, *, after_us: int = 1) -> set[tuple[str, str]]:
        self.clock.advance(after_us)
        return {(sender, name) for name, bus in self.buses.items() for sender, _ in bus.receive(topic)}

    def rejoin(self, name: str) -> LocalBus:
        self.buses[name].close()
        self.buses[name] = self.hub.connect(name)
        return self.buses[name]

    def alive(self, name: str) -> frozenset[str]:
        return self.buses[name].alive()

    def arrivals(self, name: str) -> dict[str, int]:
        return dict(self.buses[name].arrivals())


ALL_PAIRS = {(sender, receiver) for sender in NAMES for receiver in NAMES if sender != receiver}
ACROSS = {(sender, receiver) for one, other in (GROUPS, GROUPS[::-1]) for sender in one for receiver in other}


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_groups_do_not_receive_each_other_and_the_operator_reaches_everybody(topic: Topic) -> None:
    network = Network()
    network.hub.split(GROUPS)
    assert network.reached(topic) == ALL_PAIRS - ACROSS


def test_at_heal_the_reliable_messages_arrive_once_and_in_order_and_the_others_are_lost() -> None:
    network = Network()
    network.hub.split(GROUPS)
    for topic in (PATH, COMMAND):
        network.buses[A].publish(topic, b"1")
        network.buses[A].publish(topic, b"2")
    network.clock.advance(1)
    assert network.buses[B].receive(COMMAND) == [(A, b"1"), (A, b"2")]
    assert network.buses[C].receive(COMMAND) == []
    network.hub.heal()
    network.clock.advance(1)
    assert network.buses[B].receive(COMMAND) == []
    assert network.buses[C].receive(COMMAND) == network.buses[D].receive(COMMAND) == [(A, b"1"), (A, b"2")]
    assert network.buses[C].receive(PATH) == []
    assert network.reached(PATH) == ALL_PAIRS


def test_a_message_under_way_crosses_a_split() -> None:
    network = Network()
    network.buses[A].publish(PATH, b"before")
    network.hub.split(GROUPS)
    network.clock.advance(1)
    assert network.buses[C].receive(PATH) == [(A, b"before")]


def test_tokens_of_the_other_group_vanish_after_the_lease_and_reappear_at_heal() -> None:
    network = Network()
    network.hub.split(GROUPS)
    network.clock.advance(LEASE_US - 1)
    assert all(network.alive(name) == EVERYBODY for name in NAMES)
    network.clock.advance(1)
    assert network.alive(A) == network.alive(B) == {A, B, OPERATOR}
    assert network.alive(C) == network.alive(D) == {C, D, OPERATOR}
    assert network.alive(OPERATOR) == EVERYBODY
    assert network.arrivals(A) == dict.fromkeys(NAMES, 1)
    network.hub.heal()
    assert all(network.alive(name) == EVERYBODY for name in NAMES)
    assert network.arrivals(A) == {A: 1, B: 1, C: 2, D: 2, OPERATOR: 1}
    assert network.arrivals(D) == {A: 2, B: 2, C: 1, D: 1, OPERATOR: 1}
    assert network.arrivals(OPERATOR) == dict.fromkeys(NAMES, 1)


def test_a_split_shorter_than_the_lease_is_not_seen_in_the_tokens() -> None:
    network = Network()
    network.hub.split(GROUPS)
    network.clock.advance(LEASE_US - 1)
    network.hub.heal()
    network.clock.advance(LEASE_US)
    assert all(network.alive(name) == EVERYBODY for name in NAMES)
    assert all(network.arrivals(name) == dict.fromkeys(NAMES, 1) for name in NAMES)


def test_who_leaves_and_joins_is_seen_at_once_in_the_own_group_and_by_the_others_at_heal() -> None:
    network = Network()
    network.hub.split(GROUPS)
    network.buses[A].close()
    assert network.alive(B) == EVERYBODY - {A}
    assert network.alive(C) == EVERYBODY, "nobody can tell it"
    network.rejoin(D)
    assert network.arrivals(C)[D] == 2
    assert network.arrivals(B)[D] == 1
    network.hub.heal()
    assert network.alive(C) == EVERYBODY - {A}
    assert network.arrivals(B) == dict.fromkeys(NAMES, 1) | {D: 2}


def test_who_joins_a_split_network_sees_its_group_only() -> None:
    network = Network()
    network.hub.split(GROUPS)
    newcomer = network.rejoin(A)
    assert newcomer.alive() == {A, B, OPERATOR}
    network.hub.heal()
    assert newcomer.alive() == EVERYBODY
    assert dict(newcomer.arrivals()) == dict.fromkeys(NAMES, 1)


def test_another_split_replaces_the_first_and_the_lease_of_those_still_apart_runs_on() -> None:
    network = Network()
    network.hub.split(GROUPS)
    network.buses[A].publish(COMMAND, b"x")
    network.clock.advance(LEASE_US - 1)
    network.hub.split((frozenset({A, C}), frozenset({B, D})))
    assert network.received(COMMAND) == {(A, B), (A, C), (A, OPERATOR)}
    assert network.alive(A) == {A, B, C, OPERATOR}
    network.clock.advance(LEASE_US - 1)
    assert network.alive(A) == {A, C, OPERATOR}
    network.hub.heal()
    assert network.received(COMMAND) == {(A, D)}


def test_a_failure_during_a_split_ends_before_it() -> None:
    network = Network()
    network.hub.split(GROUPS)
    network.hub.fail()
    assert network.reached(COMMAND) == set()
    network.clock.advance(LEASE_US)
    assert all(network.alive(name) == frozenset() for name in NAMES)
    network.hub.recover()
    assert network.received(COMMAND) == ALL_PAIRS - ACROSS
    assert network.alive(A) == {A, B, OPERATOR}
    network.hub.heal()
    assert network.received(COMMAND) == ACROSS
    assert network.arrivals(A) == dict.fromkeys(NAMES, 2)


def test_a_name_in_two_groups_is_refused_and_nothing_changes() -> None:
    network = Network()
    with pytest.raises(ValueError, match="agent-1"):
        network.hub.split((frozenset({A, B}), frozenset({B, C})))
    assert network.reached(PATH) == ALL_PAIRS


def test_a_cut_stops_one_direction_and_leaves_the_tokens() -> None:
    network = Network()
    network.hub.cut(A, B)
    assert network.reached(PATH, after_us=2 * LEASE_US) == ALL_PAIRS - {(A, B)}
    assert network.reached(COMMAND) == ALL_PAIRS - {(A, B)}
    assert network.alive(B) == EVERYBODY
    network.hub.mend(A, B)
    assert network.received(COMMAND) == {(A, B)}
    assert network.received(PATH) == set()
    assert network.reached(PATH) == ALL_PAIRS
    assert network.arrivals(B) == dict.fromkeys(NAMES, 1)


def test_a_cut_outlasts_a_split() -> None:
    network = Network()
    network.hub.cut(A, C)
    network.hub.split(GROUPS)
    network.hub.heal()
    assert network.reached(PATH) == ALL_PAIRS - {(A, C)}
