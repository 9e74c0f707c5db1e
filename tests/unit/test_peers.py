"""Which paths of peers are believed, and the in-memory bus of lockstep."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.core.clock import SimClock
from swarmctl.core.types import PredictedPath
from swarmctl.links.peers import LocalBus, LocalHub, PeerPaths, agent_name
from swarmctl.links.topics import COMMAND, PATH, TICK, encode_path

NOW_US = 1_700_000_000_000_000


def payload(agent: int = 1, boot_id: int = 7, seq: int = 1, t0_utc_us: int = NOW_US) -> bytes:
    return encode_path(PredictedPath(agent, boot_id, seq, t0_utc_us, 100_000, 0.0, np.zeros((5, 3))))


def store_with(*messages: bytes) -> PeerPaths:
    store = PeerPaths([1, 2])
    for message in messages:
        store.offer("agent-1", message, NOW_US)
    return store


def test_newest_path_of_every_peer_is_kept_by_agent_number() -> None:
    store = PeerPaths([1, 2])
    store.offer("agent-2", payload(agent=2, seq=4), NOW_US)
    store.offer("agent-1", payload(agent=1, seq=1), NOW_US)
    store.offer("agent-1", payload(agent=1, seq=2), NOW_US)
    assert [(p.agent, p.seq) for p in store.latest()] == [(1, 2), (2, 4)]
    assert not store.rejected


def test_a_silent_peer_is_never_forgotten() -> None:
    store = store_with(payload())
    store.offer("agent-2", payload(agent=2, t0_utc_us=NOW_US + 3600_000_000), NOW_US + 3600_000_000)
    assert [p.agent for p in store.latest()] == [1, 2]


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
        ("agent-1", payload(seq=9, t0_utc_us=NOW_US + 500_001), "future"),
        ("agent-1", payload(seq=9, t0_utc_us=NOW_US - 2_000_001), "late"),
    ],
)
def test_refused_with_a_counted_reason_and_the_known_path_stays(sender: str, message: bytes, reason: str) -> None:
    store = store_with(payload(seq=5))
    store.offer(sender, message, NOW_US)
    assert dict(store.rejected) == {reason: 1}
    assert [p.seq for p in store.latest()] == [5]


@pytest.mark.parametrize("t0_utc_us", [NOW_US + 500_000, NOW_US - 2_000_000])
def test_limits_of_age_are_inclusive(t0_utc_us: int) -> None:
    assert len(store_with(payload(t0_utc_us=t0_utc_us)).latest()) == 1


def test_a_restarted_peer_is_believed_and_its_former_life_is_not() -> None:
    store = store_with(payload(boot_id=7, seq=500), payload(boot_id=3, seq=1, t0_utc_us=NOW_US + 1000))
    assert [(p.boot_id, p.seq) for p in store.latest()] == [(3, 1)]
    store.offer("agent-1", payload(boot_id=7, seq=501, t0_utc_us=NOW_US + 2000), NOW_US)
    assert store.rejected["replayed"] == 1
    store.offer("agent-1", payload(boot_id=3, seq=2, t0_utc_us=NOW_US + 3000), NOW_US)
    assert [(p.boot_id, p.seq) for p in store.latest()] == [(3, 2)]


def test_a_delayed_message_of_an_unseen_former_life_is_a_replay() -> None:
    store = store_with(payload(boot_id=3), payload(boot_id=7, seq=99, t0_utc_us=NOW_US - 1000))
    assert [p.boot_id for p in store.latest()] == [3]
    assert store.rejected["replayed"] == 1


def test_random_bytes_never_raise() -> None:
    rng = np.random.default_rng(4)
    store = PeerPaths([1])
    for _ in range(2000):
        good = bytearray(payload())
        good[int(rng.integers(len(good)))] = int(rng.integers(256))
        store.offer("agent-1", bytes(good), NOW_US)
        store.offer("agent-1", rng.bytes(int(rng.integers(0, 200))), NOW_US)
    assert store.rejected["malformed"] >= 2000


def hub_of(names: list[str], delay_us: int = 0, loss_01: float = 0.0) -> tuple[SimClock, LocalHub, list[LocalBus]]:
    clock = SimClock()
    hub = LocalHub(clock.now_us, seed=5, delay_us=delay_us, loss_01=loss_01)
    return clock, hub, [hub.attach(name) for name in names]


def test_nothing_is_visible_within_the_step_it_was_said_in() -> None:
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


def test_listening_can_be_limited_to_neighbours() -> None:
    clock, hub, (a, b) = hub_of(["agent-0", "agent-1"])
    c = hub.attach("agent-2", {PATH: ["agent-1"]})
    a.publish(PATH, b"a")
    b.publish(PATH, b"b")
    b.publish(TICK, b"t")
    clock.advance(1)
    assert c.receive(PATH) == [("agent-1", b"b")]
    assert c.receive(TICK) == []


def test_a_dead_participant_says_and_hears_nothing_but_its_last_words_arrive() -> None:
    clock, hub, (a, b) = hub_of(["agent-0", "agent-1"])
    a.publish(PATH, b"last")
    hub.detach("agent-0")
    a.publish(PATH, b"ghost")
    b.publish(PATH, b"hello")
    clock.advance(1)
    assert b.receive(PATH) == [("agent-0", b"last")]
    assert a.receive(PATH) == []
    assert b.alive() == {"agent-1"}
    again = hub.attach("agent-0")
    a.publish(PATH, b"ghost")
    a.close()
    again.publish(PATH, b"reborn")
    clock.advance(1)
    assert b.receive(PATH) == [("agent-0", b"reborn")]
    assert b.alive() == {"agent-0", "agent-1"}


def test_a_name_can_be_taken_once() -> None:
    _, hub, _ = hub_of(["agent-0"])
    with pytest.raises(ValueError, match="agent-0"):
        hub.attach("agent-0")


def heard(order: list[int], attach_order: list[int]) -> dict[str, list[tuple[str, bytes]]]:
    """Everything every agent hears in 400 steps, with agents ticked and attached in the given orders."""
    clock = SimClock()
    hub = LocalHub(clock.now_us, seed=5, delay_us=40_000, loss_01=0.3)
    buses = {i: hub.attach(agent_name(i)) for i in attach_order}
    log: dict[str, list[tuple[str, bytes]]] = {agent_name(i): [] for i in order}
    for step in range(400):
        for i in order:
            log[agent_name(i)] += buses[i].receive(PATH)
            buses[i].publish(PATH, f"{i}:{step}".encode())
        clock.advance(20_000)
    return log


def test_order_of_ticking_and_attaching_changes_nothing() -> None:
    assert heard([0, 1, 2], [0, 1, 2]) == heard([2, 0, 1], [1, 2, 0])


def test_loss_has_the_asked_rate_is_independent_per_receiver_and_spares_reliable_topics() -> None:
    log = heard([0, 1, 2], [0, 1, 2])
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
