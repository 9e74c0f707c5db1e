"""Messages pass through others to those that don't hear their senders, unchanged, and only where they are missed."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.relay import RelayingBus, decode_relay, encode_relay, missed_by_peers
from swarmctl.bus.topics import PATH, RELAY, TOO_LONG, TRAJECTORY
from swarmctl.core.clock import SimClock
from swarmctl.core.trajectory import resting
from swarmctl.core.trajectory_message import Exclusions, Reach, TrajectoryMessage
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


def test_one_message_that_is_too_long_to_be_relayed_holds_up_no_other() -> None:
    """A trajectory message may be twice as long as what a relay carries."""
    long, fits = bytes(RELAY.max_bytes), bytes(RELAY.max_bytes - 12)
    assert decode_relay(encode_relay([(1, long), *MESSAGES])) == MESSAGES
    assert decode_relay(encode_relay([(1, fits), *MESSAGES])) == [(1, fits)], "to the last byte"
    assert decode_relay(encode_relay([(1, fits + b"\0"), *MESSAGES])) == MESSAGES


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


def test_who_has_the_last_message_of_an_agent_passes_that_on_after_a_relay_of_one_before() -> None:
    """It passed on the one before, too, and nobody who had missed the last one could hear it any more."""
    three = Three()
    for said in (b"before", b"last"):
        three.buses[0].publish(TRAJECTORY, said)
        three.receive(1)
    three.buses[2].publish(RELAY, encode_relay([(0, b"before")]))
    assert three.receive(1) == [], "it is known"
    three.buses[1].relay([0])
    assert three.receive(2) == [(agent_name(0), b"last")]


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
NEWEST_US = 9_990_000  # stamp of agent 2's newest message


def missed(
    heard: dict[int, tuple[int, int]],
    *,
    own: int = 0,
    helpers: tuple[int, ...] = (),
    received_us: int = NOW_US,
    lacked_us: int = 1_000_000,
    period_us: int = PERIOD_US,
    ahead_us: int = 0,
    far_us: int = 0,
    far: frozenset[int] = frozenset(),
    unheard: int = 0,
) -> list[int]:
    """Return what `own` passes on to agent 1, which says of whom it has `heard`; all but agent 1 have heard agent 2.

    Besides there are agents of which `own` has heard nothing.
    """
    known = dict.fromkeys((0, 1, 2, *helpers), (NEWEST_US, NOW_US))
    newest = {
        1: replace(message(1, sent_us=NOW_US + ahead_us, heard=heard), reach=Reach(far=far)),
        2: message(2, sent_us=NEWEST_US, heard={1: (NOW_US, NEWEST_US - 10_000)}),
        **{helper: message(helper, sent_us=NEWEST_US, heard=known) for helper in helpers},
    }
    arrivals_us = dict.fromkeys(newest, NOW_US) | {1: received_us}
    return missed_by_peers(
        own,
        newest,
        newest,
        arrivals_us,
        NOW_US,
        peer_count=len(newest) + unheard,
        period_us=period_us,
        far_us=far_us,
        lacked_us=lambda *_: lacked_us,
    )


@pytest.mark.parametrize(
    ("heard", "received_us", "found"),
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
    heard: dict[int, tuple[int, int]], received_us: int, found: list[int]
) -> None:
    """Peer 1 says what it has heard of peer 2, whose newest message is of 9.99 s; peer 2 hears peer 1."""
    assert missed(heard, received_us=received_us) == found


def test_clocks_that_differ_by_hours_make_no_difference() -> None:
    hours_us = 3_600_000_000 * 5
    assert missed({2: (9_980_000, NOW_US + hours_us - 20_000)}, ahead_us=hours_us) == []


def test_agents_that_send_less_often_are_helped_later() -> None:
    heard = {2: (9_890_000, 9_900_000)}
    assert missed(heard, period_us=20_000) == [2]
    assert missed(heard, period_us=40_000) == [], "two in a row may get lost"


def test_who_was_held_up_itself_is_not_missed() -> None:
    """Nothing of agent 2 has come for 190 ms, because it has sent nothing for as long but 20 ms ago."""
    heard = {2: (9_800_000, 9_810_000)}
    assert missed(heard, lacked_us=20_000) == []
    assert missed(heard, lacked_us=80_000) == [2], "control: what it lacks was sent long before it said so"


def test_who_is_far_is_helped_later_as_it_hears_less() -> None:
    """Nothing of agent 2, whose messages to all are 250 ms apart, has come for 0.6 s, and for 1.2 s."""
    half_a_second, longer = ({2: (NOW_US - us, NOW_US - us), 0: (NOW_US, NOW_US)} for us in (600_000, 1_200_000))
    lacked_us = 2_000_000
    assert missed(half_a_second, far_us=250_000, far=frozenset({2}), lacked_us=lacked_us) == []
    assert missed(longer, far_us=250_000, far=frozenset({2}), lacked_us=lacked_us) == [2]
    assert missed(half_a_second, far_us=250_000, lacked_us=lacked_us) == [2], "control: it is not far"


def test_of_whom_a_message_says_nothing_is_not_missed_if_it_is_far() -> None:
    assert missed({0: (NOW_US, NOW_US)}, far_us=250_000, far=frozenset({2})) == []
    assert missed({0: (NOW_US, NOW_US)}, far_us=250_000) == [2], "control: it has never been heard"


@pytest.mark.parametrize("far_us", [0, 250_000])
def test_as_many_as_are_known_here_need_not_be_the_same(far_us: int) -> None:
    """Agent 1 has heard agent 9, of which nothing is known here, and not agent 2."""
    assert missed({0: (NOW_US, NOW_US), 9: (NOW_US, NOW_US)}, far_us=far_us, unheard=1) == [2]


HELPERS = (0, 3, 4, 5, 6)


def those_who_help(heard: dict[int, tuple[int, int]]) -> list[int]:
    """Return which of them pass on agent 2's newest message to agent 1, which has `heard` so much."""
    return [own for own in HELPERS if 2 in missed(heard, own=own, helpers=tuple(i for i in HELPERS if i != own))]


