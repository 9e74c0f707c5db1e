"""Tests that with downwash neither of two agents with crossing references passes closely below the other."""

from __future__ import annotations

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from tests.closed_loop.conftest import Flight, Fly

CROSSING = (
    "swarm.agents=2",
    "sitl.start=air",
    "start.positions_ned_m=[[3,0,-3],[-3,0,-1.7]]",
    "mission.kind=goto",
    "mission.goto.goals_ned_m=[[-3,0,-3],[3,0,-1.7]]",
    "mission.duration_s=6",
)


def scaled_m(flight: Flight, downwash: float) -> float:
    """Return the smallest true distance with heights scaled."""
    apart = (flight.pos_ned_m[:, 0] - flight.pos_ned_m[:, 1]) * [1.0, 1.0, 1.0 / downwash]
    return float(np.linalg.norm(apart, axis=1).min())


@pytest.mark.parametrize("kind", ["dmpc", "dmpc3"])  # one goes round, the other over
def test_no_vehicle_passes_closely_below_another(fly: Fly, kind: str) -> None:
    flight = fly(*CROSSING, f"controller.kind={kind}", "separation.downwash=2.0", until=Lockstep.mission_is_over)
    assert flight.outcomes == {"completed"}
    assert scaled_m(flight, 2.0) >= 0.85
    for agent in (0, 1):
        _, error = flight.tracked(agent)
        assert np.linalg.norm(error[-1]) < 0.3, "both arrive"


def test_negative_control_as_spheres_they_do(fly: Fly) -> None:
    flight = fly(*CROSSING, until=Lockstep.mission_is_over)
    assert scaled_m(flight, 1.0) >= 0.85
    assert scaled_m(flight, 2.0) < 0.7
