"""Who is far, and whose acknowledgement can be done without: rules of `swarmctl.control.commit.reach`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.control.commit import reach
from swarmctl.control.commit.reach import FAR_LEASE_US, FarPeers
from swarmctl.core.trajectory import Trajectory, resting
from swarmctl.core.trajectory_message import ANYWHERE, Reach, TrajectoryMessage
from tests import builders
from tests.benches.far_pair import FarPair

NOW_US = 1_700_000_000_000_000
SPEED_M_S, STRETCH_M, APART_M = 2.0, 6.0, 1.0
BALL_M = APART_M + STRETCH_M  # around the place of a peer whose message is of now


def at(north_m: float) -> Trajectory:
    return resting(np.array([north_m, 0.0, -2.0]), NOW_US, 100_000)


def moving(from_m: float, speed_m_s: float, seconds: float) -> Trajectory:
    north_m = from_m + speed_m_s * 0.1 * np.arange(round(seconds / 0.1) + 1)
    pos = np.stack([north_m, 0.0 * north_m, 0.0 * north_m - 2.0], axis=1)
    vel = np.tile([speed_m_s, 0.0, 0.0], (len(pos), 1))
    return Trajectory(t0_utc_us=NOW_US, dt_us=100_000, pos_ned_m=pos, vel_ned_m_s=vel)


class Scene:
    """One agent at the origin, and peer 1 to its north, which has heard by now that it is far."""

    def __init__(self, north_m: float, *, age_us: int = 0, ahead_us: int = 0, tube_m: float = 0.0) -> None:
        self.far_peers = FarPeers(
            [1], speed_m_s=SPEED_M_S, stretch_m=STRETCH_M, apart_m=APART_M, ahead_us=lambda _: ahead_us
        )
        message = builders.trajectory_message(
            sent_utc_us=NOW_US - age_us + ahead_us, committed=at(north_m), tube_m=tube_m
        )
        self.message = replace(message, reach=Reach(speed_m_s=SPEED_M_S, stretch_m=STRETCH_M))
        self.confirmed_us = {1: NOW_US}
        self.looks([at(0.0)])
        self.far_peers.published(self.stated(), NOW_US, for_all=True)

    @property
    def messages(self) -> dict[int, TrajectoryMessage]:
        return {1: self.message}

    def looks(self, own: Sequence[Trajectory], later_us: int = 0) -> bool:
        """Look who is far, and tell whether peer 1 is."""
        self.far_peers.update(own, self.messages, NOW_US + later_us)
        return 1 not in self.far_peers.near

    def stated(self) -> Reach:
        return self.far_peers.reach([at(0.0)], away_m=0.0, speed_m_s=0.0, stops_m=0.0)

    def spares(self, trajectory: Trajectory, later_us: int = 0) -> bool:
        return 1 in self.far_peers.spared(trajectory, self.messages, self.confirmed_us, NOW_US + later_us)


def test_who_is_beyond_what_both_can_reach_is_far() -> None:
    assert not Scene(BALL_M + 1.4).looks([at(0.0)])
    assert Scene(BALL_M + 1.6).looks([at(0.0)])
    assert Scene(BALL_M + 1.6).looks([at(0.3)], 100_000), "it stays far for a while"
    assert not Scene(BALL_M + 1.6).looks([at(0.7)], 100_000)
    assert not Scene(BALL_M + 1.6).looks([at(0.0), moving(0.0, 1.0, 1.0)], 100_000), "a proposal comes closer"


def test_nobody_is_far_without_far_messages_and_of_whom_nothing_is_known() -> None:
    off = FarPeers([1], speed_m_s=0.0, stretch_m=0.0, apart_m=APART_M, ahead_us=lambda _: 0)
    off.update([at(0.0)], Scene(1000.0).messages, NOW_US)
    assert off.near == {1} and off.reach([at(0.0)], away_m=0.0, speed_m_s=0.0, stops_m=0.0) == ANYWHERE
    scene = Scene(1000.0)
    scene.far_peers.update([at(0.0)], {}, NOW_US + 100_000)
    assert scene.far_peers.near == {1}
    scene = Scene(1000.0)
    scene.message = replace(scene.message, reach=ANYWHERE)
    assert not scene.looks([at(0.0)], 100_000), "it states no bounds"


@pytest.mark.parametrize(
    ("change", "further_m"),
    [
        (lambda: Scene(20.0), 0.0),
        (lambda: Scene(20.0, age_us=500_000), 1.0),
        (lambda: Scene(20.0, age_us=60_000_000), 3.0),
        (lambda: Scene(20.0, ahead_us=3_600_000_000), 0.0),
        (lambda: Scene(20.0, tube_m=0.5), 0.5),
    ],
    ids=["now", "half a second old", "a minute old: the lease has ended", "clock ahead", "outside its tube"],
)
def test_a_proposal_is_spared_up_to_the_ball_of_the_peer(change: Callable[[], Scene], further_m: float) -> None:
    end_m = 20.0 - BALL_M - further_m
    assert change().spares(moving(end_m - 3.0, 1.0, 2.9))
    assert not change().spares(moving(end_m - 3.0, 1.0, 3.1))


def test_the_error_of_the_peers_clock_widens_its_ball() -> None:
    scene = Scene(20.0)
    unsure = replace(scene.message.committed, clock_error_us=250_000)
    scene.message = replace(scene.message, committed=unsure)
    assert scene.spares(at(20.0 - BALL_M - 1.05))
    assert not scene.spares(at(20.0 - BALL_M - 0.95)), "the message may be older, and the place be another one"


@pytest.mark.parametrize("confirmed_us", [NOW_US - 1, NOW_US + 1_000_000, 0], ids=["before", "in the future", "never"])
def test_nobody_is_spared_who_has_not_said_that_it_knows(confirmed_us: int) -> None:
    scene = Scene(30.0)
    assert scene.spares(at(0.0))
    scene.confirmed_us = {1: confirmed_us}
    assert not scene.spares(at(0.0))


def test_nobody_is_spared_whose_last_word_is_older_than_the_lease() -> None:
    assert Scene(30.0).spares(at(0.0), FAR_LEASE_US)
    assert not Scene(30.0).spares(at(0.0), FAR_LEASE_US + 1)


def test_only_a_message_that_all_hear_begins_the_lease_and_any_other_ends_it() -> None:
    scene = Scene(30.0)
    near = replace(scene.stated(), far=frozenset())
    scene.far_peers.published(near, NOW_US, for_all=False)
    assert not scene.spares(at(0.0)), "a message that did not declare it far"
    scene.far_peers.published(scene.stated(), NOW_US, for_all=False)
    assert not scene.spares(at(0.0)), "which it has not heard"
    scene.far_peers.published(scene.stated(), NOW_US, for_all=True)
    assert scene.spares(at(0.0))


@pytest.mark.parametrize("immodest", [moving(0.0, 2.1, 1.0), moving(0.0, 1.9, 3.3)], ids=["too fast", "too long"])
def test_an_immodest_proposal_spares_nobody_and_messages_state_it(immodest: Trajectory) -> None:
    scene = Scene(100.0)
    assert scene.spares(moving(0.0, 2.0, 2.9))
    assert not scene.spares(immodest)
    stated = scene.far_peers.reach([at(0.0), immodest], away_m=0.0, speed_m_s=0.0, stops_m=0.0)
    assert stated.speed_m_s > SPEED_M_S or stated.stretch_m > STRETCH_M


def test_of_an_excluded_peer_distance_alone_counts_once_it_can_not_do_without_the_agent_any_more() -> None:
    immodest, later_us = moving(0.0, 2.1, 4.0), FAR_LEASE_US + 100_000

    def spares(north_m: float, after_us: int) -> bool:
        scene = Scene(north_m)
        return 1 in scene.far_peers.spared(immodest, scene.messages, {}, NOW_US + after_us, {1})

    assert spares(100.0, later_us)
    assert not spares(100.0, FAR_LEASE_US - 100_000), "it may still commit without the agent"
    assert not spares(12.0, later_us), "within what it may have committed to"


def test_messages_state_on_which_way_a_vehicle_stops_that_somebody_else_flies() -> None:
    stated = Scene(100.0).far_peers.reach([at(0.0)], away_m=0.5, speed_m_s=8.0, stops_m=21.0)
    assert (stated.speed_m_s, stated.stretch_m) == (8.0, 21.5)


def test_messages_state_what_others_fly_and_how_far_the_vehicle_is_off() -> None:
    stated = Scene(100.0).far_peers.reach([at(0.0)], away_m=0.7, speed_m_s=5.0, stops_m=0.0)
    assert (stated.speed_m_s, stated.stretch_m) == (5.0, STRETCH_M + 0.7)


def test_a_peer_that_has_come_closer_meanwhile_is_not_spared_any_more() -> None:
    scene = Scene(30.0)
    spared = scene.far_peers.spared(at(0.0), scene.messages, scene.confirmed_us, NOW_US)
    assert scene.far_peers.still_spared(spared, at(0.0), scene.messages, NOW_US) == {1}
    scene.message = replace(scene.message, committed=at(BALL_M - 0.1))
    assert scene.far_peers.still_spared(spared, at(0.0), scene.messages, NOW_US) == frozenset()


class WithoutLease(FarPeers):
    """Spares peers whatever they have said to have heard."""

    def _is_leased(self, agent: int, heard_us: int, utc_us: int) -> bool:
        return agent not in self.near


class WithoutAge(FarPeers):
    """Takes the place in the newest message for where the peer is."""

    def _radius_m(self, place: reach._Place, utc_us: int) -> float:
        return place.message.reach.stretch_m


class WithoutStretch(FarPeers):
    """Counts on where the peer is, not on where it may fly next."""

    def _radius_m(self, place: reach._Place, utc_us: int) -> float:
        return super()._radius_m(place, utc_us) - place.message.reach.stretch_m


class WithoutModesty(FarPeers):
    """Flies as fast and as long as it likes, whatever its messages state."""

    def _is_within(self, extent: reach._Extent) -> bool:
        return True


APARTS_M = [15.0 + m for m in range(12)]
MET_M = 0.99


@pytest.mark.parametrize("apart_m", APARTS_M)
def test_far_agents_never_commit_to_what_conflicts_whatever_is_cut(apart_m: float) -> None:
    spared = 0
    for seed in range(4):
        pair = FarPair(seed, apart_m)
        assert pair.fly(12.0) >= MET_M
        spared += sum(agent.spared_times for agent in pair.agents)
    assert spared > 20, "or the rules have not been tried"


@pytest.mark.parametrize(
    ("rules", "seed", "apart_m"),
    [
        (WithoutLease, 139, 28.0),
        (WithoutAge, 63, 16.5),
        (WithoutStretch, 0, 15.0),
        (WithoutModesty, 5, 25.0),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else str(value),
)
def test_without_one_of_the_rules_two_commitments_conflict(rules: type[FarPeers], seed: int, apart_m: float) -> None:
    assert FarPair(seed, apart_m, rules).fly(25.0) < MET_M
    assert FarPair(seed, apart_m).fly(25.0) >= MET_M
