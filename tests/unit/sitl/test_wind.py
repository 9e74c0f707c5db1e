"""Wind: MIL-F-8785C's numbers, the effect on a vehicle, and still air."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sitl.plant.wind import Air
from swarmctl.simulator_config import WindParams
from tests.benches.flown_world import FlownWorld

FOOT_M = 0.3048
DT_S = 0.02


def blown(params: dict[str, Any], height_m: float, seconds: float, vehicles: int = 20, seed: int = 1) -> Any:
    """Air velocity (T, 3, N) over vehicles that hover, or hold their place in the mean wind."""
    air = Air(WindParams.model_validate(params), vehicles, DT_S, seed)
    heights, still = np.full(vehicles, height_m), np.zeros((3, vehicles))
    return np.array([air.velocity_ned_m_s(k * DT_S, heights, still) for k in range(round(seconds / DT_S))])


@pytest.mark.parametrize("height_ft", [10.0, 100.0])
def test_turbulence_is_as_strong_as_the_standard_says(height_ft: float) -> None:
    """sigma_w = 0.1 W20 and sigma_u = sigma_w / (0.177 + 0.000823 h)^0.4, h in feet."""
    air = blown({"mean_ned_m_s": (5.0, 0.0, 0.0), "turbulence_m_s": 7.7}, height_ft * FOOT_M, 120.0, vehicles=40)
    sigma_w = 0.77
    sigma_u = sigma_w / (0.177 + 0.000823 * height_ft) ** 0.4
    rms = np.sqrt(((air - [[5.0], [0.0], [0.0]]) ** 2).mean(axis=(0, 2)))
    assert rms == pytest.approx([sigma_u, sigma_u, sigma_w], rel=0.15)


def test_eddies_last_as_long_as_their_scale_length_over_the_airspeed() -> None:
    """u of the Dryden model is a first-order process: its autocorrelation falls to 1/e after L_u / V."""
    height_ft, speed = 30.0, 5.0
    air = blown({"mean_ned_m_s": (speed, 0.0, 0.0), "turbulence_m_s": 7.7}, height_ft * FOOT_M, 200.0, vehicles=40)
    gusts = air[:, 0] - speed
    length_m = height_ft / (0.177 + 0.000823 * height_ft) ** 1.2 * FOOT_M
    lag = round(length_m / speed / DT_S)
    correlation = (gusts[lag:] * gusts[:-lag]).mean() / (gusts**2).mean()
    assert correlation == pytest.approx(np.exp(-1), abs=0.08)


def test_turbulence_follows_the_mean_wind() -> None:
    east = blown({"mean_ned_m_s": (0.0, 5.0, 0.0), "turbulence_m_s": 7.7}, 10.0, 5.0)
    north = blown({"mean_ned_m_s": (5.0, 0.0, 0.0), "turbulence_m_s": 7.7}, 10.0, 5.0)
    assert np.allclose(east[:, 1], north[:, 0])
    assert np.allclose(east[:, 2], north[:, 2])


def test_turbulence_is_that_of_the_height_above_the_ground_where_vehicles_begin_in_the_air() -> None:
    """Their local frames begin where they do, in which all of them would be at a height of 0."""
    spawns = [(0.0, 0.0, -30.0), (5.0, 0.0, -12.0), (10.0, 0.0, -3.0)]
    flown = FlownWorld(3, start="air", spawn_ned_m=spawns, ground_z_m=2.0)
    assert flown.world.plant.height_m == pytest.approx([32.0, 14.0, 5.0], abs=0.01)
    grounded = FlownWorld(3, spawn_ned_m=spawns, ground_z_m=2.0)
    assert grounded.world.plant.height_m == pytest.approx([0.0, 0.0, 0.0])


def test_a_seed_repeats_and_vehicles_differ() -> None:
    params = {"turbulence_m_s": 5.0}
    first, again, other = blown(params, 3.0, 2.0), blown(params, 3.0, 2.0), blown(params, 3.0, 2.0, seed=2)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.allclose(first[:, 0, 0], first[:, 0, 1])
    assert np.array_equal(first[:, :, :2], blown(params, 3.0, 2.0, vehicles=2))


def test_a_gust_is_one_minus_cosine() -> None:
    air = blown({"gust_ned_m_s": (0.0, 4.0, 0.0), "gust_at_s": 1.0, "gust_for_s": 2.0}, 3.0, 4.0, vehicles=1)
    east = air[:, 1, 0]
    assert not east[: round(1 / DT_S)].any()
    assert east[round(2 / DT_S)] == pytest.approx(4.0)
    assert east[round(1.5 / DT_S)] == pytest.approx(2.0)
    assert not east[round(3.02 / DT_S) :].any()


def test_negative_control_still_air_is_still() -> None:
    assert Air(WindParams(), 3, DT_S, 1).still
    assert not blown({}, 3.0, 1.0).any()


def test_a_vehicle_leans_into_the_wind_and_keeps_its_place() -> None:
    """x500's drag is 1 N/(m/s): 1.8 m/s takes 0.18 of its weight, 10 deg; without wind it stands level."""
    calm, windy = FlownWorld(preset="x500"), FlownWorld(preset="x500", realism={"wind": {"mean_ned_m_s": (1.8, 0, 0)}})
    for flown in (calm, windy):
        flown.take_off()
        flown.step(6.0)
    assert windy.tilt_deg[0] == pytest.approx(np.degrees(np.arctan2(1.8, 9.81)), abs=1.5)
    assert abs(windy.pos_ned_m[0, 0]) < 1.0
    assert calm.tilt_deg[0] < 0.2


def test_drag_off_leaves_nothing_to_blow_on() -> None:
    flown = FlownWorld(preset="x500", realism={"wind": {"mean_ned_m_s": (5.0, 0, 0)}, "drag_scale": 0.0})
    flown.take_off()
    assert flown.tilt_deg[0] < 0.2
