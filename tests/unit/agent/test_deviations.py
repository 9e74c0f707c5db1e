"""Which peers are seen to fly elsewhere than they have committed to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from swarmctl.agent.sensing.deviations import Deviations
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import Proposal
from swarmctl.core.types import PredictedPath
from tests import builders

ALLOWED_M, NOW_US = 0.2, 1_000_000


def trajectory(north_m: float) -> Trajectory:
    """Rest at a place."""
    pos = np.tile([north_m, 0.0, -3.0], (2, 1))
    return Trajectory(t0_utc_us=0, dt_us=100_000, pos_ned_m=pos, vel_ned_m_s=np.zeros((2, 3)))


def path(north_m: float, t0_utc_us: int = NOW_US) -> PredictedPath:
    pos = np.tile([north_m, 0.0, -3.0], (41, 1))
    return builders.predicted_path(pos_ned_m=pos, t0_utc_us=t0_utc_us)


def is_deviating(
    deviations: Deviations, there: PredictedPath, *followed: Trajectory, is_committed: bool = True
) -> bool:
    message = builders.trajectory_message(committed=followed[0], agent=there.agent, is_committed=is_committed)
    if len(followed) > 1:
        proposal = Proposal(number=1, made_utc_us=0, agent=there.agent, trajectory=followed[1])
        message = replace(message, proposal=proposal)
    return deviations.deviating([there], {there.agent: message}, NOW_US, ALLOWED_M) == {there.agent}


def test_a_peer_deviates_that_is_near_none_of_its_trajectories() -> None:
    here, there = trajectory(0.0), trajectory(1.0)
    assert not is_deviating(Deviations(), path(0.1), here)
    assert is_deviating(Deviations(), path(0.3), here)
    assert is_deviating(Deviations(), path(0.9), here)
    assert not is_deviating(Deviations(), path(0.9), here, there)


def test_what_was_compared_is_compared_again_when_the_path_or_a_trajectory_is_new() -> None:
    deviations, here, there = Deviations(), trajectory(0.0), trajectory(1.0)
    near, far = path(0.1), path(0.9)
    assert not is_deviating(deviations, near, here)
    assert is_deviating(deviations, far, here)
    assert not is_deviating(deviations, far, here, there)
    assert is_deviating(deviations, far, here)
    assert not is_deviating(deviations, far, there)


@pytest.mark.parametrize(("age_us", "is_committed"), [(400_000, True), (0, False)])
def test_old_paths_and_who_commits_to_nothing_are_not_compared(age_us: int, is_committed: bool) -> None:
    assert not is_deviating(Deviations(), path(9.0, NOW_US - age_us), trajectory(0.0), is_committed=is_committed)
