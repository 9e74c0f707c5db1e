"""Attitude loops: the thesis' PID sample by sample, and the step responses both airframes promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.plant.airframes import PRESETS
from sitl.plant.attitude import THESIS_GAINS, AttitudeLoop, CascadeAttitude, ThesisAttitude, attitude_loop
from sitl.plant.vehicle import Plant
from swarmctl.core.frames import quat_from_euler

Array = NDArray[np.float64]
LIVE = np.ones(1)


def step_response(preset: str, axis: int, angle_deg: float, dt_s: float = 0.004, duration_s: float = 2.0) -> Array:
    """Angle over its reference after a step at hover thrust, one sample a physics step."""
    plant = Plant(PRESETS[preset], np.zeros((1, 3)), dt_s, ground=False)
    loop = attitude_loop(plant.preset, 1, dt_s)
    euler = [0.0, 0.0, 0.0]
    euler[axis] = math.radians(angle_deg)
    for _ in range(50):
        fly(plant, loop)
    loop.set_reference(0, quat_from_euler(*euler))
    samples = []
    for _ in range(round(duration_s / dt_s)):
        fly(plant, loop)
        samples.append(plant.euler_rad[axis, 0] / euler[axis])
    return np.array(samples)


def fly(plant: Plant, loop: AttitudeLoop) -> None:
    wrench = np.zeros((4, 1))
    wrench[0] = plant.mass_kg * 9.81
    loop.torque(plant, LIVE, wrench[1:])
    plant.step(plant.mixer.allocate(wrench))


def reached_s(samples: Array, fraction: float, dt_s: float = 0.004) -> float:
    return float((np.argmax(samples >= fraction) + 1) * dt_s)


def test_thesis_pid_at_its_own_sample_time_is_the_discrete_pid() -> None:
    plant = Plant(PRESETS["thesis"], np.zeros((1, 3)), 0.02, ground=False)
    loop = ThesisAttitude(1, 0.02)
    gains, integral, last = THESIS_GAINS["swarm"], np.zeros(3), np.zeros(3)
    rng = np.random.default_rng([1, 0, 0])
    for _ in range(30):
        reference, angles = rng.uniform(-0.2, 0.2, 3), rng.uniform(-0.2, 0.2, 3)
        plant.euler_rad[:, 0] = angles
        loop.set_reference(0, quat_from_euler(*reference))
        error = reference - angles
        integral += error * 0.02
        expected = (
            np.array(gains.proportional) * error
            + np.array(gains.integral) * integral
            + np.array(gains.derivative) * (error - last) / 0.02
        )
        last = error
        torque = np.zeros((3, 1))
        loop.torque(plant, LIVE, torque)
        np.testing.assert_allclose(torque[:, 0], expected, atol=1e-12)


def test_reference_step_gives_the_same_impulse_at_any_rate() -> None:
    impulses = []
    for dt_s in (0.02, 0.01, 0.004, 0.002):
        plant = Plant(PRESETS["thesis"], np.zeros((1, 3)), dt_s, ground=False)
        loop = ThesisAttitude(1, dt_s)
        loop.set_reference(0, quat_from_euler(0.05, 0, 0))
        torque, total = np.zeros((3, 1)), 0.0
        for _ in range(round(0.02 / dt_s)):
            loop.torque(plant, LIVE, torque)
            total += float(torque[0, 0]) * dt_s
        impulses.append(total)
    np.testing.assert_allclose(impulses, impulses[0], rtol=1e-3)
    assert impulses[0] == pytest.approx(0.15 * 0.05, rel=0.01)


@pytest.mark.parametrize("dt_s", [0.02, 0.004])
@pytest.mark.parametrize("axis", [0, 1])
def test_thesis_attitude_is_fast(axis: int, dt_s: float) -> None:
    samples = step_response("thesis", axis, 5.0, dt_s)
    assert 0.03 < reached_s(samples, 0.63, dt_s) < 0.08  # I / kD = 53 ms
    assert samples.max() < 1.05


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("angle_deg", [10.0, -10.0, 30.0])
def test_x500_roll_and_pitch_answer_like_px4(axis: int, angle_deg: float) -> None:
    """PX4's measured t10 0.13-0.14, t50 0.26-0.28, t63 0.30-0.32, t90 0.46-0.51 s, max 10.1-10.3; one sample of slack.

    What its 30 deg step does not show here: a steady 29.2, 2.7 % short.
    """
    samples = step_response("x500", axis, angle_deg)
    assert 0.065 < reached_s(samples, 0.01) < 0.085  # first motion ~70 ms
    assert 0.126 < reached_s(samples, 0.10) < 0.144
    assert 0.256 < reached_s(samples, 0.50) < 0.284
    assert 0.296 < reached_s(samples, 0.63) <= 0.324
    assert 0.456 < reached_s(samples, 0.90) < 0.514
    assert 1.01 < samples.max() < 1.03
    assert samples[-1] == pytest.approx(1.0, abs=0.01)


def test_x500_roll_fits_the_published_model() -> None:
    """Dead time 80-85 ms and second order, w 9.0-10.5 rad/s, zeta 0.95-1.05, fitted PX4 to 1.2-1.7 % rms."""
    samples = step_response("x500", 0, 10.0)
    best = min(
        float(np.sqrt(np.mean((samples - second_order(len(samples), dead_s, omega, zeta)) ** 2)))
        for dead_s in (0.080, 0.085)
        for omega in np.arange(9.0, 10.6, 0.25)
        for zeta in (0.8, 0.85, 0.9, 0.95, 1.0)
    )
    assert best < 0.02
    slow = second_order(len(samples), 0.082, 7.0, 1.0)
    assert float(np.sqrt(np.mean((samples - slow) ** 2))) > 0.03


def second_order(steps: int, dead_s: float, omega: float, zeta: float, dt_s: float = 0.004) -> Array:
    """Step response of the model, by small explicit steps."""
    value, rate, out = 0.0, 0.0, np.zeros(steps)
    for k in range(steps * 4):
        if (k + 1) * dt_s / 4 > dead_s:
            rate += (omega**2 * (1.0 - value) - 2 * zeta * omega * rate) * dt_s / 4
            value += rate * dt_s / 4
        out[k // 4] = value
    return out


@pytest.mark.parametrize(
    ("thrust_01", "measured_m_s2"), [(0.388, 1.44), (0.488, -0.09), (0.588, -1.20), (0.688, -2.49)]
)
def test_x500_climbs_on_thrust_steps_like_px4(thrust_01: float, measured_m_s2: float) -> None:
    """NED z acceleration 0.25-0.7 s after a step from hover, px4 SIH: 1 kg, drag 1 N/(m/s), lag 0.05 s."""
    plant = Plant(PRESETS["x500"], np.zeros((1, 3)), 0.004, ground=False)
    plant.rotor_force_n[:] = 9.81 / 4
    speeds = []
    for _ in range(175):
        plant.step(np.full((4, 1), thrust_01 * 5.0))
        speeds.append(float(plant.vel_ned_m_s[2, 0]))
    mean_m_s2 = (speeds[-1] - speeds[61]) / ((174 - 61) * 0.004)
    assert mean_m_s2 == pytest.approx(measured_m_s2, abs=0.2)


def test_x500_yaw_answers_like_px4() -> None:
    """PX4: t10 0.26-0.32, t50 0.55-0.58, t63 0.62-0.66, t90 0.78-0.81 s, max 25.5-25.8, 22.4 at ~2 s; t90 is late."""
    samples = step_response("x500", 2, 20.0)
    assert 0.256 < reached_s(samples, 0.10) < 0.324
    assert 0.546 < reached_s(samples, 0.50) < 0.584
    assert 0.616 < reached_s(samples, 0.63) < 0.664
    assert 0.78 < reached_s(samples, 0.90) < 0.84
    assert 1.27 < samples.max() < 1.30
    assert 1.08 < samples[-1] < 1.14


@pytest.mark.parametrize("axis", [0, 1])
def test_crazyflie_is_twice_as_quick(axis: int) -> None:
    samples = step_response("crazyflie", axis, 10.0)
    assert 0.1 < reached_s(samples, 0.63) < 0.2
    assert samples.max() < 1.03
    assert samples[-1] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("loop", [ThesisAttitude(1, 0.004), CascadeAttitude(PRESETS["x500"], 1, 0.004)])
def test_idle_vehicles_get_no_torque_and_forget(loop: ThesisAttitude | CascadeAttitude) -> None:
    plant = Plant(PRESETS["thesis"], np.zeros((1, 3)), 0.004, ground=False)
    loop.set_reference(0, quat_from_euler(0.3, 0.1, 0))
    torque = np.zeros((3, 1))
    for _ in range(500):
        loop.torque(plant, np.zeros(1), torque)
        np.testing.assert_array_equal(torque, 0.0)
    loop.torque(plant, LIVE, torque)
    first = torque.copy()
    loop.torque(plant, LIVE, torque)
    assert abs(first[0, 0]) > 0.1  # the setpoint is a step from where the vehicle is
    assert torque[0, 0] == pytest.approx(first[0, 0], rel=0.1)  # nothing was wound up


def test_thesis_yaw_takes_the_short_way() -> None:
    plant = Plant(PRESETS["thesis"], np.zeros((1, 3)), 0.004, ground=False)
    plant.state[:4, 0] = quat_from_euler(0, 0, math.radians(175))
    plant.step(np.zeros((4, 1)))
    loop = ThesisAttitude(1, 0.004)
    loop.set_reference(0, quat_from_euler(0, 0, math.radians(-175)))
    torque = np.zeros((3, 1))
    loop.torque(plant, LIVE, torque)
    assert torque[2, 0] > 0
