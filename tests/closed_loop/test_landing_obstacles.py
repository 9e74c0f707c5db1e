"""Vehicles come down beside an obstacle that is below where one of them would land.

That this fails without the protection is shown by the rows `above-obstacle-*` of the fault matrix.
"""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Landed, Phase
from tests.closed_loop.conftest import Fly

HOVER = (  # two metres apart, seven above the ground
    "swarm.agents=3",
    "start.positions_ned_m=[[0,0,-5],[2,0,-5],[-2,0,-5]]",
    "mission.kind=hover",
    "mission.duration_s=2",
)
BELOW = Obstacle(center_ned_m=(0.1, 0.0, -1.5), radius_m=1.0, keep_out_m=1.75, visibility_m=3.0)


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_one_of_three_lands_beside_an_obstacle_and_beside_the_others(fly: Fly, mode: str) -> None:
    flight = fly(*HOVER, f"separation.mode={mode}", at={1.0: lambda running: running.set_obstacles([BELOW])})
    assert flight.problems == []
    assert all(row["landed"] == Landed.ON_GROUND for row in flight.lockstep.world.truth_rows())
    ticks = flight.ticks(0)
    returns_s = ticks["t_us"][ticks["phase"] == Phase.GOTO_LAND][0] * 1e-6
    apart_m = np.linalg.norm(flight.pos_ned_m - np.array(BELOW.center_ned_m), axis=2)
    assert apart_m[flight.t_s >= returns_s].min() >= BELOW.keep_out_m - 0.05, "on the ground, too"
    assert flight.separation_m() >= 0.85
