"""Interest management: who is within reach, and what is heard of the others."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.agent.sharing.interest import Interest
from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalBus, LocalHub
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.bus.peers.senders import Presence
from swarmctl.bus.refusals import Refusals
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.clock import SimClock
from tests import builders

HORIZON_S, FAR_HZ, SPEED_M_S, RADIUS_M = 0.8, 5.0, 3.0, 0.9
AHEAD_S = HORIZON_S + 1.0 / FAR_HZ + 0.5
CLOSEST_M = RADIUS_M + 0.1  # with what margins may grow by untold
REACH_M = CLOSEST_M + 2.0 * SPEED_M_S * AHEAD_S
SEPARATION = SeparationParams(radius_m=RADIUS_M)


class Listener:
    """Agent 0 and its interest, beside peer 1."""

    def __init__(self, far_hz: float = FAR_HZ) -> None:
        self.clock = SimClock()
        hub = LocalHub(self.clock.now_us)
        self.bus: LocalBus = hub.connect(agent_name(0), dict.fromkeys(topics.FOR_AGENTS))
        self.peer = hub.connect(agent_name(1), {})
        self.paths = PeerPaths([1], 50.0, Refusals(lambda name, **fields: None), Presence(self.bus))
        self.interest = Interest(
            PathSharingParams(far_hz=far_hz, speed_m_s=SPEED_M_S),
            SEPARATION,
            self.bus,
            self.paths,
            [1],
            horizon_s=HORIZON_S,
        )
        self.waits = False
        self._seq = 0

    def meets(self, east_m: float, *, own_m_s: float = 0.0, peer_m_s: float = 0.0, late_s: float = 0.0) -> bool:
        """Return whether peer 1 is within reach, at a distance and with speeds, `late_s` after its newest path."""
        self.clock.advance(500_000)  # by then it is looked whether who is within reach may be left
        self._seq += 1
        pos = np.zeros((41, 3))
        pos[:, 1] = east_m - peer_m_s * 0.02 * np.arange(41)
        utc_us = self.clock.utc_us()
        path = builders.predicted_path(pos_ned_m=pos, seq=self._seq, t0_utc_us=utc_us, dt_us=20_000)
        self.paths.offer(agent_name(1), encode_path(path), utc_us)
        state = builders.vehicle_state(pos_ned_m=np.zeros(3), vel_ned_m_s=np.array([0.0, own_m_s, 0.0]))
        self.interest.update(state, SPEED_M_S, utc_us + round(late_s * 1e6), waits=self.waits)
        return self.interest.within_reach == {1}

    def hears(self, topic: topics.Topic) -> bool:
        """Return whether what the peer says now arrives."""
        self.peer.publish(topic, b"path")
        self.clock.advance(20_000)
        return bool(self.bus.receive(topic))


@pytest.mark.parametrize(
    ("own_m_s", "peer_m_s", "late_s"), [(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (0.0, 5.0, 0.0), (1.0, 1.0, 0.5)]
)
def test_reach_is_what_both_can_fly_until_the_peer_is_heard_again(
    own_m_s: float, peer_m_s: float, late_s: float
) -> None:
    closing_m_s = max(SPEED_M_S, own_m_s) + max(SPEED_M_S, 1.1 * peer_m_s)
    reach_m = CLOSEST_M + closing_m_s * (AHEAD_S + late_s)
    beyond = Listener()
    assert not beyond.meets(1.11 * reach_m, own_m_s=own_m_s, peer_m_s=peer_m_s, late_s=late_s)
    assert beyond.meets(0.99 * reach_m, own_m_s=own_m_s, peer_m_s=peer_m_s, late_s=late_s)


def test_a_peer_comes_within_reach_by_its_silence_as_soon_as_it_may_and_is_looked_at_no_sooner() -> None:
    listener = Listener()
    state = builders.vehicle_state(pos_ned_m=np.zeros(3), vel_ned_m_s=np.zeros(3))
    assert not listener.meets(1.5 * REACH_M)
    heard_us, reached = listener.clock.utc_us(), []
    for late_us in range(0, 3_000_000, 20_000):
        listener.interest.update(state, SPEED_M_S, heard_us + late_us, waits=False)
        reached.append(bool(listener.interest.within_reach))
    silent_s = 0.02 * reached.index(True)
    assert silent_s == pytest.approx(0.5 * REACH_M / (2.0 * SPEED_M_S), abs=0.121)


def test_the_silence_of_a_peer_counts_when_it_has_been_within_reach_for_long_enough() -> None:
    listener = Listener()
    assert not listener.meets(2.0 * REACH_M)
    assert not listener.paths.near()
    assert listener.meets(0.5 * REACH_M)
    now_us = listener.clock.utc_us()
    assert [path.agent for path in listener.paths.near()] == [1]
    assert [path.agent for path in listener.paths.near(now_us)] == [1]
    assert not listener.paths.near(now_us - 1)


def test_a_peer_is_left_a_little_farther_away_than_it_is_heard_from() -> None:
    listener = Listener()
    assert listener.meets(1.05 * REACH_M), "everybody is within reach at first"
    assert not listener.meets(1.15 * REACH_M)
    assert not listener.meets(1.05 * REACH_M)
    assert listener.meets(0.95 * REACH_M)


def test_out_of_reach_only_the_paths_for_all_are_heard() -> None:
    listener = Listener()
    assert listener.hears(topics.PATH) and listener.hears(topics.FAR_PATH)
    listener.meets(2.0 * REACH_M)
    assert not listener.hears(topics.PATH)
    assert listener.hears(topics.FAR_PATH)
    listener.meets(0.5 * REACH_M)
    assert listener.hears(topics.PATH)


def test_out_of_reach_statuses_are_heard_before_and_after_the_mission_alone() -> None:
    listener = Listener()
    listener.meets(2.0 * REACH_M)
    assert not listener.hears(topics.STATUS)
    listener.waits = True
    listener.meets(2.0 * REACH_M)
    assert listener.hears(topics.STATUS)
    listener.waits = False
    listener.meets(2.0 * REACH_M)
    assert not listener.hears(topics.STATUS)
    listener.meets(0.5 * REACH_M)
    assert listener.hears(topics.STATUS)


def test_without_an_own_state_all_are_within_reach() -> None:
    listener = Listener()
    assert not listener.meets(2.0 * REACH_M)
    listener.interest.update(None, 0.0, listener.clock.utc_us(), waits=False)
    assert listener.hears(topics.PATH)


def test_without_a_rate_for_those_far_away_all_paths_of_all_are_heard() -> None:
    listener = Listener(far_hz=0.0)
    listener.meets(1e3)
    assert listener.hears(topics.PATH)
