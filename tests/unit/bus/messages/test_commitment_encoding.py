"""Trajectory messages byte by byte: every field is read as it was sent, and what is no message is refused."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from swarmctl.bus.messages.commitment_messages import (
    MAX_PEERS,
    TRAJECTORY_VERSION,
    HeardTimes,
    Memory,
    decode_trajectory_message,
    encode_trajectory_message,
)
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Exclusions, Proposal, Reach, TrajectoryMessage
from tests import builders

UTC_US = 1_700_000_000_000_000
EARLIER_US = UTC_US - 40_000
MAGIC, VERSION, FLAGS = 0, 2, 3  # offsets
HAS_PROPOSAL, IS_COMMITTED, ASKS_FAR = 1, 2, 4


def resting_at(north_m: float) -> Trajectory:
    pos = np.tile((north_m, 1.0, -2.0), (5, 1))
    return Trajectory(t0_utc_us=UTC_US, dt_us=100_000, pos_ned_m=pos, vel_ned_m_s=np.zeros((5, 3)))


def message() -> TrajectoryMessage:
    proposal = Proposal(number=77, made_utc_us=UTC_US + 5, agent=2, trajectory=resting_at(8.0))
    return builders.trajectory_message(
        agent=2, boot_id=9, seq=1, sent_utc_us=UTC_US, committed=resting_at(3.0), tube_m=0.25, proposal=proposal
    )


def decoded(
    sent: TrajectoryMessage, memory: Memory | None = None, ahead_us: int = 0, error_us: int = 0
) -> TrajectoryMessage:
    found = decode_trajectory_message(encode_trajectory_message(sent), memory, ahead_us, error_us)
    assert found is not None
    return found


def test_what_is_proposed_is_not_what_is_committed() -> None:
    found = decoded(message())
    assert found.proposal is not None
    assert (found.committed.pos_ned_m[0, 0], found.proposal.trajectory.pos_ned_m[0, 0]) == (3.0, 8.0)


@pytest.mark.parametrize("is_committed", [True, False])
def test_who_has_committed_to_nothing_yet_says_so(is_committed: bool) -> None:
    assert decoded(replace(message(), is_committed=is_committed)).is_committed is is_committed


@pytest.mark.parametrize("ahead_us", [-40_000, 0, 40_000])
def test_all_see_proposals_in_one_order_whatever_they_know_of_the_proposers_clock(ahead_us: int) -> None:
    """The older proposal has precedence: two that order them differently would acknowledge both."""
    found = decoded(message(), ahead_us=ahead_us, error_us=300)
    assert found.proposal is not None
    assert found.proposal.order == (UTC_US + 5, 2)
    for trajectory in (found.committed, found.proposal.trajectory):
        assert (trajectory.t0_utc_us, trajectory.clock_error_us) == (UTC_US - ahead_us, 300)


def test_one_message_has_the_same_bytes_in_whichever_order_it_was_put_together() -> None:
    """One sequence number with other bytes is taken for a forgery."""
    one, other = (
        replace(
            message(),
            acknowledged={agent: agent for agent in agents},
            heard=dict.fromkeys(agents, (EARLIER_US, UTC_US)),
            exclusions=Exclusions(suspected=frozenset(agents), promised=frozenset(agents)),
            reach=Reach(far=frozenset(agents)),
        )
        for agents in ((0, 8, 16), (16, 8, 0))
    )
    assert list(one.reach.far) != list(other.reach.far), "control: sets of one content in two orders"
    assert encode_trajectory_message(one) == encode_trajectory_message(other)


@pytest.mark.parametrize(
    ("offset", "value"),
    [
        (MAGIC, ord("s")),
        (MAGIC + 1, ord("P")),  # predicted paths begin like this
        (VERSION, TRAJECTORY_VERSION - 1),
        (VERSION, TRAJECTORY_VERSION + 1),
        (FLAGS, 8 | IS_COMMITTED | HAS_PROPOSAL),
        (FLAGS, 128 | ASKS_FAR | IS_COMMITTED | HAS_PROPOSAL),
    ],
)
def test_another_magic_version_or_flag_is_refused(offset: int, value: int) -> None:
    payload = bytearray(encode_trajectory_message(message()))
    assert decode_trajectory_message(bytes(payload)) is not None
    payload[offset] = value
    assert decode_trajectory_message(bytes(payload)) is None


def test_more_than_the_counted_numbers_is_refused() -> None:
    """Four bytes more are an agent more that is far, of whom the count knows nothing."""
    assert decode_trajectory_message(encode_trajectory_message(message()) + struct.pack("<I", 3)) is None


@pytest.mark.parametrize(("count", "fits"), [(MAX_PEERS, True), (MAX_PEERS + 1, False)])
def test_the_numbers_of_those_that_are_heard_and_of_those_that_are_far_are_bounded(count: int, fits: bool) -> None:
    heard = dict.fromkeys(range(count), (EARLIER_US, UTC_US))
    for sent in (replace(message(), heard=heard), replace(message(), reach=Reach(far=frozenset(range(count))))):
        assert (decode_trajectory_message(encode_trajectory_message(sent)) is not None) is fits


def test_a_memory_holds_no_more_than_the_trajectories_of_the_last_message() -> None:
    """What is repeated is the same object, and what is not is forgotten: agents fly for hours."""
    memory = Memory()
    first = decoded(message(), memory)
    second = decoded(replace(message(), seq=2), memory)
    assert second.committed is first.committed
    assert second.proposal is not None and first.proposal is not None
    assert second.proposal.trajectory is first.proposal.trajectory
    for seq in range(3, 9):
        last = decoded(replace(message(), seq=seq, committed=resting_at(float(seq)), proposal=None), memory)
        assert [*memory.values()] == [last.committed]


def test_what_was_heard_longest_ago_is_told_by_arrivals() -> None:
    """How old what someone has heard can be is by when it came, not by the senders' clocks."""
    heard = {0: (EARLIER_US - 900, UTC_US - 3), 1: (UTC_US, UTC_US - 70), 4: (EARLIER_US - 950, UTC_US - 1)}
    found = decoded(replace(message(), heard=heard)).heard
    assert isinstance(found, HeardTimes)
    assert found.oldest_us == UTC_US - 70
    assert HeardTimes(b"").oldest_us == 0, "nobody was heard"


def test_what_was_heard_is_found_in_whichever_order_it_was_sent() -> None:
    agents = (0x01010101, 65_536, 256, 5, 1, 0)
    encoded = b"".join(struct.pack("<Iqq", agent, 256 * agent, agent) for agent in agents)
    heard = HeardTimes(encoded)
    assert {agent: heard.get(agent) for agent in (*agents, 2, 512)} == {
        **{agent: (256 * agent, agent) for agent in agents},
        2: None,
        512: None,
    }
    assert [*heard] == [*agents]
