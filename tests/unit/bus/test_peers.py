"""Acceptance of peers' paths, and the in-memory bus of lockstep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LEASE_US, LocalBus, LocalHub
from swarmctl.bus.local.links import Impairments
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.peer_clocks import PeerClocks
from swarmctl.bus.peers import PeerPaths
from swarmctl.bus.refusals import Refusals
from swarmctl.bus.senders import Presence
from swarmctl.bus.topics import COMMAND, PATH, TICK, TOO_LONG
from swarmctl.core.clock import SimClock
from tests import builders

NOW_US = 1_700_000_000_000_000


def payload(agent: int = 1, boot_id: int = 7, seq: int = 1, t0_utc_us: int = NOW_US) -> bytes:
    return encode_path(
        builders.predicted_path(agent=agent, boot_id=boot_id, seq=seq, t0_utc_us=t0_utc_us, pos_ned_m=np.zeros((5, 3)))
    )


class Store:
    """Paths of agents 1 and 2 as agent 0 receives them."""

    def __init__(self) -> None:
        self.hub = LocalHub(lambda: 0)
        self.presence = Presence(self.hub.connect("agent-0"))
        self.refusals = Refusals(lambda *_, **__: None)
        self.paths = PeerPaths([1, 2], 50.0, self.refusals, self.presence)

    def offer(self, message: bytes, sender: str = "agent-1", utc_us: int = NOW_US) -> None:
        self.presence.update(utc_us)
        self.paths.offer(sender, message, utc_us)

    @property
    def kept(self) -> list[tuple[int, int, int]]:
        """(agent, boot id, sequence number) of each."""
        return [(path.agent, path.boot_id, path.seq) for path in self.paths.latest()]


def store_with(*messages: bytes) -> Store:
    store = Store()
    for message in messages:
        store.offer(message)
    return store


def test_newest_path_of_every_peer_is_kept_by_agent_number() -> None:
    store = Store()
    store.offer(payload(agent=2, seq=4), "agent-2")
    store.offer(payload(agent=1, seq=1))
    store.offer(payload(agent=1, seq=2))
    assert store.kept == [(1, 7, 2), (2, 7, 4)]
    assert not store.refusals.total


def test_a_path_gets_room_for_the_error_of_its_clock() -> None:
    store, clocks = Store(), PeerClocks([1, 2], lambda *_, **__: None)
    store.paths = PeerPaths([1, 2], 50.0, store.refusals, store.presence, clocks=clocks)
    moving = np.arange(5)[:, None] * [0.03, 0.04, 0.0]  # at 2.5 m/s
    path = builders.predicted_path(agent=1, seq=1, t0_utc_us=NOW_US, dt_us=20_000, pos_ned_m=moving)
    store.offer(encode_path(path))
    assert store.paths.latest()[0].margin_m == path.margin_m, "not measured"
    clocks.received(1, NOW_US, NOW_US + 30_000)
    clocks.answered(1, NOW_US, NOW_US + 30_000, NOW_US + 40_000)
    store.offer(encode_path(replace(path, seq=2)))
    assert store.paths.latest()[0].margin_m == pytest.approx(path.margin_m + 0.03 * 2.5, rel=1e-3)


def test_the_path_of_a_stale_peer_is_kept() -> None:
    store = store_with(payload())
    store.offer(payload(agent=2, t0_utc_us=NOW_US + 3600_000_000), "agent-2", NOW_US + 3600_000_000)
    assert [agent for agent, *_ in store.kept] == [1, 2]


@pytest.mark.parametrize(
    ("sender", "message", "reason"),
    [
        ("agent-1", b"", "malformed"),
        ("agent-1", payload()[:-1], "malformed"),
        ("agent-1", b"XX" + payload()[2:], "malformed"),
        ("agent-2", payload(agent=1), "identity"),
        ("operator", payload(agent=1), "identity"),
        ("agent-9", payload(agent=9), "unknown_peer"),
        ("agent-1", payload(seq=5), "replayed"),
        ("agent-1", payload(seq=4), "replayed"),
        ("agent-1", payload(seq=5, t0_utc_us=NOW_US + 1), "sequence"),
        ("agent-1", payload(seq=9, t0_utc_us=NOW_US + 500_001), "future"),
        ("agent-1", payload(seq=9, t0_utc_us=NOW_US - 2_000_001), "late"),
        ("agent-1", payload(seq=2**32 - 1, t0_utc_us=NOW_US + 1), "unconfirmed"),
        ("agent-1", payload(boot_id=8, t0_utc_us=NOW_US + 1), "unconfirmed"),
        ("agent-1", payload(boot_id=8, seq=99, t0_utc_us=NOW_US - 1000), "replayed"),
    ],
)
def test_refused_with_a_counted_reason_and_the_known_path_stays(sender: str, message: bytes, reason: str) -> None:
    store = store_with(payload(seq=5))
    store.offer(message, sender)
    assert store.refusals.by_reason == {reason: 1}
    assert store.kept == [(1, 7, 5)]


@pytest.mark.parametrize("t0_utc_us", [NOW_US + 500_000, NOW_US - 2_000_000])
def test_limits_of_age_are_inclusive(t0_utc_us: int) -> None:
    assert len(store_with(payload(t0_utc_us=t0_utc_us)).kept) == 1


def test_random_bytes_never_raise() -> None:
    rng = np.random.default_rng(4)
    store = Store()
    for _ in range(2000):
        good = bytearray(payload())
        good[int(rng.integers(len(good)))] = int(rng.integers(256))
        store.offer(bytes(good))
        store.offer(rng.bytes(int(rng.integers(0, 200))))
    assert store.refusals.by_reason["malformed"] >= 2000


def hub_of(names: list[str], delay_us: int = 0, loss_01: float = 0.0) -> tuple[SimClock, LocalHub, list[LocalBus]]:
    clock = SimClock()
    hub = LocalHub(clock.now_us, 5, Impairments(delay_us=delay_us, loss_01=loss_01))
    return clock, hub, [hub.connect(name) for name in names]


def test_no_message_arrives_within_the_step_of_its_publication() -> None:
    clock, _, (a, b) = hub_of(["agent-0", "agent-1"])
    a.publish(PATH, b"x")
    assert b.receive(PATH) == []
    clock.advance(1)
    assert b.receive(PATH) == [("agent-0", b"x")]
    assert b.receive(PATH) == []
    assert a.receive(PATH) == []


def test_delay_is_kept_to_the_microsecond() -> None:
    clock, _, (a, b) = hub_of(["agent-0", "agent-1"], delay_us=30_000)
    a.publish(PATH, b"x")
    clock.advance(29_999)
    assert b.receive(PATH) == []
    clock.advance(1)
    assert b.receive(PATH) == [("agent-0", b"x")]


def test_ring_keeps_the_newest_per_sender_and_only_of_what_has_arrived() -> None:
    clock, _, (a, b, c) = hub_of(["agent-0", "agent-1", "agent-2"], delay_us=10)
    a.publish(PATH, b"1")
    clock.advance(5)
    a.publish(PATH, b"2")
    b.publish(PATH, b"3")
    clock.advance(5)
    assert c.receive(PATH) == [("agent-0", b"1")]
    for i in range(300):
        a.publish(TICK, str(i).encode())
        clock.advance(1)
    clock.advance(10)
    ticks = c.receive(TICK)
    assert len(ticks) == TICK.ring
    assert ticks[-1] == ("agent-0", b"299")
    assert c.receive(PATH) == [("agent-0", b"2"), ("agent-1", b"3")]
    for i in range(9):
        a.publish(PATH, str(i).encode())
    clock.advance(10)
    assert [message for _, message in c.receive(PATH)] == [b"5", b"6", b"7", b"8"]


def test_subscriptions_can_be_limited_to_neighbours() -> None:
    clock, hub, (a, b) = hub_of(["agent-0", "agent-1"])
    c = hub.connect("agent-2", {PATH: ["agent-1"]})
    a.publish(PATH, b"a")
    b.publish(PATH, b"b")
    b.publish(TICK, b"t")
    clock.advance(1)
    assert c.receive(PATH) == [("agent-1", b"b")]
    assert c.receive(TICK) == []


def test_a_detached_participant_is_cut_off_but_its_last_messages_arrive() -> None:
    clock, hub, (a, b) = hub_of(["agent-0", "agent-1"])
    a.publish(PATH, b"last")
    hub.detach("agent-0")
    a.publish(PATH, b"ghost")
    b.publish(PATH, b"hello")
    clock.advance(1)
    assert b.receive(PATH) == [("agent-0", b"last")]
    assert a.receive(PATH) == []
    assert b.alive() == {"agent-1"}
    again = hub.connect("agent-0")
    a.publish(PATH, b"ghost")
    a.close()
    again.publish(PATH, b"reborn")
    clock.advance(1)
    assert b.receive(PATH) == [("agent-0", b"reborn")]
    assert b.alive() == {"agent-0", "agent-1"}


def test_a_name_can_be_taken_once() -> None:
    _, hub, _ = hub_of(["agent-0"])
    with pytest.raises(ValueError, match="agent-0"):
        hub.connect("agent-0")


def deliveries(order: list[int], connect_order: list[int]) -> dict[str, list[tuple[str, bytes]]]:
    """Return all messages received in 400 steps, with agents ticked and attached in the given orders."""
    clock = SimClock()
    hub = LocalHub(clock.now_us, 5, Impairments(delay_us=40_000, loss_01=0.3))
    buses = {i: hub.connect(agent_name(i)) for i in connect_order}
    log: dict[str, list[tuple[str, bytes]]] = {agent_name(i): [] for i in order}
    for step in range(400):
        for i in order:
            log[agent_name(i)] += buses[i].receive(PATH)
            buses[i].publish(PATH, f"{i}:{step}".encode())
        clock.advance(20_000)
    return log


def test_order_of_ticking_and_attaching_changes_nothing() -> None:
    assert deliveries([0, 1, 2], [0, 1, 2]) == deliveries([2, 0, 1], [1, 2, 0])


def test_loss_has_the_asked_rate_is_independent_per_receiver_and_spares_reliable_topics() -> None:
    log = deliveries([0, 1, 2], [0, 1, 2])
    from_zero = {name: {p for s, p in log[name] if s == "agent-0"} for name in ("agent-1", "agent-2")}
    for received in from_zero.values():
        assert 0.63 < len(received) / 398 < 0.77
    assert from_zero["agent-1"] != from_zero["agent-2"]
    clock, _, (a, b) = hub_of(["operator", "agent-1"], loss_01=1.0)
    a.publish(COMMAND, b"land")
    a.publish(PATH, b"x")
    clock.advance(1)
    assert b.receive(COMMAND) == [("operator", b"land")]
    assert b.receive(PATH) == []


def test_a_message_too_long_for_its_topic_is_not_delivered() -> None:
    clock, _, (a, b) = hub_of(["agent-0", "agent-1"])
    a.publish(PATH, bytes(PATH.max_bytes))
    a.publish(PATH, bytes(PATH.max_bytes + 1))
    clock.advance(1)
    assert b.receive(PATH) == [("agent-0", bytes(PATH.max_bytes)), ("agent-0", TOO_LONG)]


def test_leaving_and_rejoining_at_once_counts_as_a_second_arrival() -> None:
    _, hub, (a, b) = hub_of(["agent-0", "agent-1"])
    assert dict(b.arrivals()) == {"agent-0": 1, "agent-1": 1}
    a.close()
    assert b.alive() == {"agent-1"}
    hub.connect("agent-0")
    assert dict(b.arrivals()) == {"agent-0": 2, "agent-1": 1}
    assert b.alive() == {"agent-0", "agent-1"}


@pytest.mark.parametrize(
    ("failed_us", "more"), [(LEASE_US - 1, {"agent-0": 1}), (LEASE_US, {"agent-0": 1, "agent-1": 1})]
)
def test_a_failed_bus_reports_arrivals_and_departures_once_it_recovers(failed_us: int, more: dict[str, int]) -> None:
    clock, hub, (a, b) = hub_of(["agent-0", "agent-1"])
    before = dict(b.arrivals())
    hub.fail()
    a.close()
    assert b.alive() == {"agent-0", "agent-1"}, "nobody can tell us"
    hub.connect("agent-0")
    clock.advance(failed_us)
    assert dict(b.arrivals()) == before
    hub.recover()
    assert dict(b.arrivals()) == {name: count + more.get(name, 0) for name, count in before.items()}
    assert b.alive() == {"agent-0", "agent-1"}
