"""Who is away from its reference approaches it at `vehicle_model.speed_max_m_s` at most, and as fast as it can brake.

From rest a plan makes up for the time lost: it exceeds that by up to a tenth for a moment, and settles at it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from swarmctl.control.reference import approach
from swarmctl.core.types import Phase
from tests.closed_loop.conftest import COARSE, Flight, Fly
from tests.closed_loop.test_operator import phase

SPEED_M_S = 3.0
BEGIN_NED_M, END_NED_M = [25.0, 0.0, -5.0], [25.0, 0.5, -5.0]  # of the reference, 25 m from the start


def fly_there(
    fly: Fly, speed_max_m_s: float, mode: str, *overrides: str, from_ned_m: Sequence[float] = (0.0, 0.0, -3.0)
) -> Flight:
    return fly(
        *COARSE,
        "swarm.agents=1",
        "sitl.start=air",
        f"start.positions_ned_m=[{list(from_ned_m)}]",
        "mission.kind=waypoints",
        "mission.duration_s=15",
        f"mission.waypoints.lists=[{{points_ned_m=[{BEGIN_NED_M},{END_NED_M}]}}]",
        f"vehicle_model.speed_max_m_s={speed_max_m_s}",
        f"separation.mode={mode}",
        *overrides,
        until=lambda running: phase(running) > Phase.TRACK,
    )


def fastest_m_s(flight: Flight) -> float:
    steps_m = np.linalg.norm(np.diff(flight.pos_ned_m[:, 0], axis=0), axis=1)
    return float((steps_m / np.diff(flight.t_s)).max())


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_a_reference_far_away_is_approached_no_faster_than_allowed(fly: Fly, mode: str) -> None:
    flight = fly_there(fly, SPEED_M_S, mode)
    assert fastest_m_s(flight) < 1.1 * SPEED_M_S
    assert np.abs(flight.pos_ned_m[-1, 0] - END_NED_M).max() < 0.1


def test_negative_control_without_that_limit_it_is_flown_to_as_fast_as_tilt_allows(fly: Fly) -> None:
    assert fastest_m_s(fly_there(fly, 100.0, "best_effort")) > 2.0 * SPEED_M_S


def lowest_m(fly: Fly) -> float:
    """Fly to 3 m above the ground from 15 m with a quarter of the weight to brake with; return the least height."""
    flight = fly(
        "swarm.agents=1",
        "sitl.start=air",
        "start.positions_ned_m=[[0,0,-15]]",
        "mission.kind=waypoints",
        "mission.duration_s=10",
        "mission.waypoints.lists=[{points_ned_m=[[0,0,-3],[0,0.5,-3]]}]",
        "vehicle_model.thrust_max_01=0.625",
        until=lambda running: phase(running) > Phase.TRACK,
    )
    return float(-flight.pos_ned_m[:, 0, 2].max())


def test_who_is_sent_far_down_brakes_with_what_thrust_is_left_beside_the_weight(fly: Fly) -> None:
    assert lowest_m(fly) > 2.5


def test_negative_control_without_a_limit_of_sinking_it_falls_into_the_ground(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(approach, "_FAR_S", 100.0)
    monkeypatch.setattr(approach, "_NEARLY", 100.0)
    assert lowest_m(fly) < 0.0


def past_it_m(fly: Fly, mode: str, *overrides: str) -> float:
    """Fly to a reference that stands 30 m away; return how far the vehicle gets beyond it."""
    flight = fly_there(fly, 100.0, mode, *overrides, from_ned_m=(-5.0, 0.0, -5.0))
    return float(flight.pos_ned_m[:, 0, 0].max()) - BEGIN_NED_M[0]


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_who_comes_fast_does_not_fly_past_its_reference(fly: Fly, mode: str) -> None:
    assert past_it_m(fly, mode) < 0.1


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_negative_control_plans_alone_brake_too_late(fly: Fly, mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(approach, "_NEARLY", 100.0)
    assert past_it_m(fly, mode) > 3.0


def test_who_weighs_distances_more_does_not_fly_past_its_reference_either(fly: Fly) -> None:
    heavy = [f"controller.mpc.{axis}.q_pos=15" for axis in "xy"]
    assert past_it_m(fly, "best_effort", *heavy) < 0.5
