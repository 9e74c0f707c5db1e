"""Commitments of one or two agents: proposals, acknowledgements, evasions, and what is flown of them."""

from __future__ import annotations

import gc
from collections.abc import Sequence

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOut, KeepOuts
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit import trajectory_planner
from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.reference.quintic import quintic_to
from swarmctl.core.trajectory import Trajectory, ending_at_rest, resting
from swarmctl.core.trajectory_message import Proposal, TrajectoryMessage
from swarmctl.core.types import Array, Sampled
from tests import builders
from tests.benches.committing_agents import HARD_MIN_M, UTC_US, Crowd, Network, committing, grid_steps


def test_of_two_proposals_in_conflict_the_earlier_one_is_flown() -> None:
    crowd = Crowd(2, Network(delay_us=(100_000, 100_000)))
    crowd.run(6.0)
    assert all(agent.counts.committed > 3 for agent in crowd.agents)
    assert sum(agent.counts.withdrawn for agent in crowd.agents) > 0


def at_goal(offsets_s: Array) -> tuple[Array, Array]:
    return np.tile([1.0, 0.0, -2.0], (len(offsets_s), 1)), np.zeros((len(offsets_s), 3))


def meeting() -> tuple[Commitments, Commitments]:
    """Return two agents that fly one behind the other at 1.5 m/s, 1 m apart, each on its committed trajectory."""
    pair = []
    for i, x_m in enumerate((0.0, -1.0)):
        agent = committing(i, max_keep_outs=2)
        points = np.array([[x_m + 0.15 * k, 0.0, -2.0] for k in range(21)])
        agent.committed = ending_at_rest(UTC_US, 100_000, points, np.tile([1.5, 0.0, 0.0], (21, 1)), brake_m_s2=1.5)
        pair.append(agent)
    return pair[0], pair[1]


def message_of(agent: Commitments, number: int) -> dict[int, TrajectoryMessage]:
    assert agent.committed is not None
    return {
        number: builders.trajectory_message(
            agent=number, sent_utc_us=UTC_US, committed=agent.committed, proposal=agent.proposal
        )
    }


def wall(x_m: float, agent: Commitments) -> KeepOut:
    return builders.keep_out(pos_ned_m=np.tile([x_m, 0.0, -2.0], (grid_steps(agent) + 1, 1)), priority_id=-1)


def test_an_evasion_is_found_by_the_peer_it_conflicts_with() -> None:
    first, second = meeting()
    assert second.conflicting_peers(UTC_US, message_of(first, 0)) == set()
    first.evade(
        builders.situation(utc_us=UTC_US, begin_us=UTC_US, desired=DesiredReference(at_goal), others=[wall(1.6, first)])
    )
    assert first.counts.evasive == 1, "before a wall there is no time for acknowledgements"
    assert second.conflicting_peers(UTC_US, message_of(first, 0)) == {0}
    assert second.conflicting_peers(UTC_US, message_of(first, 0)) == {0}, "as long as it does"


@pytest.mark.parametrize("followed", [True, False], ids=["", "control: nobody follows"])
def test_before_what_is_merely_doubted_nothing_is_evaded_to_that_conflicts_with_what_is_known(followed: bool) -> None:
    """Who is silent may fly as it has committed to; who is behind certainly does."""
    first, second = meeting()
    now = builders.situation(
        utc_us=UTC_US,
        begin_us=UTC_US,
        desired=DesiredReference(at_goal),
        peers=message_of(second, 1) if followed else {},
    )
    first.evade_doubted(now, KeepOuts([wall(1.6, first)]))
    assert first.counts.evasive == (0 if followed else 1)


DT_US = 70_000  # of nobody else's trajectories


def test_who_rests_forgets_what_its_peers_do_not_fly_any_more() -> None:
    """An agent that is hemmed in for minutes hears ten commitments a second of each of its peers."""
    agent, peer = meeting()
    agent.end(np.array([0.0, 30.0, -2.0]), UTC_US)
    for k in range(200):
        peer.committed = resting(np.array([0.01 * k, 0.0, -2.0]), UTC_US + 100_000 * k, DT_US)
        assert agent.conflicting_peers(UTC_US + 100_000 * k, message_of(peer, 1)) == set()
    kept = [found for found in gc.get_objects() if isinstance(found, Trajectory) and found.dt_us == DT_US]
    assert len(kept) <= 2


def test_a_wall_that_leaves_time_for_acknowledgements_triggers_no_evasion() -> None:
    first, _ = meeting()
    first.evade(
        builders.situation(utc_us=UTC_US, begin_us=UTC_US, desired=DesiredReference(at_goal), others=[wall(2.6, first)])
    )
    assert first.counts.evasive == 0


