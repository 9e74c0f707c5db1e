"""Trajectory messages over the wire: what is sent is what is decoded, and everything else is refused."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.commitment_messages import (
    MAX_PEERS,
    MAX_POINTS,
    decode_trajectory_message,
    encode_trajectory_message,
)
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.bus.peers.senders import Presence
from swarmctl.bus.peers.trajectories import MAX_CLOCK_ERROR_US, PeerTrajectories
from swarmctl.bus.refusals import Refusals
from swarmctl.control.commit.protocol import acknowledgements
from swarmctl.core.clock import SimClock
from swarmctl.core.trajectory import Trajectory, ending_at_rest, joined, resting, stopping
from swarmctl.core.trajectory_message import Exclusions, Proposal, Reach, TrajectoryMessage
from swarmctl.core.types import MAX_SPEED_M_S, MAX_STEP_US, MIN_STEP_US
from tests import builders

UTC_US = 1_700_000_000_000_000


def trajectory(shift_m: float = 0.0) -> Trajectory:
    return stopping(np.array([shift_m, 1.0, -2.0]), np.array([1.5, -0.5, 0.25]), UTC_US, 100_000, brake_m_s2=1.5)


def message(seq: int = 1, agent: int = 2, boot_id: int = 9, propose: bool = True) -> TrajectoryMessage:
    proposal = Proposal(number=77, made_utc_us=UTC_US + 5, agent=agent, trajectory=trajectory(0.5)) if propose else None
    sent_utc_us = UTC_US + 20_000 * seq
    return builders.trajectory_message(
        agent=agent,
        boot_id=boot_id,
        seq=seq,
        sent_utc_us=sent_utc_us,
        committed=trajectory(),
        tube_m=0.25,
        proposal=proposal,
        acknowledged={0: 5, 1: UTC_US},
        exclusions=Exclusions(suspected=frozenset({1, 4}), promised=frozenset({4})),
        heard={0: (UTC_US - 7, UTC_US - 3)},
    )


@pytest.mark.parametrize("propose", [True, False])
def test_a_decoded_message_is_what_was_encoded(propose: bool) -> None:
    sent = message(propose=propose)
    decoded = decode_trajectory_message(encode_trajectory_message(sent))
    assert decoded is not None
    assert (decoded.agent, decoded.boot_id, decoded.seq, decoded.is_committed, decoded.acknowledged) == (
        2,
        9,
        1,
        True,
        sent.acknowledged,
    )
    assert (decoded.exclusions, decoded.heard, decoded.reach) == (sent.exclusions, sent.heard, sent.reach)
    assert decoded.sent_utc_us == UTC_US + 20_000
    assert decoded.tube_m == pytest.approx(0.25)
    np.testing.assert_allclose(decoded.committed.pos_ned_m, sent.committed.pos_ned_m, atol=1e-6)
    assert decoded.committed.t0_utc_us == UTC_US
    assert (decoded.proposal is not None) is propose
    if decoded.proposal is not None:
        assert decoded.proposal.order == (UTC_US + 5, 2)
        np.testing.assert_allclose(decoded.proposal.trajectory.vel_ned_m_s, trajectory(0.5).vel_ned_m_s, atol=1e-6)


@pytest.mark.parametrize("asks_far", [True, False])
def test_what_those_that_are_far_count_on_is_encoded(asks_far: bool) -> None:
    reach = Reach(far=frozenset({3, 250}), speed_m_s=2.25, stretch_m=6.5)
    sent = message()
    assert sent.proposal is not None
    sent = replace(sent, reach=reach, proposal=replace(sent.proposal, asks_far=asks_far))
    decoded = decode_trajectory_message(encode_trajectory_message(sent))
    assert decoded is not None and decoded.proposal is not None
    assert (decoded.reach, decoded.proposal.asks_far) == (reach, asks_far)


@pytest.mark.parametrize(("speed_m_s", "stretch_m"), [(math.nan, 1.0), (1.0, math.nan), (-1.0, 1.0), (1.0, -math.inf)])
def test_bounds_that_bound_nothing_are_refused(speed_m_s: float, stretch_m: float) -> None:
    sent = replace(message(), reach=Reach(speed_m_s=speed_m_s, stretch_m=stretch_m))
    assert decode_trajectory_message(encode_trajectory_message(sent)) is None


def test_what_was_heard_is_found_whatever_the_numbers_are() -> None:
    """Bytes of stamps look like numbers of agents."""
    heard = {agent: (agent << 32 | 7, 9 << 32 | agent) for agent in (0, 1, 7, 9, 200)}
    decoded = decode_trajectory_message(encode_trajectory_message(replace(message(), heard=heard)))
    assert decoded is not None
    assert {agent: decoded.heard.get(agent) for agent in range(256)} == {
        agent: heard.get(agent) for agent in range(256)
    }
    assert dict(decoded.heard) == heard and len(decoded.heard) == len(heard)


def test_truncated_lengthened_and_mutilated_messages_are_refused() -> None:
    good = encode_trajectory_message(message())
    rng = np.random.default_rng(1)
    assert all(decode_trajectory_message(good[:n]) is None for n in range(len(good)))
    assert decode_trajectory_message(good + b"\0") is None
    for _ in range(2000):
        bad = bytearray(good)
        bad[rng.integers(len(bad))] = rng.integers(256)
        found = decode_trajectory_message(bytes(bad))
        if found is not None:
            assert np.isfinite(found.committed.pos_ned_m).all()


def flat(points: int) -> Trajectory:
    zeros = np.zeros((points, 3))
    return Trajectory(t0_utc_us=UTC_US, dt_us=100_000, pos_ned_m=zeros, vel_ned_m_s=zeros)


FLAGS, TUBE, STEP, POINTS = 3, 24, 54, 62  # offsets: of the header's flags and tube, of the committed step and points


@pytest.mark.parametrize(
    ("offset", "code", "value", "fits"),
    [
        (FLAGS, "<B", 3, True),
        (FLAGS, "<B", 7, True),
        (FLAGS, "<B", 8, False),
        (TUBE, "<f", 0.0, True),
        (TUBE, "<f", 100.0, True),
        *((TUBE, "<f", bad, False) for bad in (-0.1, 101.0, math.nan, math.inf)),
        (STEP, "<i", MIN_STEP_US, True),
        (STEP, "<i", MIN_STEP_US - 1, False),
        (STEP, "<i", 1, False),
        (STEP, "<i", MAX_STEP_US, True),
        (STEP, "<i", 0, False),
        (STEP, "<i", -100_000, False),
        (STEP, "<i", MAX_STEP_US + 1, False),
        (POINTS, "<f", 1e6, False),  # it would jump there
        *((POINTS + 4 * k, "<f", sign * MAX_SPEED_M_S, True) for k in (3, 4, 5) for sign in (1.0, -1.0)),
        *((POINTS + 4 * k, "<f", sign * 501.0, False) for k in (3, 4, 5) for sign in (1.0, -1.0)),
        *((POINTS + 4 * k, "<f", bad, False) for k in range(6) for bad in (math.nan, math.inf, -math.inf)),
    ],
)
def test_a_number_out_of_bounds_is_refused(offset: int, code: str, value: float, fits: bool) -> None:
    payload = bytearray(encode_trajectory_message(message()))
    struct.pack_into(code, payload, offset, value)
    assert (decode_trajectory_message(bytes(payload)) is not None) is fits


@pytest.mark.parametrize(("points", "fits"), [(1, False), (2, True), (MAX_POINTS, True), (MAX_POINTS + 1, False)])
def test_the_number_of_points_is_bounded(points: int, fits: bool) -> None:
    for propose in (False, True):
        sent = message(propose=propose)
        if sent.proposal is None:
            sent = replace(sent, committed=flat(points))
        else:
            sent = replace(sent, proposal=replace(sent.proposal, trajectory=flat(points)))
        assert (decode_trajectory_message(encode_trajectory_message(sent)) is not None) is fits


@pytest.mark.parametrize(("count", "fits"), [(MAX_PEERS, True), (MAX_PEERS + 1, False)])
def test_the_number_of_acknowledgements_is_bounded(count: int, fits: bool) -> None:
    sent = replace(message(), acknowledged=dict.fromkeys(range(count), 1))
    assert (decode_trajectory_message(encode_trajectory_message(sent)) is not None) is fits
    for kind in ("suspected", "promised"):
        sent = replace(message(), exclusions=Exclusions(**{kind: frozenset(range(count))}))
        assert (decode_trajectory_message(encode_trajectory_message(sent)) is not None) is fits


class Store:
    """Trajectory messages of agents 0 and 2 as agent 1 takes them in, at 50 Hz, one message a tick."""

    def __init__(self) -> None:
        self.clock = SimClock()
        self.hub = LocalHub(self.clock.now_us)
        self.peer = self.hub.connect(agent_name(2))
        self.presence = Presence(self.hub.connect(agent_name(1)))
        self.refusals = Refusals(lambda *_, **__: None)
        self.clocks = PeerClocks([0, 2], lambda *_, **__: None)
        self.peers = PeerTrajectories([0, 2], 50.0, self.refusals, self.presence, agent=1, clocks=self.clocks)
        self.utc_us = UTC_US

    def offer(self, *sent: TrajectoryMessage, sender: str = agent_name(2)) -> None:
        for each in sent:
            self.utc_us += 20_000
            self.presence.update(self.utc_us)
            self.peers.offer(sender, encode_trajectory_message(each), self.utc_us)


def test_only_newer_messages_of_expected_peers_are_accepted() -> None:
    store = Store()
    store.offer(message(seq=3), message(seq=3), message(seq=2))
    store.offer(message(seq=4), sender=agent_name(0))
    store.offer(message(seq=4, agent=1), sender=agent_name(1))
    store.peers.offer(agent_name(2), b"nonsense", UTC_US)
    assert set(store.peers.newest) == {2} and store.peers.newest[2].seq == 3
    assert store.refusals.by_reason == {"identity": 1, "unknown_peer": 1, "malformed": 1}, "old ones come by relays"
    assert acknowledgements(store.peers.newest, frozenset()) == {2: 77}


def test_an_old_number_with_other_contents_is_refused() -> None:
    store = Store()
    store.offer(message(seq=3), message(seq=4), message(seq=3, propose=False))
    assert store.refusals.by_reason == {"sequence": 1}


def test_one_forged_message_does_not_silence_its_peer() -> None:
    store = Store()
    store.offer(message(seq=3), message(seq=4, boot_id=10), message(seq=2**32 - 1), message(seq=4))
    assert (store.peers.newest[2].boot_id, store.peers.newest[2].seq) == (9, 4)
    assert store.refusals.by_reason == {"unconfirmed": 2}
    store.offer(*(message(seq=seq) for seq in range(5, 12)))
    assert store.peers.newest[2].seq == 11
    assert store.refusals.by_reason["boot"] == 1


def test_a_restart_is_accepted_with_its_third_message_and_has_proposed_nothing_yet() -> None:
    store = Store()
    store.offer(message(seq=3))
    store.peer.close()
    store.presence.update(store.utc_us)
    store.peer = store.hub.connect(agent_name(2))
    store.offer(
        *(replace(message(seq=seq, boot_id=3, propose=False), sent_utc_us=UTC_US + seq * 50_000) for seq in (4, 5, 6))
    )
    assert store.peers.newest[2].boot_id == 3
    assert acknowledgements(store.peers.newest, frozenset()) == {}


def test_a_trajectory_that_begins_in_the_far_future_is_refused() -> None:
    store = Store()
    store.peers.offer(agent_name(2), encode_trajectory_message(message()), UTC_US - 11_000_000)
    assert store.refusals.by_reason == {"future": 1} and store.peers.newest == {}
    store.peers.offer(agent_name(2), encode_trajectory_message(message()), UTC_US - 9_000_000)
    assert store.peers.newest[2].seq == 1


def test_a_trajectory_rests_before_and_after_itself_and_is_smooth_between() -> None:
    path = trajectory()
    times = np.arange(UTC_US - 200_000, path.end_utc_us + 300_000, 1_000)
    pos, vel = path.sample(times)
    np.testing.assert_array_equal(pos[-1], path.pos_ned_m[-1])
    assert not vel[-1].any() and not vel[0].any()
    inside = (times > UTC_US) & (times < path.end_utc_us)
    np.testing.assert_allclose((np.gradient(pos, 1e-3, axis=0) - vel)[inside][2:-2], 0.0, atol=5e-3)
    np.testing.assert_allclose(
        path.acceleration(UTC_US + 300_000), -1.5 * vel[400] / np.linalg.norm(vel[400]), atol=0.02
    )


def test_a_trajectory_that_begins_in_motion_was_not_at_rest_before() -> None:
    """Its vehicle has not been accelerated to its first velocity within the step before."""
    path = trajectory()
    braking_m_s2 = -1.5 * path.vel_ned_m_s[0] / np.linalg.norm(path.vel_ned_m_s[0])
    for after_us in (0, 20_000, 40_000, 60_000):
        np.testing.assert_allclose(path.acceleration(UTC_US + after_us), braking_m_s2, atol=0.05)
    assert not path.acceleration(UTC_US - 100_000).any()
    assert not path.acceleration(path.end_utc_us + 100_000).any()


def test_a_proposal_leaves_the_committed_trajectory_and_ends_at_rest() -> None:
    first = trajectory()
    branch_us = UTC_US + 237_000
    pos, vel = first.sample(branch_us + np.arange(5) * 100_000)
    then = ending_at_rest(branch_us, 100_000, pos + np.linspace(0, 0.3, 5)[:, None], vel, brake_m_s2=1.5)
    whole = joined(first, then, UTC_US + 120_000)
    early = np.arange(UTC_US + 120_000, branch_us, 5_000)
    np.testing.assert_allclose(whole.sample(early)[0], first.sample(early)[0], atol=1e-3)
    assert not whole.vel_ned_m_s[-1].any()
    np.testing.assert_array_equal(whole.pos_ned_m[-1], whole.pos_ned_m[-2])  # nobody sees it move on
    assert joined(resting(pos[0], UTC_US, 100_000), replace(then), branch_us).t0_utc_us == branch_us


def test_a_proposal_just_after_the_begin_goes_on_as_the_vehicle_moves() -> None:
    first = trajectory()
    branch_us = UTC_US + 60_000
    pos, vel = first.sample(branch_us + np.arange(5) * 100_000)
    whole = joined(first, ending_at_rest(branch_us, 100_000, pos, vel, brake_m_s2=1.5), UTC_US)
    until_then = np.arange(UTC_US, branch_us, 5_000)
    np.testing.assert_allclose(whole.sample(until_then)[0], first.sample(until_then)[0], atol=2e-3)
    np.testing.assert_allclose(whole.sample(until_then)[1], first.sample(until_then)[1], atol=0.1)


def test_sampling_one_time_equals_sampling_many() -> None:
    path = trajectory()
    for t_us in np.arange(UTC_US - 200_000, path.end_utc_us + 300_000, 7_001):
        pos, vel = path.sample(np.array([t_us]))
        np.testing.assert_allclose(path.at(float(t_us))[0], pos[0], atol=1e-9)
        np.testing.assert_allclose(path.at(float(t_us))[1], vel[0], atol=1e-6)


def test_a_repeated_trajectory_is_the_same_object_again() -> None:
    store = Store()
    store.offer(message(seq=1))
    before = store.peers.newest[2]
    store.offer(replace(message(seq=9, boot_id=4), committed=trajectory(2.0)), message(seq=2))  # a forger between them
    after = store.peers.newest[2]
    assert after.seq == 2 and after.committed is before.committed
    assert before.proposal is not None and after.proposal is not None
    assert after.proposal.trajectory is before.proposal.trajectory
    store.offer(replace(message(seq=3), committed=trajectory(1.0)))
    assert store.peers.newest[2].committed is not before.committed


def test_two_agents_of_a_process_have_one_message_by_the_clock_of_each() -> None:
    """What they share can't be changed by one of them."""
    payload = encode_trajectory_message(message())
    one, other = decode_trajectory_message(payload), decode_trajectory_message(payload, {}, 400_000, 30)
    assert one is not None and other is not None and one.proposal is not None and other.proposal is not None
    assert (one.committed.t0_utc_us, one.committed.clock_error_us) == (UTC_US, 0)
    assert (other.committed.t0_utc_us, other.committed.clock_error_us) == (UTC_US - 400_000, 30)
    assert other.proposal.trajectory.t0_utc_us == one.proposal.trajectory.t0_utc_us - 400_000
    assert (other.proposal.number, other.sent_utc_us) == (one.proposal.number, one.sent_utc_us)
    for shared in (one.committed.pos_ned_m, other.proposal.trajectory.vel_ned_m_s):
        with pytest.raises(ValueError, match="read-only"):
            shared += 1.0


