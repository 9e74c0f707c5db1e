"""Datagrams between computers: who is believed, which way they go, and what is left of them where frames are lost."""

from __future__ import annotations

import random
import struct
from collections import Counter
from collections.abc import Callable
from itertools import combinations, count

import pytest

from swarmctl.bus.network.datagram_links import MissedLinks
from swarmctl.bus.network.datagram_routes import BEAT_S, GONE_S, HEARD_S, HELD_S, TOO_LONG_TO_SEND, DatagramRoutes
from swarmctl.bus.network.datagrams import MOST_DATAGRAM_BYTES, OCCUPIED, DatagramChannel, Opened, route_of
from swarmctl.bus.network.hosts import HostParams, roster_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.refusals import FORGED, MALFORMED, REPLAYED

KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
HOSTS = tuple(
    HostParams(name=name, address=f"10.0.0.{number + 1}:7448", agents=(number,))
    for number, name in enumerate(("alpha", "bravo", "charlie"))
)
NAMES = tuple(host.name for host in HOSTS)
ADDRESSES = {host.name: (f"10.0.0.{number + 1}", 7449) for number, host in enumerate(HOSTS)}
STATION_ADDRESS = ("10.0.0.9", 50_000)
PATH, TICK = "run/agent-{}/path", "run/agent-{}/tick"


class Pair:
    """Two computers that share a key; both know the other's session unless they have not met."""

    def __init__(self, *, met: bool = True) -> None:
        self.a, self.b = (
            DatagramChannel(KEY, me=0, other=1, session=11),
            DatagramChannel(KEY, me=1, other=0, session=22),
        )
        if met:
            assert self.b.open(self.a.seal(b"hello")).wants_answer
            assert self.a.open(self.b.seal(b"hello", answer=True)).body == b"hello"
            assert self.b.open(self.a.seal(b"known")).body == b"known"


def test_what_is_sent_before_both_know_each_other_is_not_delivered_and_afterwards_it_is() -> None:
    pair = Pair(met=False)
    assert pair.b.open(pair.a.seal(b"path")) == Opened(wants_answer=True)
    assert pair.a.open(pair.b.seal(b"beat", answer=True)) == Opened(body=b"beat")
    assert pair.b.open(pair.a.seal(b"path")) == Opened(body=b"path")


def test_a_datagram_is_delivered_once_in_whatever_order_it_comes() -> None:
    pair = Pair()
    sent = [pair.a.seal(bytes((i,))) for i in range(100)]
    shuffled = random.Random(1).sample(sent, len(sent))
    assert sorted(pair.b.open(datagram).body for datagram in shuffled) == [bytes((i,)) for i in range(100)]
    assert {pair.b.open(datagram).refused for datagram in sent} == {REPLAYED}


def test_a_datagram_that_a_thousand_others_have_overtaken_is_refused() -> None:
    pair = Pair()
    late = pair.a.seal(b"late")
    for _ in range(1100):
        assert pair.b.open(pair.a.seal(b"x")).body
    assert pair.b.open(late).refused == REPLAYED


def test_whoever_changes_a_byte_or_has_another_key_is_refused() -> None:
    pair = Pair()
    datagram = pair.a.seal(b"path")
    for at in (5, 6, 14, 22, len(datagram) - 20, len(datagram) - 1):
        changed = bytearray(datagram)
        changed[at] ^= 1
        assert pair.b.open(bytes(changed)) in (Opened(refused=FORGED), Opened(refused=REPLAYED)), at
    stranger = DatagramChannel(OTHER_KEY, me=0, other=1, session=11)
    assert pair.b.open(stranger.seal(b"path")) == Opened(refused=FORGED)
    assert pair.b.open(pair.b.seal(b"own one, sent back")) == Opened(refused=FORGED)
    assert pair.b.open(datagram).body == b"path", "the true one is still delivered"