def test_an_agent_at_rest_evades_what_approaches() -> None:
    """A stop would change nothing: it rests already."""
    agent = committing(0, max_keep_outs=2)
    agent.begin(np.array([0.0, 0.0, -2.0]), np.zeros(3), UTC_US)
    times_s = 0.1 * np.arange(grid_steps(agent) + 1)
    coming = np.stack([2.5 - 1.0 * times_s, 0.3 + 0.0 * times_s, -2.0 + 0.0 * times_s], axis=1)
    agent.evade(
        builders.situation(
            utc_us=UTC_US,
            begin_us=UTC_US,
            desired=DesiredReference(at_goal),
            peers={},
            others=[builders.keep_out(pos_ned_m=coming)],
        )
    )
    assert agent.counts.evasive == 1
    assert agent.committed is not None
    apart = agent.committed.sample(UTC_US + times_s * 1e6)[0] - coming
    assert np.linalg.norm(apart, axis=1).min() > 0.5, "it would have been 0.3 m"


@pytest.mark.parametrize(("column", "passes_m"), [(False, 0.9), (True, 0.1)], ids=["ball", "control: column"])
def test_an_agent_that_is_enclosed_evades_upwards(column: bool, passes_m: float) -> None:
    """Peers rest on the three other sides, so the only evasive trajectory is a climb."""
    agent = committing(0, max_keep_outs=5)
    agent.begin(np.array([0.0, 0.0, -2.0]), np.zeros(3), UTC_US)
    sides = [[0.0, 0.9, -2.0], [0.0, -0.9, -2.0], [-0.9, 0.0, -2.0]]
    peers = {
        i: builders.trajectory_message(agent=i, sent_utc_us=UTC_US, committed=resting(np.array(side), UTC_US, 100_000))
        for i, side in enumerate(sides, start=1)
    }
    times_s = 0.1 * np.arange(grid_steps(agent) + 1)
    coming = np.stack([3.5 - 1.0 * times_s, 0.0 * times_s, -2.0 + 0.0 * times_s], axis=1)
    agent.evade(
        builders.situation(
            utc_us=UTC_US,
            begin_us=UTC_US,
            desired=DesiredReference(at_goal),
            peers=peers,
            others=[
                builders.keep_out(
                    pos_ned_m=coming, radius_m=1.0, hard_min_distance_m=0.9, any_height=column, priority_id=-1
                )
            ],
        )
    )
    assert agent.committed is not None
    pos = agent.committed.sample(UTC_US + times_s * 1e6)[0]
    apart = np.linalg.norm((pos - coming)[:, : 2 if column else 3], axis=1)
    assert (apart.min() >= passes_m) is not column
    assert np.linalg.norm(pos[:, None] - np.array(sides), axis=2).min() >= HARD_MIN_M


def along(corners: Array) -> Sampled:
    """Return a path through corners (K, 2) at 1 m/s."""
    reached_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])

    def sample(offsets_s: Array) -> tuple[Array, Array]:
        x, y = (np.interp(offsets_s, reached_m, corners[:, i]) for i in (0, 1))
        leg = np.clip(np.searchsorted(reached_m, offsets_s, side="right") - 1, 0, len(corners) - 2)
        unit = np.diff(corners, axis=0)[leg] / np.diff(reached_m)[leg, None]
        return np.stack([x, y, 0.0 * x - 2.0], axis=1), np.column_stack([unit, 0.0 * x])

    return sample


def posts(north_m: float, easts_m: Sequence[float], steps: int) -> list[KeepOut]:
    """Return a wall of posts that nobody moves, known for so many steps of a plan."""
    return [
        builders.keep_out(
            pos_ned_m=np.tile([north_m, east_m, -2.0], (steps + 1, 1)),
            radius_m=0.375,
            hard_min_distance_m=0.275,
            any_height=True,
            priority_id=-1,
        )
        for east_m in easts_m
    ]