def test_trajectories_of_a_peer_with_another_clock_are_converted_to_ours() -> None:
    store = Store()
    ahead_us = 400_000
    for seq in range(1, 6):
        stamp_us = store.utc_us + 20_000 + ahead_us  # sent and received in one tick
        answered = replace(message(seq=seq, propose=False), sent_utc_us=stamp_us, heard={1: (store.utc_us, stamp_us)})
        store.offer(replace(answered, committed=replace(trajectory(), t0_utc_us=UTC_US + ahead_us)))
    assert store.clocks.ahead_us(2) == pytest.approx(ahead_us, abs=20_000)
    assert store.peers.newest[2].committed.t0_utc_us == UTC_US + ahead_us - store.clocks.ahead_us(2)
    kept = store.peers.newest[2].committed
    store.offer(replace(answered, seq=6, committed=replace(trajectory(), t0_utc_us=UTC_US + ahead_us)))
    assert store.peers.newest[2].committed is kept, "by which the protocol knows that it has checked it"


def test_trajectories_say_how_well_the_clock_of_their_sender_is_known() -> None:
    store = Store()
    store.offer(message(seq=1, propose=False))
    assert store.peers.newest[2].committed.clock_error_us == MAX_CLOCK_ERROR_US
    for seq in range(2, 6):
        stamp_us = store.utc_us + 20_000
        store.offer(replace(message(seq=seq), sent_utc_us=stamp_us, heard={1: (store.utc_us, stamp_us)}))
    for received in store.peers.newest[2].trajectories:
        assert received.clock_error_us == store.clocks.error_us(2) <= 20_000