def test_what_was_recorded_before_either_was_started_again_is_not_believed() -> None:
    pair = Pair()
    recorded = [pair.a.seal(b"old") for _ in range(3)]
    restarted = DatagramChannel(KEY, me=1, other=0, session=33)
    assert restarted.open(recorded[0]) == Opened(wants_answer=True), "of another session of b"
    again = DatagramChannel(KEY, me=0, other=1, session=44)
    assert pair.b.open(again.seal(b"x")).wants_answer
    assert again.open(pair.b.seal(b"x", answer=True)).body
    assert pair.b.open(again.seal(b"new")).body == b"new"
    assert {pair.b.open(datagram).refused for datagram in recorded} == {REPLAYED}, "of an ended session of a"


def test_a_recorded_greeting_does_not_part_two_that_know_each_other() -> None:
    pair = Pair(met=False)
    greeting = pair.a.seal(b"hello")
    again = DatagramChannel(KEY, me=0, other=1, session=44)
    assert pair.b.open(again.seal(b"hello")).wants_answer
    assert again.open(pair.b.seal(b"hello", answer=True)).body
    assert pair.b.open(again.seal(b"path")).body
    assert pair.b.open(greeting).wants_answer
    assert again.open(pair.b.seal(b"x", answer=True)).refused == ""
    assert again.open(pair.b.seal(b"on")).body == b"on"
    assert pair.b.open(again.seal(b"on")).body == b"on"


@pytest.mark.parametrize("datagram", [b"", b"SD", b"X" * 100, bytes(MOST_DATAGRAM_BYTES + 1)])
def test_what_is_no_datagram_has_no_route(datagram: bytes) -> None:
    assert route_of(datagram) is None
    pair = Pair()
    newer = bytearray(pair.a.seal(b"x"))
    newer[2] += 1
    assert route_of(bytes(newer)) is None


class Net:
    """The computers of a swarm, and a network between them that loses what it is told to."""

    def __init__(self, *, relay: bool = True) -> None:
        self.roster, self.now_s = roster_of(HOSTS, relay=relay), 100.0
        self._pairs = {frozenset(pair): bytes((i,)) * 32 for i, pair in enumerate(combinations(self.roster.names, 2))}
        self.loses: Callable[[str, str], bool] = lambda _a, _b: False
        self.station = STATION_ADDRESS
        self.second = "second", ("10.0.0.11", 50_002)  # another station by mistake, once it is in `at`
        self.got: dict[str, list[tuple[str, bytes]]] = {}
        self.sent: list[tuple[str, str, bytes]] = []
        self.at = {name: self.new(name, number) for number, name in enumerate(self.roster.names, 1)}

    def new(self, name: str, session: int) -> DatagramRoutes:
        keys = [self._pairs.get(frozenset((name, other))) for other in self.roster.names]
        return DatagramRoutes(self.roster, name, keys, ADDRESSES, session=session)

    def carry(self, name: str, outgoing: list[tuple[bytes, tuple[str, int]]]) -> None:
        """Carry datagrams, and those that answer them."""
        where = {self.station: STATION} | {address: host for host, address in ADDRESSES.items()}
        where |= {address: second for second, address in [self.second] if second in self.at}
        source = (ADDRESSES | dict([self.second])).get(name, self.station)
        for datagram, address in outgoing:
            to = where.get(address, "nobody")
            if to == "nobody":
                continue
            self.sent.append((name, to, datagram))
            if not self.loses(name, to):
                taken = self.at[to].take(datagram, source, self.now_s)
                self.got.setdefault(to, []).extend(taken.messages)
                self.carry(to, taken.outgoing)

    def beat(self, times: int = 3) -> None:
        for _ in range(times):
            for name, routes in self.at.items():
                self.carry(name, routes.beat(self.now_s))
            self.now_s += BEAT_S

    def say(self, name: str, key: str, payload: bytes = b"path") -> dict[str, int]:
        """Return how often each computer is given a message."""
        self.got.clear()
        self.carry(name, self.at[name].send(key, payload, self.now_s))
        return {to: len(messages) for to, messages in self.got.items()}