@pytest.mark.parametrize(("silent_us", "helping"), [(90_000, 2), (130_000, 4), (170_000, 5), (70_000, 0)])
def test_two_help_at_once_and_the_others_only_if_that_does_not(silent_us: int, helping: int) -> None:
    heard = {2: (NEWEST_US - silent_us, NOW_US - silent_us)} | dict.fromkeys(HELPERS, (NOW_US, NOW_US))
    assert len(those_who_help(heard)) == helping


def test_those_help_first_whom_the_peer_hears_and_who_have_what_it_lacks() -> None:
    heard = {2: (NEWEST_US - 90_000, NOW_US - 90_000), 6: (NOW_US, NOW_US), 3: (NOW_US, NOW_US)}  # not 0, 4 and 5
    assert those_who_help(heard) == [3, 6]
    assert 2 in missed(heard, own=0, helpers=(6,)), "3 has not said that it has heard agent 2"


def test_who_helps_differs_from_agent_to_agent() -> None:
    """Of ten agents that one does not hear, each is passed on by others of the twenty that have heard it."""
    agents, lost, late = range(22), range(1, 11), (NEWEST_US - 90_000, NOW_US - 90_000)
    heard_all = dict.fromkeys(agents, (NEWEST_US, NOW_US))
    newest = {i: message(i, sent_us=NEWEST_US, heard=heard_all) for i in agents}
    newest[1] = message(1, sent_us=NOW_US, heard={i: late if i in lost else (NOW_US, NOW_US) for i in agents if i != 1})
    counts = []
    for own in set(agents) - set(lost):
        others = {i: said for i, said in newest.items() if i != own}
        args = (own, others, others, dict.fromkeys(others, NOW_US), NOW_US)
        counts.append(
            len(
                missed_by_peers(
                    *args, peer_count=len(others), period_us=PERIOD_US, far_us=0, lacked_us=lambda *_: 1_000_000
                )
            )
        )
    assert sum(counts) == 2 * (len(lost) - 1)
    assert max(counts) <= 5


@pytest.mark.parametrize("frozen_s", [0.1, 2.0, 60.0])
def test_nobody_passes_on_what_those_have_excluded_who_say_nothing_later_of_it(frozen_s: float) -> None:
    """All hear it again, directly; its lease ends as they say so no more, and each took all others for deaf to it."""
    agents, excluded, period_us, now_us = 6, 5, 20_000, 100_000_000
    frozen_us, stamps_us = now_us - round(frozen_s * 1e6), [now_us - 1000 - period_us * i for i in range(64)]
    heard = dict.fromkeys(range(agents), (now_us - period_us - 1000, now_us - period_us))
    said = {**heard, excluded: (frozen_us - 1000, frozen_us)}
    newest = {
        agent: builders.trajectory_message(
            agent=agent,
            sent_utc_us=now_us - 1000,
            committed=resting(np.zeros(3), 0, 100_000),
            heard={a: t for a, t in (heard if agent == excluded else said).items() if a != agent},
            exclusions=Exclusions(promised=frozenset() if agent == excluded else frozenset((excluded,))),
        )
        for agent in range(agents)
    }

    def relayed(own: int, peers: Mapping[int, TrajectoryMessage]) -> list[int]:
        return missed_by_peers(
            own,
            peers,
            peers,
            dict.fromkeys(peers, now_us),
            now_us,
            peer_count=agents - 1,
            period_us=period_us,
            far_us=0,
            lacked_us=lambda message, _, stamp_us: message.sent_utc_us - min(t for t in stamps_us if t > stamp_us),
        )

    others = [{a: message for a, message in newest.items() if a != own} for own in range(excluded)]
    assert [relayed(own, peers) for own, peers in enumerate(others)] == [[]] * excluded
    unsaid = {agent: replace(message, exclusions=Exclusions()) for agent, message in others[0].items()}
    assert relayed(0, unsaid) == [excluded], "control: who has excluded nobody is helped"
