"""Vehicles come down beside an obstacle that is below where one of them would land.

That this fails without the protection is shown by the rows `above-obstacle-*` of the fault matrix.
"""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.control.phases.inputs import PhaseInputs
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Landed, Phase
from tests.closed_loop.conftest import COARSE, ROOT, Fly
from tests.closed_loop.test_operator import fly_until, least_m, outcome, phase, vehicle

HOVER = (  # two metres apart, seven above the ground
    *COARSE,
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


@pytest.mark.parametrize("beside", [True, False], ids=["beside", "negative control"])
@pytest.mark.parametrize("config", [None, "ardupilot_sitl.toml"], ids=["px4", "arducopter"])
def test_who_is_landed_on_its_way_up_lands_beside_an_obstacle_that_has_come_below(
    config: str | None, beside: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its autopilot, which flies it, would land it straight down."""
    if not beside:
        monkeypatch.setattr(PhaseInputs, "is_over_obstacle", lambda *_: False)
        monkeypatch.setattr(Obstacle, "is_below", lambda *_: False)
    alone = (*COARSE, "swarm.agents=1", "start.positions_ned_m=[[0,0,-8]]", "mission.kind=hover")
    flight = Lockstep(load(None if config is None else ROOT / "configs" / config, alone))
    ground_z_m = float(vehicle(flight)[0][2])
    fly_until(flight, lambda: phase(flight) is Phase.TAKEOFF and vehicle(flight)[0][2] < ground_z_m - 4.5)
    came = BELOW.model_copy(update={"center_ned_m": (0.3, 0.0, ground_z_m - 1.5)})
    flight.set_obstacles([came])
    fly_until(flight, lambda: vehicle(flight)[0][2] < ground_z_m - 4.8)
    flight.command("land")
    nearest_m = least_m(flight, 40.0 if beside else 20.0, lambda: came.distance_m(vehicle(flight)[0]))
    assert (nearest_m > came.keep_out_m) is beside
    if not beside:
        assert nearest_m < came.radius_m
        return
    assert flight.world.truth_rows()[0]["landed"] == Landed.ON_GROUND
    assert outcome(flight) == "stopped by the operator"