@pytest.mark.parametrize(("follows_path", "passes"), [(True, True), (False, False)])
def test_plans_along_a_path_are_linearised_around_it(follows_path: bool, passes: bool) -> None:
    """The last plan leads north before a wall, the path south through a gap: rows of one exclude the other."""
    small = SeparationParams(radius_m=0.3, body_m=0.15)
    agent = committing(0, max_keep_outs=5, separation=small)
    to_north = quintic_to(np.array([0.0, 0.0, -2.0]), np.zeros(3), np.array([0.1, 0.9, -2.0]), 1.0, accel_m_s2=1.0)
    agent.committed = ending_at_rest(UTC_US, 100_000, *to_north.sample(np.arange(0.0, 2.1, 0.1)), brake_m_s2=1.5)
    wall = posts(0.8, (0.3, 0.6, 0.9, 1.2), grid_steps(agent))
    path = along(np.array([[0.0, 0.0], [0.8, -0.4], [3.0, -0.4]]))
    agent.propose(
        builders.situation(
            utc_us=UTC_US,
            begin_us=UTC_US + agent.lead_us,
            desired=DesiredReference(path, follows_path),
            peers={},
            others=wall,
        )
    )
    assert agent.proposal is not None
    assert bool(agent.proposal.trajectory.pos_ned_m[-1, 0] > 1.0) is passes, "behind the wall"


