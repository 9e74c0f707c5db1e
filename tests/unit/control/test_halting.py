"""Stops along the own commitment: where they go, how hard they brake, and beside what of others they are allowed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.halting import halted, places_apart_m
from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.core.trajectory import Trajectory, ending_at_rest
from swarmctl.core.trajectory_message import Proposal
from swarmctl.core.types import Array
from tests import builders
from tests.benches.committing_agents import HARD_MIN_M, UTC_US, committing, grid_steps

STEP_US, SPEED_M_S, HEIGHT_M = 100_000, 1.5, 2.0
BRAKE_M_S2 = CommitParams().brake_m_s2


def straight(begin: tuple[float, float], heading_deg: float, *, since_us: int = 0, length: int = 21) -> Trajectory:
    """Return a commitment to fly straight on at 1.5 m/s for 2 s, then to brake."""
    heading = math.radians(heading_deg)
    vel = SPEED_M_S * np.array([math.cos(heading), math.sin(heading), 0.0])
    points = np.array([*begin, -HEIGHT_M]) + 0.1 * np.arange(length)[:, None] * vel
    return ending_at_rest(UTC_US + since_us, STEP_US, points, np.tile(vel, (length, 1)), brake_m_s2=BRAKE_M_S2)


def turning() -> Trajectory:
    """Return a commitment to fly a quarter of a circle of 1.5 m radius."""
    angle = np.arange(17) * 0.1
    pos = np.stack([1.5 * np.sin(angle), 1.5 - 1.5 * np.cos(angle), np.full(17, -HEIGHT_M)], 1)
    vel = SPEED_M_S * np.stack([np.cos(angle), np.sin(angle), np.zeros(17)], 1)
    return ending_at_rest(UTC_US, STEP_US, pos, vel, brake_m_s2=BRAKE_M_S2)


@pytest.mark.parametrize("committed", [straight((0.0, 0.0), 30.0), turning()], ids=["straight", "turning"])
@pytest.mark.parametrize("after_us", [0, 130_000, 600_000])
def test_a_stop_passes_no_other_places_and_brakes_no_harder_than_it_says(committed: Trajectory, after_us: int) -> None:
    stop = halted(committed, UTC_US + after_us, UTC_US, STEP_US, BRAKE_M_S2)
    assert stop is not None
    until = UTC_US + np.arange(0, after_us, 10_000)
    if len(until):
        np.testing.assert_allclose(stop.sample(until)[0], committed.sample(until)[0], atol=2e-3)
    own = stop.sample(np.arange(UTC_US, stop.end_utc_us, 10_000))[0]
    passed = committed.sample(np.arange(UTC_US - STEP_US, committed.end_utc_us, 1_000))[0]
    assert np.linalg.norm(own[:, None] - passed[None], axis=2).min(axis=1).max() < 2e-3
    assert not stop.vel_ned_m_s[-1].any()
    speed_m_s = np.linalg.norm(stop.vel_ned_m_s, axis=1)
    assert -np.diff(speed_m_s).min() / 0.1 < BRAKE_M_S2 + 0.05
    way_m = float(np.linalg.norm(np.diff(own, axis=0), axis=1).sum())
    assert way_m == pytest.approx(SPEED_M_S * 1e-6 * after_us + SPEED_M_S**2 / (2 * BRAKE_M_S2), abs=0.05)


def test_who_stands_does_not_stop() -> None:
    committed = straight((0.0, 0.0), 0.0)
    assert halted(committed, committed.end_utc_us, UTC_US, STEP_US, BRAKE_M_S2) is None


def test_places_are_compared_whenever_they_are_passed() -> None:
    own, later = straight((0.0, 0.0), 0.0), straight((1.0, -3.0), 90.0, since_us=3_000_000)
    assert places_apart_m(own, UTC_US, [later], UTC_US, 1.0) < 0.1, "it crosses 4 s after"
    assert places_apart_m(own, UTC_US + 1_500_000, [later], UTC_US, 1.0) == pytest.approx(1.25, abs=0.02)
    assert places_apart_m(own, UTC_US, [], UTC_US, 1.0) == math.inf
    above = straight((0.0, 0.5), 0.0)
    raised = Trajectory(
        t0_utc_us=UTC_US, dt_us=STEP_US, pos_ned_m=above.pos_ned_m - [0, 0, 2.0], vel_ned_m_s=above.vel_ned_m_s
    )
    assert places_apart_m(own, UTC_US, [raised], UTC_US, 1.0) == pytest.approx(math.hypot(0.5, 2.0), abs=0.01)
    assert places_apart_m(own, UTC_US, [raised], UTC_US, 2.0) == pytest.approx(math.hypot(0.5, 1.0), abs=0.01)


def at_goal(offsets_s: Array) -> tuple[Array, Array]:
    return np.tile([9.0, 0.0, -HEIGHT_M], (len(offsets_s), 1)), np.zeros((len(offsets_s), 3))


def before_a_vehicle(
    met: Array, peer: Trajectory, *, proposal: Trajectory | None = None, leaves: bool = False
) -> Commitments:
    """Return an agent that flies north at 1.5 m/s, after it has been told where a silent peer's vehicle may be.

    Args:
        met: position of that vehicle at each step of 0.1 s, (K, 3), or (3,) for one that hovers.
        peer: what its agent has committed to.
        proposal: and what it has proposed.
        leaves: whether the agent may leave its own places.
    """
    agent = committing(0, max_keep_outs=2)
    agent.committed = straight((0.0, 0.0), 0.0)
    made = None if proposal is None else Proposal(number=1, made_utc_us=UTC_US, agent=1, trajectory=proposal)
    now = builders.situation(
        utc_us=UTC_US,
        begin_us=UTC_US,
        desired=DesiredReference(at_goal),
        peers={1: builders.trajectory_message(agent=1, committed=peer, proposal=made)},
    )
    where = met if met.ndim == 2 else np.tile(met, (grid_steps(agent) + 1, 1))
    vehicle = builders.keep_out(
        pos_ned_m=where[: grid_steps(agent) + 1], radius_m=HARD_MIN_M, hard_min_distance_m=HARD_MIN_M, priority_id=1
    )
    agent.stop_before(now, KeepOuts([vehicle]), leaves=leaves)
    return agent


def ahead(north_m: float, east_m: float = 0.0) -> Array:
    return np.array([north_m, east_m, -HEIGHT_M])


ELSEWHERE = straight((-5.0, 5.0), 90.0)
COMES_M_S = 1.5
COMES = ahead(5.0) - 0.1 * COMES_M_S * np.arange(200)[:, None] * np.array([1.0, 0.0, 0.0])  # along the own way


def test_it_stops_before_the_vehicle_of_a_silent_peer() -> None:
    agent = before_a_vehicle(ahead(2.2), ELSEWHERE)
    assert agent.counts.evasive == 1
    assert agent.committed is not None
    assert agent.committed.pos_ned_m[-1, 0] <= 2.2 - HARD_MIN_M
    off_m = agent.committed.pos_ned_m[:, 1:] - ahead(0.0)[1:]
    assert np.abs(off_m).max() < 1e-6, "along its own places"


def test_there_is_time_while_a_later_stop_is_clear() -> None:
    assert before_a_vehicle(ahead(4.5), ELSEWHERE).counts.evasive == 0
    assert before_a_vehicle(ahead(2.2, 9.0), ELSEWHERE).counts.evasive == 0, "nobody is met"


@pytest.mark.parametrize("leaves", [False, True])
@pytest.mark.parametrize("is_proposal", [False, True], ids=["committed", "proposed"])
def test_it_does_not_stop_where_the_peer_may_pass_later(is_proposal: bool, leaves: bool) -> None:
    """It may be alive, and rely on this agent to be gone by then."""
    crossing = straight((0.5, -7.0), 90.0, length=60)
    peer, proposal = (ELSEWHERE, crossing) if is_proposal else (crossing, None)
    assert before_a_vehicle(ahead(2.2), peer, proposal=proposal, leaves=leaves).counts.evasive == 0


def test_of_two_one_leaves_its_places_before_a_vehicle_that_comes_along_them() -> None:
    stops, leaves = (before_a_vehicle(COMES, ELSEWHERE, leaves=leaves) for leaves in (False, True))
    assert closest_m(stops, COMES) < 0.48, "negative control: it flies into who stops"
    assert closest_m(leaves, COMES) >= HARD_MIN_M


def test_places_of_the_fastest_are_looked_at_every_microsecond_at_most() -> None:
    """A step of no time would be divided by."""
    own = straight((0.0, 0.0), 0.0)
    fastest = Trajectory(
        t0_utc_us=UTC_US,
        dt_us=1_000,
        pos_ned_m=np.zeros((2, 3)),
        vel_ned_m_s=np.array([[1e9, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    )
    assert math.isfinite(places_apart_m(own, UTC_US, [fastest], UTC_US, 1.0))


def closest_m(agent: Commitments, vehicle: Array) -> float:
    """Return the least distance of what an agent is committed to from a vehicle, at the same times."""
    assert agent.committed is not None
    own = agent.committed.sample(UTC_US + STEP_US * np.arange(len(vehicle)))[0]
    return float(np.linalg.norm(own - vehicle, axis=1).min())


def test_a_stop_that_would_not_gain_anything_is_not_made() -> None:
    assert before_a_vehicle(ahead(0.3, 0.3), ELSEWHERE).counts.evasive == 0
    assert HARD_MIN_M > 0.5
