"""Tests of what a real autopilot needs: dead time, lag and drag in the prediction, and a filter on its estimates.

The simulator's x500 responds as measured on PX4, and its estimator has PX4's errors. Figures are those of `px4_flight`
flights of real autopilots; each is tested once, and once more with the responsible part disabled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.core.types import Array, Phase, PlanStatus
from tests.closed_loop.conftest import Flight, closer_than

CONFIG = Path(__file__).parents[2] / "configs" / "x500_circle.toml"
WIND_NED_M_S = (3.6, 0.0, 0.0)
AIR = (
    "sitl.start=air",
    "start.center_ned_m=[5, 0, -3]",
    "mission.circle.climb_ned_m_s=0",
    "agent.state_machine.arrive_m=1",
)
ALONE = (*AIR, "swarm.agents=1", "sitl.estimator=gps", "mission.duration_s=17")
STEP = ("mission.kind=steps", "mission.steps.rows=[[0, 5, 0, -3], [2, 10, 0, -3]]", "mission.duration_s=9")
PLAIN = ("vehicle_model.attitude_rad_s=0", "vehicle_model.drag_1_s=0", "agent.state_filter.enabled=false")


@functools.cache
def fly(
    *overrides: str,
    wind_ned_m_s: tuple[float, float, float] | None = None,
    until: Callable[[Lockstep], bool] = Lockstep.mission_is_over,
) -> Lockstep:
    """Fly until the mission is over, or until another end."""
    flight = Lockstep(load(CONFIG, overrides))
    if wind_ned_m_s is not None:
        flight.world.set_wind(wind_ned_m_s)
    while flight.clock.now_us() < 70e6 and not until(flight):
        flight.step()
    return flight


def tracked(flight: Lockstep, agent: int = 0) -> NDArray[np.void]:
    ticks = flight.logs[agent].ticks
    return np.asarray(ticks[ticks["phase"] == Phase.TRACK])


def rmse_m(flight: Lockstep) -> float:
    """Return the error of the reported position from 10 s on [m]."""
    ticks = tracked(flight)
    late = ticks[ticks["mission_t_s"] >= 10.0]
    assert len(late) > 330
    return float(np.sqrt(np.mean(np.sum((late["pos_ned_m"] - late["ref_pos_ned_m"]) ** 2, axis=1))))


@pytest.mark.parametrize(
    ("omega_rad_s", "wind_ned_m_s", "limit_m"), [(0.5, None, 0.05), (0.5, WIND_NED_M_S, 0.06), (1.0, None, 0.13)]
)
def test_a_lone_vehicle_tracks_the_circle(
    omega_rad_s: float, wind_ned_m_s: tuple[float, float, float] | None, limit_m: float
) -> None:
    flight = fly(*ALONE, f"mission.circle.omega_rad_s={omega_rad_s}", wind_ned_m_s=wind_ned_m_s)
    assert rmse_m(flight) <= limit_m
    assert (tracked(flight)["plan_status"] == PlanStatus.OK).mean() > 0.99


@pytest.mark.parametrize(
    ("without", "at_least_m"),
    [
        (PLAIN, 0.2),
        (("vehicle_model.delay_s=0",), 0.042),
        (("vehicle_model.attitude_rad_s=0",), 0.08),
        (("vehicle_model.drag_1_s=0",), 0.1),
        (("agent.state_filter.bias_m_s=0",), 0.06),
    ],
    ids=["plain", "dead time", "lag", "drag", "velocity bias"],
)
def test_without_its_parts_it_does_not(without: tuple[str, ...], at_least_m: float) -> None:
    assert rmse_m(fly(*ALONE, *without)) > at_least_m


def test_a_step_of_five_metres_does_not_overshoot_and_settles() -> None:
    ticks = tracked(fly(*ALONE, *STEP))
    t_s, gone_01 = ticks["mission_t_s"] - 2.0, (ticks["pos_ned_m"][:, 0] - 5.0) / 5.0
    outside = t_s[np.abs(gone_01 - 1.0) > 0.02]
    assert gone_01.max() <= 1.01
    assert outside.max() <= 2.6


def separations_m(positions_ned_m: Array) -> float:
    """Return the smallest distance between any two of (agents, T, 3)."""
    count = len(positions_ned_m)
    pairs = [(i, j) for i in range(count) for j in range(i)]
    return min(float(np.linalg.norm(positions_ned_m[i] - positions_ned_m[j], axis=1).min()) for i, j in pairs)


def together(flight: Lockstep) -> tuple[float, float, float]:
    """Return the summed mean error after 10 s and the smallest reported and true separation while tracking [m]."""
    all_ticks = [tracked(flight, i) for i in range(3)]
    length = min(len(ticks) for ticks in all_ticks)
    errors = [np.linalg.norm((ticks["pos_ned_m"] - ticks["ref_pos_ned_m"])[:length], axis=1) for ticks in all_ticks]
    late = all_ticks[0]["mission_t_s"][:length] >= 10.0
    truth = flight.truth.reshape(-1, 3)
    begin_us, end_us = all_ticks[0]["t_us"][0], all_ticks[0]["t_us"][-1]
    truth = truth[(truth["t_us"][:, 0] >= begin_us) & (truth["t_us"][:, 0] <= end_us)]
    return (
        float(np.sum(errors, axis=0)[late].mean()),
        separations_m(np.stack([ticks["pos_ned_m"][:length] for ticks in all_ticks])),
        separations_m(np.swapaxes(truth["pos_ned_m"], 0, 1)),
    )


SWARM = ("sitl.start=air", "mission.duration_s=22.6")  # a period of the circle after the first 10 s
TOO_CLOSE_M = 0.6


def test_three_vehicles_keep_apart_and_close_to_the_reference() -> None:
    summed_mean_error_m, reported_m, true_m = together(fly(*SWARM))
    assert summed_mean_error_m <= 2.0
    assert reported_m >= 0.87
    assert true_m >= 0.79


def test_three_vehicles_without_lag_and_dead_time_in_the_prediction_do_not() -> None:
    flight = fly(*SWARM, *PLAIN, "vehicle_model.delay_s=0", until=closer_than(TOO_CLOSE_M))
    assert Flight(flight).separation_m() < TOO_CLOSE_M


IN_A_ROW = (
    *("sitl.start=air", "mission.duration_s=16", "start.center_ned_m=[5, 0, -3]"),
    *("start.direction_ned=[0, 1, 0]", "start.spacing_m=1"),  # along the motion
)


def wandered_m(flight: Lockstep) -> float:
    """Return how far any vehicle was from its mean place beside the reference, from 6 s on [m]."""
    worst_m = 0.0
    for agent in range(3):
        ticks = tracked(flight, agent)
        late = ticks[ticks["mission_t_s"] >= 6.0]
        beside = (late["pos_ned_m"] - late["ref_pos_ned_m"])[:, :2]
        worst_m = max(worst_m, float(np.linalg.norm(beside - beside.mean(axis=0), axis=1).max()))
    return worst_m


def test_three_vehicles_keep_their_assigned_places_around_the_reference() -> None:
    flight = fly(*IN_A_ROW, "mission.circle.goal_assignment=true")
    summed_mean_error_m, reported_m, true_m = together(flight)
    assert wandered_m(flight) <= 0.06
    assert 1.56 <= summed_mean_error_m <= 1.75, (
        "to the shared reference: three times 1.04 times 0.95 m / sqrt(3) is 1.711 m"
    )
    assert reported_m >= 0.90
    assert true_m >= 0.88


@pytest.mark.usefixtures("configured_starts")
def test_three_vehicles_without_assigned_places_push_each_other_around_it() -> None:
    flight = fly(*IN_A_ROW, "separation.approach_01=0", "mission.duration_s=12")
    assert wandered_m(flight) > 0.12


# -- separation radius and reported accuracy --------------------------------------------------------------------------


def outcome(*overrides: str) -> tuple[str, bool]:
    """Return why the first agent ended, and whether any vehicle was ever armed."""
    flight = Lockstep(load(CONFIG, (*overrides, "mission.duration_s=1", "agent.state_machine.start_timeout_s=12")))
    armed = False
    while not (flight.finished or armed) and flight.clock.now_us() < 30e6:
        flight.step()
        armed = bool(flight.world.truth_rows()["armed"].any())
    assert flight.agents[0] is not None
    return flight.agents[0].outcome, armed


def test_a_radius_below_what_the_estimator_claims_is_refused_before_arming() -> None:
    why, armed = outcome("sitl.estimator=gps")
    assert "separation.radius_m = 0.9" in why and "allow_small_radius" in why
    assert not armed


def test_with_allow_small_radius_it_flies() -> None:
    assert outcome("sitl.estimator=gps", "separation.allow_small_radius=true")[1]
