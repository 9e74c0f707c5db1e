"""Tests that wind, a heavier vehicle, a sagging battery and a wrong thrust curve together cost little accuracy."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from swarmctl.config import load
from swarmctl.core.types import Phase
from tests.closed_loop.conftest import ROOT

STEADY_FROM_S = 7.0  # the vehicle begins up to a metre away, and is on the circle after 6.6 s
ALONE = (
    "swarm.agents=1",
    "sitl.start=air",
    "sitl.estimator=exact",
    "start.center_ned_m=[5, 0, -3]",
    "mission.circle.climb_ned_m_s=0",
    "mission.duration_s=16",
    "agent.state_machine.arrive_m=1",
)
HEAVY = ("sitl.mass_scale=1.2", "sitl.battery.capacity_mah=5000", "sitl.battery.charge_01=0.9")
WIND = ("sitl.wind.mean_ned_m_s=[8,0,0]",)
GUSTS = ("sitl.wind.gust_ned_m_s=[2,1,0]", "sitl.wind.gust_at_s=12", "sitl.wind.gust_for_s=2")
EDDIES = ("sitl.wind.turbulence_m_s=3",)
CURVE = ("sitl.thrust_curve_01=0.3",)
UNOBSERVED = ("agent.disturbance.limit_m_s2=0.01",)


class Errors(NamedTuple):
    """Return the steady error of the true position against the reference [m]."""

    rmse_m: float
    mean_down_m: float
    largest_down_m: float


@functools.cache
def errors(*overrides: str) -> Errors:
    flight = Lockstep(load(ROOT / "configs" / "x500_circle.toml", (*ALONE, *overrides)))
    log = flight.logs[0]
    while flight.clock.now_us() < 40e6 and not (log.rows and log.rows[-1]["phase"][0] > Phase.TRACK):
        flight.step()
    ticks, truth = log.ticks, flight.truth
    ticks = ticks[ticks["mission_t_s"] >= STEADY_FROM_S]
    assert len(ticks) >= 400
    t_us: NDArray[np.int64] = truth["t_us"]
    pos_ned_m: NDArray[np.float64] = truth["pos_ned_m"]
    true = [np.interp(ticks["t_us"], t_us, pos_ned_m[:, axis]) for axis in range(3)]
    error = np.stack(true, axis=1) - ticks["ref_pos_ned_m"]
    down = error[:, 2]
    return Errors(float(np.sqrt((error**2).sum(axis=1).mean())), float(down.mean()), float(np.abs(down).max()))


def test_wind_gusts_mass_and_battery_cost_centimetres() -> None:
    found = errors(*WIND, *HEAVY, *GUSTS)
    assert found.rmse_m <= 0.045
    assert abs(found.mean_down_m) <= 0.005
    assert found.largest_down_m <= 0.02


def test_additional_turbulence_costs_centimetres() -> None:
    """Of eight seeds seven are 0.050 to 0.071 m, of which 5 is the worst.

    With seed 2 the vehicle is not on the circle yet when the error begins to count: wind and weight leave it little.
    """
    assert errors(*WIND, *HEAVY, *GUSTS, *EDDIES, "seed=5").rmse_m <= 0.075


def test_at_rest_no_error_remains() -> None:
    hover = ("mission.kind=hover", "mission.duration_s=15")
    found = errors(*hover, *WIND, *HEAVY, *CURVE)
    assert found.rmse_m <= 0.005
    assert found.largest_down_m <= 0.005


@pytest.mark.parametrize(
    ("without", "at_least_m"),
    [
        (UNOBSERVED, 1.0),
        (("agent.disturbance.limit_m_s2=4",), 0.4),  # 8 m/s are 8 m/s2 at 1 1/s of drag
        (("agent.state_filter.enabled=false",), 0.06),  # the plain observer is slower to know a gust
        (("controller.mpc.u_max=0.45", "vehicle_model.tilt_max_rad=0.47"), 1.0),
    ],
    ids=["no estimate", "4 m/s2 at most", "no filter", "no room to lean"],
)
def test_negative_control_without_its_parts_it_does_not(without: tuple[str, ...], at_least_m: float) -> None:
    assert errors(*WIND, *HEAVY, *GUSTS, *without).rmse_m > at_least_m


def test_negative_control_a_disturbance_that_walks_slower_lags_behind() -> None:
    slow = errors(*WIND, *HEAVY, *GUSTS, "agent.state_filter.disturbance_m_s2=0.2")
    assert slow.rmse_m > 0.05


@pytest.mark.parametrize("mass_scale", [0.7, 1.4])
def test_a_vehicle_of_another_mass_keeps_its_height_as_it_is_taken_over(mass_scale: float) -> None:
    overrides = ("swarm.agents=1", "mission.kind=hover", "mission.duration_s=4", "start.positions_ned_m=[[0,0,0]]")
    flight = Lockstep(load(None, (*overrides, f"sitl.mass_scale={mass_scale}", "sitl.physics_hz=100")))
    flight.run(lambda now: now.mission_is_over())
    ticks, truth = flight.logs[0].ticks, flight.truth
    began_us = ticks["t_us"][ticks["phase"] > Phase.TAKEOFF][0]
    down_m = truth["pos_ned_m"][(truth["t_us"] > began_us) & (truth["t_us"] < ticks["t_us"][-1]), 2]
    assert flight.logs[0].rows[-1]["phase"][0] > Phase.TRACK
    assert np.abs(down_m).max() <= 0.2  # of 0.15 that count as arrived