def test_a_message_reaches_all_who_need_it_once() -> None:
    net = Net()
    assert net.say("alpha", PATH.format(0)) == {}, "nobody knows anybody"
    net.beat()
    assert net.say("alpha", PATH.format(0)) == {"bravo": 1, "charlie": 1, STATION: 1}
    assert net.got["bravo"] == [("run/agent-0/path", b"path")]
    assert net.say("alpha", TICK.format(0)) == {STATION: 1}, "hosts have no use for it"
    assert net.say("alpha", "run/agent-0/command") == {}, "links carry what has to arrive"
    assert net.say("alpha", PATH.format(1)) == {}, "not its agent"
    assert net.say("alpha", f"{'r' * 300}/agent-0/path") == {}, "no run has such a name"


def test_nobody_speaks_for_an_agent_of_another_computer() -> None:
    net = Net()
    net.beat()
    net.at["charlie"]._own = frozenset(("agent-1",))
    assert net.say("charlie", PATH.format(1)) == {"alpha": 0, "bravo": 0, STATION: 0}
    assert net.at["alpha"].refused == Counter({FORGED: 1})


@pytest.mark.parametrize("relay", [True, False])
@pytest.mark.parametrize("one_way", [True, False], ids=["one way", "both ways"])
def test_a_third_computer_passes_on_what_a_cut_link_does_not_carry(relay: bool, one_way: bool) -> None:
    net = Net(relay=relay)
    net.beat()
    net.loses = lambda a, b: (a, b) == ("alpha", "bravo") or (not one_way and (a, b) == ("bravo", "alpha"))
    net.beat(round(2 * HEARD_S / BEAT_S))
    heard = net.say("alpha", PATH.format(0))
    assert heard.get("bravo", 0) == int(relay)
    assert heard["charlie"] == 1
    net.loses = lambda _a, _b: False
    net.beat(round(2 * HEARD_S / BEAT_S))
    net.sent.clear()
    assert net.say("alpha", PATH.format(0)) == {"bravo": 1, "charlie": 1, STATION: 1}
    assert len(net.sent) == 3, "directly again"


@pytest.mark.parametrize(
    "lost_with", [{"alpha"}, {"bravo"}, {"alpha", "bravo", STATION}], ids=["is not heard", "hears it not", "has ended"]
)
def test_of_several_that_could_pass_it_on_one_that_can_is_asked(lost_with: set[str]) -> None:
    """Charlie, which is first in the list, has lost its link to one of both ends, or is gone; the station is not."""
    net = Net()
    net.beat()
    net.loses = lambda a, b: {a, b} == {"alpha", "bravo"} or ("charlie" in (a, b) and bool({a, b} & lost_with))
    net.beat(round(2 * HEARD_S / BEAT_S))
    assert net.say("alpha", PATH.format(0))["bravo"] == 1


def test_a_recorded_greeting_is_answered_where_the_host_is_configured_to_be() -> None:
    net = Net()
    [greeting] = [datagram for datagram, to in net.at["alpha"].beat(net.now_s) if to == ADDRESSES["bravo"]]
    taken = net.at["bravo"].take(greeting, ("10.0.0.66", 7449), net.now_s)
    assert [to for _, to in taken.outgoing] == [ADDRESSES["alpha"]]


@pytest.mark.parametrize("relay", [True, False])
def test_two_that_have_never_heard_each_other_meet_by_a_third_one(relay: bool) -> None:
    net = Net(relay=relay)
    net.loses = lambda a, b: {a, b} == {"alpha", "bravo"}
    net.beat(round(2 * HEARD_S / BEAT_S))
    assert net.say("alpha", PATH.format(0)).get("bravo", 0) == int(relay)
    assert net.say("bravo", PATH.format(1)).get("alpha", 0) == int(relay)


