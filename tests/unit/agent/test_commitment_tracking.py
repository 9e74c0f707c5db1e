"""What follows where a vehicle does not follow what it has committed to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from swarmctl.agent.planning.commitment_tracking import CommitmentTracking
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.protocol import Commitments
from swarmctl.core.trajectory import Trajectory, resting
from swarmctl.core.types import Array
from tests.builders import vehicle_state

TUBE_M, TICK_US = 0.2, 20_000
OFF_M = 0.4  # less than what counts as far outside


class Rests:
    """A planner that stops at once."""

    dt_us = 100_000

    def stopping_from(self, pos_ned_m: Array, vel_ned_m_s: Array, utc_us: int) -> Trajectory:
        return resting(pos_ned_m, utc_us, self.dt_us)


@pytest.mark.parametrize(("speed_m_s", "anew"), [(0.0, True), (0.5, False)], ids=["rests", "moves"])
def test_who_rests_beside_its_commitment_commits_to_where_it_is(speed_m_s: float, anew: bool) -> None:
    planner: Any = Rests()
    commitments = Commitments(0, CommitParams(), planner)
    commitments.begin(np.zeros(3), np.zeros(3), 0)
    tracking = CommitmentTracking(commitments, TUBE_M, lambda *_, **__: None)
    state = vehicle_state(pos_ned_m=np.array([OFF_M, 0.0, 0.0]), vel_ned_m_s=np.array([0.0, speed_m_s, 0.0]))
    for k in range(200):
        tracking.watch(k * TICK_US, TICK_US, state, k * TICK_US)
    assert commitments.committed is not None
    assert bool(commitments.committed.pos_ned_m[-1][0] == OFF_M) is anew
