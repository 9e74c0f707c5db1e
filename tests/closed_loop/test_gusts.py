"""Sudden winds on x500 vehicles, judged on true states: how far one is blown, and that two don't touch."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from sitl.studies.campaign.events import SimulatorFault
from swarmctl.config import load
from swarmctl.core.types import Phase
from swarmctl.simulator_config import FaultParams
from tests.closed_loop.conftest import ROOT

X500 = ROOT / "configs" / "x500_circle.toml"


@pytest.mark.parametrize("gust_m_s", [4.0, 8.0])
def test_a_sudden_wind_blows_a_hovering_vehicle_no_farther_than_distances_leave_room_for(gust_m_s: float) -> None:
    sets = ["swarm.agents=1", "sitl.start=air", "mission.kind=hover", "mission.duration_s=8", "sitl.estimator=exact"]
    config = load(X500, [*sets, f"separation.gust_m_s={gust_m_s}"])
    flight = Lockstep(config)
    wind = SimulatorFault(FaultParams(kind="wind", vehicle=0, value=gust_m_s, towards_deg=30.0), 2.0)
    began_s, places_m = None, []

    def blown(lockstep: Lockstep) -> bool:
        nonlocal began_s
        now_s = lockstep.clock.now_us() * 1e-6
        if began_s is None and lockstep.logs[0].rows[-1]["phase"][0] == Phase.TRACK:
            began_s = now_s
        if began_s is None:
            return False
        pos, vel = lockstep.world.plant.pos_ned_m.T, lockstep.world.plant.vel_ned_m_s.T
        wind.step(lockstep, now_s - began_s, pos, vel)
        places_m.append(pos[0].copy())
        return now_s - began_s > 6.0

    flight.run(blown)
    drifted_m = np.linalg.norm(np.array(places_m) - places_m[0], axis=1).max()
    assert 0.8 * config.drift_m < drifted_m <= config.drift_m