@pytest.mark.parametrize(
    ("relay", "inner_from", "passed_on"), [(True, 0, 1), (True, 1, 0), (False, 0, 0)], ids=["", "of another", "off"]
)
def test_what_is_passed_on_is_of_who_asks_for_it(relay: bool, inner_from: int, passed_on: int) -> None:
    """Alpha asks charlie to pass a datagram on to bravo."""
    net = Net(relay=relay)
    net.beat()
    inner = DatagramChannel(KEY, me=inner_from, other=1, session=5).seal(b"x")
    asked = net.at["alpha"]._links[2].channel.seal(struct.pack("<BQ", 2, 0) + inner)
    taken = net.at["charlie"].take(asked, ADDRESSES["alpha"], net.now_s)
    assert taken.outgoing == [(inner, ADDRESSES["bravo"])] * passed_on
    assert net.at["charlie"].refused.total() == 1 - passed_on


def test_nobody_is_asked_to_pass_anything_on_where_that_is_off() -> None:
    net = Net(relay=False)
    net.beat()
    net.loses = lambda a, b: {a, b} == {"alpha", "bravo"}
    net.beat(round(2 * HEARD_S / BEAT_S))
    net.sent.clear()
    net.say("alpha", PATH.format(0))
    assert sorted(to for _, to, _ in net.sent) == ["bravo", "charlie", STATION]


def test_who_passes_on_can_not_read_it() -> None:
    net = Net()
    net.beat()
    net.loses = lambda a, b: {a, b} == {"alpha", "bravo"}
    net.beat(round(2 * HEARD_S / BEAT_S))
    net.say("alpha", PATH.format(0), b"secret")
    assert net.got["bravo"] == [("run/agent-0/path", b"secret")]
    assert not any(b"secret" in datagram for _, _, datagram in net.sent)


def test_one_that_is_started_again_is_heard_again_at_once() -> None:
    net = Net()
    net.beat()
    net.at["bravo"] = net.new("bravo", 77)
    net.beat(2)
    assert net.say("bravo", PATH.format(1)) == {"alpha": 1, "charlie": 1, STATION: 1}
    assert net.say("alpha", PATH.format(0))["bravo"] == 1


def test_the_station_is_told_where_it_was_heard_and_nothing_once_it_is_gone() -> None:
    net = Net()
    net.beat()
    net.loses = lambda a, _b: a == STATION
    net.now_s += GONE_S
    net.sent.clear()
    net.say("alpha", PATH.format(0))
    assert STATION not in {to for _, to, _ in net.sent}


def test_a_station_that_is_started_again_elsewhere_is_told_there() -> None:
    net = Net()
    net.beat()
    net.now_s += HELD_S  # in which the one before would still be there
    net.at[STATION] = net.new(STATION, 88)
    net.station = ("10.0.0.10", 50_001)
    net.beat()
    assert net.say("alpha", TICK.format(0)) == {STATION: 1}


@pytest.mark.parametrize("relay", [True, False])
def test_a_second_station_takes_nothing_from_the_first_and_who_was_cut_off_comes_back(relay: bool) -> None:
    """The first one was silenced for good, without a word, also once the second had ended."""
    net, sessions = Net(relay=relay), count(100)

    def heard_after(seconds: float) -> dict[str, int]:
        for _ in range(round(seconds / BEAT_S)):
            for name in {STATION, "second"} & net.at.keys():
                if net.at[name].is_cut_off(net.now_s):
                    net.at[name].begin_anew(next(sessions), net.now_s)
            net.beat(1)
        return net.say("alpha", TICK.format(0))

    assert heard_after(1.0) == {STATION: 1}
    net.at["second"] = net.new(STATION, 88)
    assert heard_after(2.0 * GONE_S) == {STATION: 1}
    assert net.at["alpha"].refused[OCCUPIED] > 0
    net.loses = lambda a, b: STATION in (a, b)
    assert heard_after(2.0 * HELD_S) == {"second": 1}, "the first one's network is cut"
    net.loses = lambda _a, _b: False
    assert heard_after(2.0 * GONE_S) == {"second": 1}
    del net.at["second"]
    assert heard_after(GONE_S) == {STATION: 1}