@pytest.mark.parametrize("runs_up", [True, False], ids=["", "control: at the speed of the path at once"])
def test_a_path_from_rest_begins_at_the_own_speed(runs_up: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A path at 1 m/s is past the corner before the agent is: rows of the next corner let its plan cut this one."""
    if not runs_up:
        monkeypatch.setattr(trajectory_planner, "with_run_up", lambda desired, speed_m_s: desired)
    small = SeparationParams(radius_m=0.3, body_m=0.15)
    agent = committing(0, max_keep_outs=3, separation=small)
    here = np.array([2.716, 2.764, -2.0])
    agent.begin(here, np.zeros(3), UTC_US)
    wall = posts(3.0, (2.802, 2.502, 2.202), grid_steps(agent))
    path = along(np.array([here[:2], [2.77, 3.14], [3.21, 3.25], [4.19, 3.06]]))
    agent.propose(
        builders.situation(
            utc_us=UTC_US,
            begin_us=UTC_US + agent.lead_us,
            desired=DesiredReference(path, follows_path=True),
            peers={},
            others=wall,
        )
    )
    assert (agent.proposal is not None) is runs_up
    if agent.proposal is not None:
        assert agent.proposal.trajectory.pos_ned_m[-1, 0] > 3.4, "behind the wall"


def proposing() -> tuple[Commitments, Proposal]:
    agent = committing(0, max_keep_outs=2)
    agent.begin(np.array([0.0, 0.0, -2.0]), np.zeros(3), UTC_US)
    agent.propose(
        builders.situation(
            utc_us=UTC_US, begin_us=UTC_US + agent.lead_us, desired=DesiredReference(at_goal), peers={}, others=()
        )
    )
    assert agent.proposal is not None
    return agent, agent.proposal


def acknowledging(number: int) -> dict[int, TrajectoryMessage]:
    return {
        1: builders.trajectory_message(
            sent_utc_us=UTC_US, committed=resting(np.array([9.0, 0.0, 0.0]), UTC_US, 100_000), acknowledged={0: number}
        )
    }


@pytest.mark.parametrize(("off", "commits"), [(0, 1), (1, 0), (-1, 0)])
def test_an_acknowledgement_counts_for_its_proposal_only(off: int, commits: int) -> None:
    agent, proposal = proposing()
    agent.update(UTC_US + 20_000, acknowledging(proposal.number + off), {1})
    assert agent.counts.committed == commits


def test_what_a_proposal_was_clear_of_is_not_compared_with_the_commitment_it_becomes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    agent, proposal = proposing()
    answer = acknowledging(proposal.number)
    agent.update(UTC_US + 20_000, answer, {1})
    compared: list[int] = []
    monkeypatch.setattr(TrajectoryPlanner, "conflicts", lambda self, own, utc_us, known: compared.append(len(known)))
    assert agent.conflicting_peers(UTC_US + 20_000, answer) == set()
    assert compared == []
    evasion = {1: builders.trajectory_message(committed=resting(np.array([9.0, 0.0, 0.0]), UTC_US, 100_000))}
    agent.conflicting_peers(UTC_US + 40_000, evasion)
    assert compared == [1], "another trajectory is, also where its points are the same"


def test_an_acknowledgement_after_the_lead_is_too_late() -> None:
    agent, proposal = proposing()
    agent.update(UTC_US + agent.lead_us + 1, acknowledging(proposal.number), {1})
    assert (agent.counts.committed, agent.counts.expired, agent.proposal) == (0, 1, None)


def test_commitments_that_are_too_close_already_do_not_creep_closer() -> None:
    """Each ends 5 mm nearer than it begins, which the tolerance of plans would allow again and again."""
    agent, _ = proposing()
    other = resting(np.zeros(3), UTC_US, 100_000)
    for k in range(10):
        x_m = HARD_MIN_M - 0.01 - 0.005 * k
        nearer = np.array([[x_m, 0.0, 0.0], [x_m - 0.005, 0.0, 0.0]])
        assert agent._planner.conflicts(
            Trajectory(t0_utc_us=UTC_US, dt_us=100_000, pos_ned_m=nearer, vel_ned_m_s=np.zeros((2, 3))), UTC_US, [other]
        )
        assert not agent._planner.conflicts(
            Trajectory(t0_utc_us=UTC_US, dt_us=100_000, pos_ned_m=nearer[::-1], vel_ned_m_s=np.zeros((2, 3))),
            UTC_US,
            [other],
        )


def test_what_is_not_a_number_conflicts() -> None:
    agent, _ = proposing()
    bad = Trajectory(t0_utc_us=UTC_US, dt_us=100_000, pos_ned_m=np.full((2, 3), np.nan), vel_ned_m_s=np.zeros((2, 3)))
    assert agent._planner.conflicts(bad, UTC_US, [resting(np.zeros(3), UTC_US, 100_000)])


def test_a_slow_network_lengthens_the_lead_and_a_fast_one_shortens_it_again() -> None:
    crowd = Crowd(2, Network(delay_us=(250_000, 250_000)))
    before_us = crowd.agents[0].lead_us
    crowd.run(4.0)
    slow_us = crowd.agents[0].lead_us
    crowd.network.delay_us = (0, 0)
    crowd.run(8.0)
    assert before_us < 0.3 * slow_us
    assert slow_us > 450_000
    assert crowd.agents[0].lead_us < 0.5 * slow_us


def on_the_way() -> Commitments:
    """Return an agent that has committed to 1.5 m/s northwards, for 2 s and the braking after them."""
    agent = committing(0, max_keep_outs=1)
    points = np.array([[0.15 * k, 0.0, -2.0] for k in range(21)])
    agent.committed = ending_at_rest(UTC_US, 100_000, points, np.tile([1.5, 0.0, 0.0], (21, 1)), brake_m_s2=1.5)
    return agent


def flown_m(agent: Commitments, utc_us: int) -> float:
    assert agent.flown is not None
    return agent.flown.at(utc_us)[0][0]


def test_what_is_flown_waits_for_a_vehicle_that_lags_and_is_not_made_up_for() -> None:
    agent, now_us, north_m = on_the_way(), UTC_US + 400_000, 0.3
    committed, ahead_m = agent.committed, []
    for k in range(50):
        now_us += 20_000
        north_m += 0.03 * (k >= 20)  # it stands for a while, then flies as fast as it was committed to
        agent.wait_for(np.array([north_m, 0.0, -2.0]), now_us, 20_000, 0.1)
        ahead_m.append(flown_m(agent, now_us) - north_m)
    assert ahead_m[:20] == pytest.approx([0.3] * 20, abs=1e-6), "it stands where it was, and never goes back"
    assert ahead_m[-1] == pytest.approx(0.1, abs=0.01)
    assert agent.committed is committed, "peers rely on it"


def test_a_vehicle_that_lags_within_what_is_allowed_is_not_waited_for() -> None:
    agent = on_the_way()
    agent.wait_for(np.array([0.55, 0.3, -2.0]), UTC_US + 400_000, 20_000, 0.1)
    assert agent.flown is agent.committed


def test_a_late_agent_proposes_from_where_it_is_and_is_on_time_once_that_is_committed() -> None:
    agent, now_us = on_the_way(), UTC_US + 400_000
    agent.wait_for(np.array([0.0, 0.0, -2.0]), now_us, 200_000, 0.0)
    assert flown_m(agent, now_us) == pytest.approx(0.3)
    begin_us = now_us + agent.lead_us
    where_m = flown_m(agent, begin_us)
    agent.propose(builders.situation(utc_us=now_us, begin_us=begin_us, desired=DesiredReference(at_goal)))
    agent.wait_for(np.array([0.0, 0.0, -2.0]), now_us + 20_000, 20_000, 0.0)
    agent.update(now_us + 20_000, {}, set())
    assert agent.counts.committed == 1
    assert agent.committed is not None
    assert agent.committed.at(begin_us)[0][0] == pytest.approx(where_m, abs=1e-3)
    assert flown_m(agent, begin_us) == pytest.approx(where_m - 0.03, abs=2e-3), "20 ms were lost in the meantime"
