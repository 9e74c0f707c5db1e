"""Messages pass through others to those that don't hear their senders, unchanged, and only where they are missed."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.relay import RelayingBus, decode_relay, encode_relay, missed_by_peers
from swarmctl.bus.topics import PATH, RELAY, TOO_LONG, TRAJECTORY
from swarmctl.core.clock import SimClock
from swarmctl.core.trajectory import resting
from swarmctl.core.trajectory_message import TrajectoryMessage
from tests import builders

MESSAGES = [(2, b"second"), (0, b""), (7, bytes(range(256)))]


def test_what_is_relayed_arrives_as_it_was_sent() -> None:
    assert decode_relay(encode_relay(MESSAGES)) == MESSAGES
    assert decode_relay(encode_relay([])) == []


def test_a_relay_never_exceeds_the_length_of_its_topic() -> None:
    many = [(i, bytes(RELAY.max_bytes // 3)) for i in range(4)]
    payload = encode_relay(many)
    assert len(payload) <= RELAY.max_bytes
    assert decode_relay(payload) == many[:2]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"SR",
        b"XX" + encode_relay(MESSAGES)[2:],
        b"SR\x02" + encode_relay(MESSAGES)[3:],
        encode_relay(MESSAGES)[:-1],
        encode_relay(MESSAGES) + b"\0",
        struct.pack("<2sBBII", b"SR", 1, 1, 2, 2**32 - 1),
    ],
    ids=["empty", "short", "magic", "version", "cut off", "too long", "length of a message"],
)
def test_nonsense_is_no_relay(payload: bytes) -> None:
    assert decode_relay(payload) is None


class Three:
    """Agents 0, 1 and 2 on a bus on which 0 and 2 don't hear each other."""

    def __init__(self) -> None:
        self.clock = SimClock()
        self.hub = LocalHub(self.clock.now_us)
        self.buses = [RelayingBus(self.hub.connect(agent_name(i)), [j for j in range(3) if j != i]) for i in range(3)]
        self.hub.cut(agent_name(0), agent_name(2))
        self.hub.cut(agent_name(2), agent_name(0))

    def receive(self, agent: int) -> list[tuple[str, bytes]]:
        self.clock.advance(20_000)
        return self.buses[agent].receive(TRAJECTORY)


def test_a_message_reaches_who_does_not_hear_its_sender_under_the_name_of_the_sender() -> None:
    three = Three()
    three.buses[0].publish(TRAJECTORY, b"from 0")
    assert three.receive(2) == [], "control: not directly"
    assert three.receive(1) == [(agent_name(0), b"from 0")]
    assert three.buses[1].relay([0]) > 0
    assert three.receive(2) == [(agent_name(0), b"from 0")]
    assert three.receive(0) == [], "nobody hears itself"


def test_what_is_known_already_is_not_delivered_again() -> None:
    three = Three()
    three.buses[0].publish(TRAJECTORY, b"from 0")
    three.receive(1)
    for _ in range(2):
        three.buses[1].relay([0])
    assert three.receive(2) == [(agent_name(0), b"from 0")]
    three.buses[1].relay([0])
    assert three.receive(2) == []


def test_who_knows_nothing_relays_nothing() -> None:
    three = Three()
    assert three.buses[1].relay([0, 2]) == 0
    assert three.receive(2) == []


def test_a_relay_that_can_not_be_read_is_told_of_its_sender_and_of_others_topics_nothing() -> None:
    three = Three()
    three.buses[1].publish(RELAY, b"nonsense")
    three.buses[1].publish(RELAY, encode_relay([(5, b"of nobody"), (2, b"of itself")]))
    assert three.receive(2) == [(agent_name(1), TOO_LONG)]
    assert three.buses[2].receive(PATH) == []


def message(agent: int, *, sent_us: int, heard: dict[int, tuple[int, int]]) -> TrajectoryMessage:
    return builders.trajectory_message(
        agent=agent, sent_utc_us=sent_us, committed=resting(np.zeros(3), 0, 100_000), heard=heard
    )


NOW_US, PERIOD_US = 10_000_000, 20_000


@pytest.mark.parametrize(
    ("heard", "received_us", "missed"),
    [
        ({2: (9_950_000, 9_960_000)}, NOW_US, []),
        ({2: (9_800_000, 9_810_000)}, NOW_US, [2]),
        ({2: (9_990_000, 9_810_000)}, NOW_US, []),
        ({}, NOW_US, [2]),
        ({}, NOW_US - 4_000_000, []),
    ],
    ids=["heard lately", "not lately", "not lately, but there is nothing newer", "never", "itself silent"],
)
def test_who_is_missed_follows_from_what_peers_say_they_have_heard(
    heard: dict[int, tuple[int, int]], received_us: int, missed: list[int]
) -> None:
    """Peer 1 says what it has heard of peer 2, whose newest message is of 9.99 s; peer 2 hears peer 1."""
    newest = {
        1: message(1, sent_us=NOW_US, heard=heard),
        2: message(2, sent_us=9_990_000, heard={1: (NOW_US, 9_980_000)}),
    }
    assert missed_by_peers(newest, NOW_US, {1: received_us, 2: NOW_US}, period_us=PERIOD_US) == missed


def test_clocks_that_differ_by_hours_make_no_difference() -> None:
    hours_us = 3_600_000_000 * 5
    newest = {
        1: message(1, sent_us=NOW_US + hours_us, heard={2: (9_980_000, NOW_US + hours_us - 20_000)}),
        2: message(2, sent_us=9_990_000, heard={1: (NOW_US + hours_us, 9_980_000)}),
    }
    assert missed_by_peers(newest, NOW_US, {1: NOW_US, 2: NOW_US}, period_us=PERIOD_US) == []


def test_agents_that_send_less_often_are_helped_later() -> None:
    newest = {
        1: message(1, sent_us=NOW_US, heard={2: (9_890_000, 9_900_000)}),
        2: message(2, sent_us=9_990_000, heard={1: (NOW_US, 9_980_000)}),
    }
    received_us = {1: NOW_US, 2: NOW_US}
    assert missed_by_peers(newest, NOW_US, received_us, period_us=20_000) == [2]
    assert missed_by_peers(newest, NOW_US, received_us, period_us=40_000) == [], "two in a row may get lost"