def test_negative_control_a_station_that_does_not_begin_anew_stays_cut_off() -> None:
    net = Net()
    net.beat()
    net.loses = lambda a, b: STATION in (a, b)
    net.now_s += HELD_S
    net.at["second"] = net.new(STATION, 88)
    net.beat()
    net.loses = lambda _a, _b: False
    del net.at["second"]
    net.beat(200)
    assert net.say("alpha", TICK.format(0)) == {}


def test_half_of_all_datagrams_lost_leaves_half_of_the_messages() -> None:
    net, chance = Net(relay=False), random.Random(3)
    net.loses = lambda _a, _b: chance.random() < 0.5
    net.beat(20)
    arrived = Counter[str]()
    for number in range(400):
        if number % 5 == 0:
            net.beat(1)
        arrived.update(net.say("alpha", PATH.format(0)))
    assert 150 < arrived["bravo"] < 250


@pytest.mark.parametrize(
    "body", [b"", b"\xff", b"\x10run/agent-0/pat", b"\x10r\xfcn/agent-0/path", b"\x05a/b/c", b"\xffrun/agent-0/path"]
)
def test_a_body_that_names_no_topic_is_refused(body: bytes) -> None:
    net = Net()
    net.beat()
    link = next(iter(net.at["bravo"]._links.values()))
    assert net.at["bravo"]._message(link, body).messages == ()
    assert net.at["bravo"].refused == Counter({MALFORMED: 1})


@pytest.mark.parametrize("relayed", [False, True])
def test_what_is_shorter_than_any_body_is_refused_and_does_not_count_as_heard(relayed: bool) -> None:
    net = Net()
    net.beat()
    net.now_s += HEARD_S
    short = net.at["alpha"]._links[1].channel.seal(b"\x01", relayed=relayed)
    assert net.at["bravo"].take(short, ADDRESSES["alpha"], net.now_s).messages == ()
    assert net.at["bravo"].refused == Counter({MALFORMED: 1})
    assert net.at["bravo"]._mask(net.now_s) == 0


def test_a_stranger_s_datagrams_are_counted_and_passed_on_to_nobody() -> None:
    net = Net()
    net.beat()
    stranger = DatagramChannel(OTHER_KEY, me=0, other=1, session=5)
    for datagram in (
        b"junk",
        stranger.seal(b"x" * 20),
        DatagramChannel(OTHER_KEY, me=0, other=60, session=5).seal(b"x"),
    ):
        taken = net.at["bravo"].take(datagram, ("10.0.0.66", 1), net.now_s)
        assert (taken.messages, taken.outgoing) == ((), [])
    assert net.at["bravo"].refused == Counter({MALFORMED: 1, FORGED: 2})


def test_a_link_that_is_missed_for_seconds_is_told_of_once_and_again_after_there_was_one() -> None:
    missed = MissedLinks()
    assert missed.update({"bravo", "charlie"}, {"charlie"}, 0.0) == ()
    assert missed.update({"bravo", "charlie"}, {"charlie"}, 4.9) == ()
    assert missed.update({"bravo", "charlie"}, {"charlie"}, 5.0) == ("bravo",)
    assert missed.update({"bravo", "charlie"}, {"charlie"}, 6.0) == (), "it has been told"
    assert missed.update({"bravo"}, {"bravo"}, 7.0) == ()
    assert missed.update({"bravo"}, set(), 8.0) == ()
    assert missed.update(set(), set(), 12.0) == (), "it is not heard: it may be off"
    assert missed.update({"bravo"}, set(), 13.0) == ()
    assert missed.update({"bravo"}, set(), 18.0) == ("bravo",)


def test_a_message_too_long_for_a_datagram_is_counted() -> None:
    net = Net()
    net.beat()
    assert net.say("alpha", PATH.format(0), bytes(70_000)) == {}
    assert net.at["alpha"].refused == Counter({TOO_LONG_TO_SEND: 1})
