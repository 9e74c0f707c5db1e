"""Acceptance of peers' paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.bus.peers.senders import Presence
from swarmctl.bus.refusals import Refusals
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
    assert store.kept == [(1, 7, 1), (2, 7, 4)]
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
    clocks.answered(1, NOW_US, NOW_US + 30_000, NOW_US + 30_000)
    asked = np.array([1.0, 0.0, 0.5])
    store.offer(encode_path(replace(path, seq=2, setpoint_accel_ned_m_s2=asked)))
    (found,) = store.paths.latest()
    assert found.margin_m == pytest.approx(path.margin_m + 0.03 * 2.5, rel=1e-3)
    np.testing.assert_array_equal(found.setpoint_accel_ned_m_s2, asked)


def test_that_room_is_for_where_the_peer_is_fastest() -> None:
    store, clocks = Store(), PeerClocks([1, 2], lambda *_, **__: None)
    store.paths = PeerPaths([1, 2], 50.0, store.refusals, store.presence, clocks=clocks)
    clocks.received(1, NOW_US, NOW_US + 30_000)
    clocks.answered(1, NOW_US, NOW_US + 30_000, NOW_US + 30_000)
    braking = np.array([[x_m, 0.0, 0.0] for x_m in (0.0, 0.06, 0.10, 0.12, 0.12)])  # from 3 m/s
    path = builders.predicted_path(agent=1, seq=1, t0_utc_us=NOW_US, dt_us=20_000, pos_ned_m=braking)
    store.offer(encode_path(path))
    assert store.paths.latest()[0].margin_m == pytest.approx(path.margin_m + 0.03 * 3.0, rel=1e-3)


def test_a_path_is_taken_at_times_of_the_own_clock_where_the_peer_s_is_known_exactly() -> None:
    store, clocks = Store(), PeerClocks([1, 2], lambda *_, **__: None)
    store.paths = PeerPaths([1, 2], 50.0, store.refusals, store.presence, clocks=clocks)
    clocks.received(1, NOW_US + 3_000_000, NOW_US)
    clocks.answered(1, NOW_US, NOW_US + 3_000_000, NOW_US)
    store.offer(payload(t0_utc_us=NOW_US + 3_000_000))
    assert [path.t0_utc_us for path in store.paths.latest()] == [NOW_US]


def test_those_within_reach_are_near_from_when_they_came_and_the_others_stay_known() -> None:
    store = store_with(payload())
    store.offer(payload(agent=2), "agent-2")
    paths, later_us = store.paths, NOW_US + 1_000_000
    assert [path.agent for path in paths.near()] == [1, 2] and paths.is_near(1), "at first everybody"
    paths.attend([2], NOW_US)
    assert [path.agent for path in paths.near()] == [2]
    assert (paths.is_near(1), paths.is_near(2)) == (False, True)
    assert len(paths.latest()) == 2 and paths.newest_utc_us(1) == NOW_US
    paths.attend([1, 2], later_us)
    assert [path.agent for path in paths.near()] == [1, 2]
    assert [path.agent for path in paths.near(later_us - 1)] == [2]
    assert [path.agent for path in paths.late(later_us)] == [1, 2]
    assert [path.agent for path in paths.late(later_us - 1)] == [2], "who has just come was not listened to before"
    assert paths.late(NOW_US) == []
    paths.attend([9], later_us)
    assert paths.is_near(9) and paths.newest_utc_us(9) == 0, "within reach, and not heard yet"


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