def test_trajectories_say_so_when_the_clock_of_their_sender_is_known_less_well() -> None:
    """Its messages take longer and longer, as on a link that fills up."""
    store = Store()
    for seq in range(1, 40):
        stamp_us = store.utc_us + 20_000 - 2_000 * seq  # sent so long before it is received
        answered = {1: (stamp_us, stamp_us)}
        store.offer(replace(message(seq=seq, propose=False), sent_utc_us=stamp_us, heard=answered))
    told_us = store.peers.newest[2].committed.clock_error_us
    assert told_us > 5_000
    assert told_us * 1.6 > store.clocks.error_us(2)


@pytest.mark.parametrize(("after_s", "spread_m"), [(0.0, 0.075), (1.0, 0.075), (3.1, 0.0)])
def test_an_error_of_the_clock_is_worth_as_much_as_the_vehicle_moves_in_it(after_s: float, spread_m: float) -> None:
    moving = np.tile([0.0, 1.5, 0.0], (21, 1))
    points = np.cumsum(moving, axis=0) * 0.1
    flown = ending_at_rest(UTC_US, 100_000, points, moving, brake_m_s2=1.5)
    assert flown.spread_m(UTC_US) == 0.0
    by_wrong_clock = replace(flown, clock_error_us=50_000)
    assert by_wrong_clock.spread_m(UTC_US + round(1e6 * after_s)) == pytest.approx(spread_m, abs=0.008)
