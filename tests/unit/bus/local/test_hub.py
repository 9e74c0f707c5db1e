"""The bus in memory: delays, rings, subscriptions, departures and losses."""

from __future__ import annotations

import pytest

from swarmctl.bus.bus import DEFAULT_LEASE_MS, agent_name
from swarmctl.bus.local.hub import LocalBus, LocalHub
from swarmctl.bus.local.links import Impairments
from swarmctl.bus.topics import COMMAND, PATH, TICK, TOO_LONG
from swarmctl.core.clock import SimClock

LEASE_US = 1000 * DEFAULT_LEASE_MS


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
    for i in range(PATH.ring + 5):
        a.publish(PATH, str(i).encode())
    clock.advance(10)
    assert [int(message) for _, message in c.receive(PATH)] == list(range(5, PATH.ring + 5))


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
