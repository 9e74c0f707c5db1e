"""Tests that the filter removes errors of an autopilot's estimate and leaves exact states unchanged."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swarmctl.control.estimation.disturbance import DisturbanceParams
from swarmctl.control.estimation.state_filter import StateFilter, StateFilterParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.frames import quat_from_body_z
from swarmctl.core.types import Array, VehicleState
from tests import builders

HOVER_01 = 0.5
STEP_US = 20_000
STEP_S = STEP_US * 1e-6


def make(disturbance: DisturbanceParams | None = None, **params: Any) -> StateFilter:
    model = VehicleModelParams(delay_s=0.0, drag_1_s=1.0, hover_thrust_01=HOVER_01)
    return StateFilter(StateFilterParams(enabled=True, **params), disturbance or DisturbanceParams(), model)


def sample(t_us: int, pos: Array, vel: Array, q_nb: Array | None = None) -> VehicleState:
    level = np.array([1.0, 0.0, 0.0, 0.0]) if q_nb is None else q_nb
    return builders.vehicle_state(t_us=t_us, pos_ned_m=pos, vel_ned_m_s=vel, q_nb=level)


class World:
    """A point mass that flies to and fro with wind and drag, and an estimator with errors."""

    def __init__(self, wind_m_s2: Array, bias_m_s: float = 0.0, noise: float = 0.0, seed: int = 1) -> None:
        self.t_us, self.pos, self.vel = 0, np.zeros(3), np.zeros(3)
        self._wind, self._bias, self._noise = wind_m_s2, bias_m_s, noise
        self._rng = np.random.default_rng(seed)

    def step(self) -> VehicleState:
        t_s = self.t_us * 1e-6
        lean = 0.2 * math.sin(1.3 * t_s)
        down = np.array([lean, 0.1 * math.cos(0.7 * t_s), 0.0])
        down[2] = math.sqrt(1.0 - float(down @ down))
        reported = sample(
            self.t_us,
            self.pos + 0.1 * self._noise * self._rng.normal(size=3),
            self.vel + self.bias_ned_m_s + self._noise * self._rng.normal(size=3),
            quat_from_body_z(down, 0.3),
        )
        for _ in range(20):
            accel = -9.81 * down + np.array([0.0, 0.0, 9.81]) + self._wind - 1.0 * self.vel
            self.pos = self.pos + 1e-3 * self.vel
            self.vel = self.vel + 1e-3 * accel
        self.t_us += STEP_US
        return reported

    @property
    def bias_ned_m_s(self) -> Array:
        t_s = self.t_us * 1e-6
        return self._bias * np.array([math.sin(0.8 * t_s), math.cos(0.6 * t_s), 0.5 * math.sin(0.5 * t_s)])


def velocity_error_m_s(world: World, filtered: StateFilter, seconds: float, skip_s: float) -> float:
    """Return the RMS error over time and axes of the velocity used for planning."""
    errors = []
    for k in range(round(seconds / STEP_S)):
        truth = world.vel.copy()
        reported = world.step()
        filtered.update(reported, HOVER_01)
        if k * STEP_S > skip_s:
            errors.append(filtered.state(reported).vel_ned_m_s - truth)
    return float(np.sqrt(np.mean(np.square(errors))))


def test_a_bias_of_the_reported_velocity_is_taken_out() -> None:
    left = velocity_error_m_s(World(np.zeros(3), bias_m_s=0.25, noise=0.02), make(), 30.0, 5.0)
    believed = velocity_error_m_s(World(np.zeros(3), bias_m_s=0.25, noise=0.02), make(bias_m_s=0.0), 30.0, 5.0)
    assert left < 0.06
    assert believed > 2.0 * left, "negative control: without the bias state the bias remains"


def test_exact_states_stay_as_they_are() -> None:
    assert velocity_error_m_s(World(np.zeros(3)), make(), 10.0, 2.0) < 0.01


def test_wind_is_found_and_the_hover_thrust_takes_the_vertical_part() -> None:
    filtered, world = make(), World(np.array([1.5, -0.7, 0.4]), noise=0.01)
    for _ in range(round(15.0 / STEP_S)):
        estimate = filtered.update(world.step(), HOVER_01)
    np.testing.assert_allclose(estimate.disturbance_ned_m_s2[:2], [1.5, -0.7], atol=0.12)
    lift_m_s2 = HOVER_01 * 9.81 / estimate.hover_thrust_01
    assert 9.81 - lift_m_s2 + float(estimate.disturbance_ned_m_s2[2]) == pytest.approx(0.4, abs=0.1)


def test_a_disturbance_is_bounded() -> None:
    filtered, world = make(), World(np.array([30.0, 0.0, 0.0]))
    for _ in range(500):
        estimate = filtered.update(world.step(), HOVER_01)
    assert abs(float(estimate.disturbance_ned_m_s2[0])) == pytest.approx(DisturbanceParams().limit_m_s2)


def test_while_the_autopilot_flies_no_disturbance_is_learned_and_velocity_is_right() -> None:
    filtered, world = make(), World(np.array([2.0, 0.0, 0.0]), bias_m_s=0.2)
    for _ in range(500):
        truth = world.vel.copy()
        reported = world.step()
        estimate = filtered.update(reported, None)
    assert not estimate.disturbance_ned_m_s2.any()
    assert estimate.hover_thrust_01 == HOVER_01
    assert np.abs(filtered.state(reported).vel_ned_m_s - truth).max() < 0.3


def test_a_jump_of_the_reported_position_is_taken_over_at_once_and_the_wind_is_kept() -> None:
    filtered, world = make(), World(np.array([1.0, 0.0, 0.0]))
    for _ in range(500):
        before = filtered.update(world.step(), HOVER_01)
    reported = world.step()
    moved = replace(reported, pos_ned_m=reported.pos_ned_m + 5.0)
    after = filtered.update(moved, HOVER_01)
    np.testing.assert_array_equal(filtered.state(moved).pos_ned_m, moved.pos_ned_m)
    np.testing.assert_array_equal(after.disturbance_ned_m_s2, before.disturbance_ned_m_s2)


def test_a_gap_restarts_the_filter() -> None:
    filtered = make()
    filtered.update(sample(0, np.zeros(3), np.ones(3)), None)
    late = sample(1_000_000, np.ones(3), np.zeros(3))
    filtered.update(late, None)
    np.testing.assert_array_equal(filtered.state(late).vel_ned_m_s, np.zeros(3))


def test_a_sample_it_has_not_seen_is_passed_on() -> None:
    filtered, unseen = make(), sample(7, np.ones(3), np.ones(3))
    assert filtered.state(unseen) is unseen


def test_thrust_acts_after_the_dead_time() -> None:
    """A thrust step is expected when it acts, not when it is sent, so that no disturbance appears."""
    model = VehicleModelParams(delay_s=0.1, hover_thrust_01=HOVER_01)
    worst = {}
    for name, dead_us in (("modelled", 100_000), ("ignored", 0)):
        filtered = StateFilter(StateFilterParams(enabled=True), DisturbanceParams(), model)
        vel, pos, found = np.zeros(3), np.zeros(3), []
        for k in range(300):
            t_us = k * STEP_US
            sent_01 = 0.6 if (k // 25) % 2 else 0.4
            arrived = t_us - dead_us
            acts_01 = (0.6 if (arrived // STEP_US // 25) % 2 else 0.4) if arrived >= 0 else HOVER_01
            found.append(float(filtered.update(sample(t_us, pos.copy(), vel.copy()), sent_01).disturbance_ned_m_s2[2]))
            accel = 9.81 * (1.0 - acts_01 / HOVER_01)
            pos[2] += STEP_S * vel[2] + 0.5 * STEP_S**2 * accel
            vel[2] += STEP_S * accel
        worst[name] = float(np.sqrt(np.mean(np.square(found[50:]))))
    assert worst["modelled"] < 0.5 * worst["ignored"]


@pytest.mark.parametrize("controls", [True, False])
def test_a_fast_vehicle_whose_states_are_rare_does_not_jump(controls: bool) -> None:
    """At 11 m/s it moves by more than `jump_m` between two states of 10 Hz."""
    filtered, vel, bias, errors_m_s = make(bias_m_s=0.3), np.array([11.0, 0.0, 0.0]), np.array([0.3, 0.3, 0.0]), []
    lean = quat_from_body_z(np.array([-11.0, 0.0, 9.81]) / math.hypot(11.0, 9.81), 0.0)
    thrust_01 = HOVER_01 * math.hypot(11.0, 9.81) / 9.81 if controls else None
    for k in range(200):
        reported = sample(k * 100_000, 0.1 * k * vel, vel + bias, lean)
        filtered.update(reported, thrust_01)
        errors_m_s.append(float(np.linalg.norm(filtered.state(reported).vel_ned_m_s - vel)))
    assert max(errors_m_s[100:]) < 0.1, "its bias of 0.42 m/s is known"
    jumped = sample(200 * 100_000, 20.0 * vel + [0.0, 1.5, 0.0], vel + bias, lean)
    filtered.update(jumped, thrust_01)
    np.testing.assert_allclose(filtered.state(jumped).pos_ned_m, jumped.pos_ned_m, err_msg="what jumps is believed")


def test_where_nothing_is_to_be_estimated_the_model_is_taken_as_it_is() -> None:
    off, on = make(DisturbanceParams(enabled=False)), make()
    for found in (off, on):
        found.reset()
        for k in range(100):
            t_s = k * STEP_S
            pos, vel = np.array([t_s * t_s, 0.0, 0.5 * t_s * t_s]), np.array([2.0 * t_s, 0.0, t_s])
            found.update(sample(k * STEP_US, pos, vel), HOVER_01)
        found.learn_hover(0.6)
    np.testing.assert_array_equal(off.estimate.disturbance_ned_m_s2, 0.0)
    assert off.estimate.hover_thrust_01 == HOVER_01
    assert on.estimate.disturbance_ned_m_s2[0] > 1.0 and on.estimate.hover_thrust_01 > HOVER_01
