"""Tests of the observer: hover thrust of a wrongly modelled vehicle, constant wind, and the signs of both."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmctl.control.estimation.disturbance import DisturbanceObserver, DisturbanceParams
from swarmctl.core.frames import quat_from_euler
from swarmctl.core.types import Array, VehicleState
from tests import builders

G = 9.81
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
DT_US = 20_000


def sample(t_us: int, vel: Array, q_nb: Array = LEVEL) -> VehicleState:
    return builders.vehicle_state(t_us=t_us, vel_ned_m_s=vel, q_nb=q_nb)


def observe(
    observer: DisturbanceObserver, seconds: float, accel: Array, thrust_01: float, q_nb: Array = LEVEL, from_us: int = 0
) -> None:
    """Observe a vehicle that accelerates by `accel` while the given thrust acts."""
    for k in range(round(seconds * 1e6) // DT_US + 1):
        observer.update(sample(from_us + k * DT_US, accel * k * DT_US * 1e-6, q_nb), thrust_01)


@pytest.mark.parametrize("accel", [(0.8, 0.0, 0.0), (0.0, -0.6, 0.0), (-0.3, 0.4, 0.0)])
def test_constant_wind_is_identified_with_its_sign(accel: tuple[float, float, float]) -> None:
    observer = DisturbanceObserver(DisturbanceParams(), 0.5)
    observe(observer, 5.0, np.array(accel), 0.5)
    np.testing.assert_allclose(observer.estimate.disturbance_ned_m_s2, accel, atol=0.01)
    assert observer.estimate.hover_thrust_01 == pytest.approx(0.5, abs=1e-3)


def test_wind_is_found_with_both_poles_at_the_bandwidth() -> None:
    # d(t) of two poles at -2: 1 - (1 + 2 t) exp(-2 t); 0.594 after 1 s
    observer = DisturbanceObserver(DisturbanceParams(bandwidth_rad_s=2.0), 0.5)
    observe(observer, 1.0, np.array([1.0, 0.0, 0.0]), 0.5)
    assert observer.estimate.disturbance_ned_m_s2[0] == pytest.approx(1 - 3 * math.exp(-2), abs=0.03)


@pytest.mark.parametrize(("believed_01", "true_01"), [(0.3, 0.5), (0.7, 0.5), (0.5, 0.35), (0.4, 0.72)])
def test_a_wrong_hover_thrust_converges_and_leaves_no_disturbance_behind(believed_01: float, true_01: float) -> None:
    observer = DisturbanceObserver(DisturbanceParams(), believed_01)
    observe(observer, 25.0, np.zeros(3), true_01)  # it hovers with the true one
    assert observer.estimate.hover_thrust_01 == pytest.approx(true_01, rel=0.005)
    np.testing.assert_allclose(observer.estimate.disturbance_ned_m_s2, 0.0, atol=0.05)


def test_a_vehicle_heavier_than_modelled_sinks_until_hover_thrust_grows() -> None:
    observer = DisturbanceObserver(DisturbanceParams(), 0.5)
    # with the weight of 0.6 at thrust 0.5: down by g (1 - 5/6)
    observe(observer, 1.0, np.array([0.0, 0.0, G / 6]), 0.5)
    assert observer.estimate.disturbance_ned_m_s2[2] > 0.5
    assert observer.estimate.hover_thrust_01 > 0.505


def test_moving_into_the_hover_thrust_leaves_the_explained_acceleration_alone() -> None:
    observer = DisturbanceObserver(DisturbanceParams(bandwidth_rad_s=2.0, hover_time_s=0.5), 0.5)
    observe(observer, 8.0, np.array([0.0, 0.0, 1.0]), 0.5)
    estimate = observer.estimate
    explained = G - 0.5 * G / estimate.hover_thrust_01 + float(estimate.disturbance_ned_m_s2[2])
    assert explained == pytest.approx(1.0, abs=0.02)


def test_tilt_is_no_wind() -> None:
    nose_down = quat_from_euler(0.0, -0.2, 0.0)
    thrust_01 = 0.5 / math.cos(0.2)
    observer = DisturbanceObserver(DisturbanceParams(), 0.5)
    observe(observer, 4.0, np.array([G * math.tan(0.2), 0.0, 0.0]), thrust_01, nose_down)
    np.testing.assert_allclose(observer.estimate.disturbance_ned_m_s2, 0.0, atol=0.01)


def test_a_vehicle_that_leans_and_does_not_move_stands_against_a_wind() -> None:
    nose_down = quat_from_euler(0.0, -0.2, 0.0)  # would go north: the wind pushes south
    observer = DisturbanceObserver(DisturbanceParams(), 0.5)
    observe(observer, 5.0, np.zeros(3), 0.5 / math.cos(0.2), nose_down)
    np.testing.assert_allclose(observer.estimate.disturbance_ned_m_s2[:2], [-G * math.tan(0.2), 0.0], atol=0.02)


@pytest.mark.parametrize(("wind_m_s", "expected_m_s2"), [(0.0, 0.0), (-3.0, -3.0)])
def test_drag_in_still_air_is_no_disturbance_and_the_winds_is(wind_m_s: float, expected_m_s2: float) -> None:
    lean, speed_m_s = math.atan((4.0 - wind_m_s) / G), 4.0  # with a drag of 1 1/s
    observer = DisturbanceObserver(DisturbanceParams(), 0.5, 1.0)
    for k in range(300):
        held = quat_from_euler(0.0, -lean, 0.0)
        observer.update(sample(k * DT_US, np.array([speed_m_s, 0.0, 0.0]), held), 0.5 / math.cos(lean))
    np.testing.assert_allclose(observer.estimate.disturbance_ned_m_s2, [expected_m_s2, 0.0, 0.0], atol=0.01)


def test_estimates_are_limited() -> None:
    observer = DisturbanceObserver(DisturbanceParams(limit_m_s2=1.0), 0.5)
    observe(observer, 20.0, np.array([6.0, -6.0, 9.0]), 0.5)
    assert np.abs(observer.estimate.disturbance_ned_m_s2[:2]).max() <= 1.0
    for accel_m_s2, limit_01 in ((-30.0, 0.2), (9.0, 0.95)):  # 0.4 of the first guess, and what leaves room to climb
        observer = DisturbanceObserver(DisturbanceParams(hover_time_s=0.5), 0.5)
        observe(observer, 20.0, np.array([0.0, 0.0, accel_m_s2]), 0.5)
        assert observer.estimate.hover_thrust_01 == pytest.approx(limit_01)


@pytest.mark.parametrize("gap_us", [0, -20_000, 200_000, 3_000_000])
def test_a_gap_or_a_step_back_in_time_begins_anew_instead_of_becoming_wind(gap_us: int) -> None:
    observer = DisturbanceObserver(DisturbanceParams(), 0.5)
    observe(observer, 1.0, np.zeros(3), 0.5)
    before = observer.estimate.disturbance_ned_m_s2.copy()
    observer.update(sample(1_000_000 + gap_us, np.array([50.0, 0.0, 0.0])), 0.5)
    np.testing.assert_array_equal(observer.estimate.disturbance_ned_m_s2, before)


def test_reset_forgets_the_wind_and_keeps_the_weight() -> None:
    observer = DisturbanceObserver(DisturbanceParams(), 0.3)
    observe(observer, 20.0, np.array([1.0, 0.0, 0.0]), 0.45)
    observer.reset()
    np.testing.assert_array_equal(observer.estimate.disturbance_ned_m_s2, 0.0)
    assert observer.estimate.hover_thrust_01 == pytest.approx(0.45, rel=0.01)
    observer.update(sample(20_020_000, np.array([30.0, 0.0, 0.0])), 0.45)  # first sample after: nothing to compare with
    np.testing.assert_array_equal(observer.estimate.disturbance_ned_m_s2, 0.0)


def test_the_autopilots_own_hover_thrust_is_taken_over_slowly_and_within_reason() -> None:
    observer = DisturbanceObserver(DisturbanceParams(), 0.5)
    observer.learn_hover(0.6)
    assert observer.estimate.hover_thrust_01 == pytest.approx(0.52)
    for _ in range(60):
        observer.learn_hover(0.01)
    assert observer.estimate.hover_thrust_01 == pytest.approx(0.2, abs=1e-3)  # 0.4 of the first guess at least


def test_disabled_it_keeps_the_configured_values() -> None:
    observer = DisturbanceObserver(DisturbanceParams(enabled=False), 0.5)
    observe(observer, 2.0, np.array([1.0, 0.0, 1.0]), 0.5)
    observer.learn_hover(0.9)
    np.testing.assert_array_equal(observer.estimate.disturbance_ned_m_s2, 0.0)
    assert observer.estimate.hover_thrust_01 == 0.5
