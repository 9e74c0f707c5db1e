"""Errors of the estimates: of the reported size, slow where they should be, seeded, and zero when exact."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sitl.plant.estimator import ESTIMATORS, EXACT_ACCURACY_M
from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig
from tests.benches.flown_world import FlownWorld
from tests.benches.px4_bench import COARSE

VEHICLES = 12
SECONDS = 60
HZ = 50  # of the physics here: the errors are processes in time and must not depend on it


def still(estimator: Any, seed: int = 1, vehicles: int = VEHICLES, seconds: float = SECONDS) -> dict[str, Any]:
    """What vehicles that stand still believe, sampled each step: positions relative to the truth."""
    clock = SimClock()
    ends = [pipe_pair(clock.now_us)[0] for _ in range(vehicles)]
    world = SitlWorld(
        SimulatorConfig(vehicles=vehicles, estimator=estimator, seed=seed, physics_hz=HZ),
        ends,
    )
    kept = []
    for k in range(round(seconds * HZ)):
        world.estimator.advance()
        kept.append([world.estimator.of(i, k * 20_000) for i in range(vehicles)])
    offset = world.plant.pos_ned_m.T
    return {
        "pos": np.array([[e.pos_ned_m for e in row] for row in kept]) - offset,
        "vel": np.array([[e.vel_ned_m_s for e in row] for row in kept]),
        "euler": np.array([[e.euler_rad for e in row] for row in kept]),
        "accuracy": kept[0][0].pos_accuracy_m,
        "estimates": kept,
    }


@pytest.fixture(scope="module")
def gps() -> dict[str, Any]:
    return still("gps")


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def smoothed(values: Any, seconds: float) -> Any:
    width = round(seconds * HZ)
    summed = np.cumsum(values, axis=0)
    return (summed[width:] - summed[:-width]) / width


def test_gps_position_is_off_as_real_px4s(gps: dict[str, Any]) -> None:
    space_m = np.linalg.norm(gps["pos"], axis=2)
    assert 0.3 <= rms(space_m) <= 0.6
    assert rms(smoothed(gps["pos"], 2.0)) == pytest.approx(0.215, rel=0.25)  # it wanders: an average does not help


def test_gps_velocity_is_biased_against_its_own_position(gps: dict[str, Any]) -> None:
    width = HZ  # 1 s: the white noise of two positions is then 3 cm/s
    derivative = (gps["pos"][width:] - gps["pos"][:-width]) / (width / HZ)
    bias = smoothed(gps["vel"], 1.0) - derivative
    assert 0.1 <= rms(bias) <= 0.3


def test_attitude_error_is_small_and_slow(gps: dict[str, Any]) -> None:
    slow = np.degrees(smoothed(gps["euler"][:, :, :2], 1.0))
    assert 0.15 <= rms(slow) <= 0.45
    white = np.degrees(np.diff(gps["euler"], axis=0)) / math.sqrt(2)
    model = ESTIMATORS["gps"]
    assert model is not None
    assert rms(white) == pytest.approx(math.degrees(model.noise_attitude_rad), rel=0.1)


def test_the_reported_accuracy_is_that_of_the_errors(gps: dict[str, Any]) -> None:
    horizontal_m, vertical_m = gps["accuracy"]
    assert rms(np.linalg.norm(gps["pos"][:, :, :2], axis=2)) == pytest.approx(horizontal_m, rel=0.3)
    assert rms(gps["pos"][:, :, 2]) == pytest.approx(vertical_m, rel=0.35)


def test_external_position_is_ten_times_better() -> None:
    flown = still("external", seconds=30)
    assert 0.03 <= rms(np.linalg.norm(smoothed(flown["pos"], 0.5), axis=2)) <= 0.05
    assert 0.03 <= rms(smoothed(flown["vel"], 1.0)) <= 0.1


def banded_rms(values: Any, low_hz: float, high_hz: float) -> Any:
    """RMS (3,) per axis between two frequencies, over all vehicles; values (T, N, 3)."""
    spectrum = np.fft.rfft(values - values.mean(axis=0), axis=0)
    hz = np.fft.rfftfreq(len(values), 1.0 / HZ)
    spectrum[(hz < low_hz) | (hz > high_hz)] = 0.0
    return np.sqrt(np.mean(np.fft.irfft(spectrum, len(values), axis=0) ** 2, axis=(0, 1)))


@pytest.mark.parametrize("slow", ["gps", "external"])
def test_px4s_velocity_errs_faster_than_the_slow_models(slow: str) -> None:
    fast_m_s, slow_m_s = (banded_rms(still(name)["vel"], 0.3, 1.5) for name in (f"px4_{slow}", slow))
    assert (fast_m_s >= 0.015).all() and (fast_m_s <= 0.065).all(), "of PX4's logs beside the truth of its simulator"
    assert (fast_m_s >= 1.4 * slow_m_s).all()


def test_vehicles_err_independently_and_each_the_same_in_any_swarm(gps: dict[str, Any]) -> None:
    few = still("gps", vehicles=2, seconds=2)
    assert np.allclose(few["pos"], gps["pos"][: 2 * HZ, :2], atol=0.02), "rounded origins differ by some mm"
    correlation = np.corrcoef(gps["vel"][:, 0, 0], gps["vel"][:, 1, 0])[0, 1]
    assert abs(correlation) < 0.6
    assert not np.allclose(gps["pos"][0, 0], gps["pos"][0, 1])


def test_a_seed_repeats_and_another_does_not() -> None:
    first, again, other = (still("gps", seed=s, vehicles=2, seconds=2) for s in (3, 3, 4))
    assert first["estimates"] == again["estimates"]
    assert not np.allclose(first["pos"], other["pos"])


def test_negative_control_exact_is_the_truth() -> None:
    flown = still("exact", vehicles=2, seconds=1)
    assert not flown["pos"].any()
    assert not flown["vel"].any()
    assert flown["accuracy"] == EXACT_ACCURACY_M


def test_samples_are_as_old_as_the_model_says() -> None:
    clock = SimClock()
    params = SimulatorConfig(vehicles=8, estimator="gps", start="air")
    world = SitlWorld(params, [pipe_pair(clock.now_us)[0] for _ in range(8)])
    world.plant.held[:] = False
    world.plant.state[7] = 1000.0  # m/s north: 1 mm of error is 1 us of age
    world.plant.refresh()
    dt_s = world.plant.dt_s
    for _ in range(20):
        world.plant.state[10] += 1000.0 * dt_s
        world.estimator.advance()
    ages_s = [
        (world.plant.state[10, i] - world.estimator.of(i, 0).pos_ned_m[0]) / 1000.0 for i in range(params.vehicles)
    ]
    assert all(0.008 <= age_s <= 0.022 for age_s in ages_s)
    assert max(ages_s) - min(ages_s) > 0.003


@pytest.mark.parametrize("estimator", ["gps", "exact"])
def test_the_attitude_loop_flies_on_the_estimate(estimator: str) -> None:
    """It levels what it believes; the vehicle itself stays tilted by the error, and accelerates."""
    flown = FlownWorld(3, estimator=estimator, preset="x500", seed=5)
    flown.take_off()
    flown.fly_offboard((0.0, 0.0, 0.0), 0.49)
    flown.step(0.9)
    believed_deg = np.degrees(flown.world.estimator.sensed.euler_rad)[:2]
    assert np.abs(believed_deg).max() < 0.08
    true_deg = np.degrees(flown.world.plant.euler_rad)[:2]
    if estimator == "exact":
        assert np.abs(true_deg).max() < 0.08
    else:
        assert 0.1 < rms(true_deg) < 0.7


def test_a_loitering_vehicle_wanders_as_its_estimate_does() -> None:
    """It keeps its place in what it believes, so in truth it moves by the error: decimetres with GPS, none without."""
    spread_m = {}
    for estimator in ("gps", "exact"):
        flown = FlownWorld(3, estimator=estimator, preset="x500", seed=2, **COARSE)
        flown.take_off()
        kept: list[Any] = []
        for _ in range(15):
            flown.step(1.0)
            kept.append(flown.pos_ned_m[:, :2])
        spread_m[estimator] = float(np.ptp(np.array(kept), axis=0).max())
    assert 0.1 < spread_m["gps"] < 1.5
    assert spread_m["exact"] < 0.02


def test_without_gps_the_error_accelerates_in_the_air_and_rests_on_the_ground() -> None:
    clock = SimClock()
    world = SitlWorld(SimulatorConfig(vehicles=1, physics_hz=HZ), [pipe_pair(clock.now_us)[0]])
    estimator, truth_m = world.estimator, world.plant.pos_ned_m[:, 0].copy()

    def off_m(seconds: float, *, on_ground: bool) -> float:
        world.plant.contact[:] = on_ground
        for _ in range(round(seconds * HZ)):
            estimator.advance()
        estimate = estimator.of(0, 0)
        error_m = float(np.linalg.norm(np.array(estimate.pos_ned_m) - truth_m))
        assert estimate.pos_accuracy_m[0] == pytest.approx(error_m, abs=0.02)
        return error_m

    estimator.lose_gps(0)
    assert off_m(5.0, on_ground=True) == 0.0
    assert off_m(10.0, on_ground=False) == pytest.approx(0.5 * 0.05 * 10.0**2, rel=0.01)
    landed_m = off_m(6.0, on_ground=True)
    assert landed_m == pytest.approx(2.5 + 0.8 * 0.5, abs=0.02)
    assert off_m(60.0, on_ground=True) == pytest.approx(landed_m, abs=0.01)
    estimator.find_gps(0)
    assert off_m(0.1, on_ground=True) == 0.0
