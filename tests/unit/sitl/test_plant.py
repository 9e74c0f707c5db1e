"""The batched plant against thesis (1.18) written out by hand, and against model-independent physics."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sitl.plant.airframes import PRESETS
from sitl.plant.vehicle import RATE_LIMIT_RAD_S, Plant
from swarmctl.core.frames import quat_from_euler

Array = NDArray[np.float64]
G = 9.81


def plant_at(
    preset: str = "thesis", *, euler: tuple[float, float, float] = (0, 0, 0), dt_s: float = 0.004, ground: bool = False
) -> Plant:
    plant = Plant(PRESETS[preset], np.zeros((1, 3)), dt_s, ground=ground)
    plant.state[:4, 0] = quat_from_euler(*euler)
    return plant


def forces(plant: Plant, *wrench: float) -> Array:
    return plant.mixer.allocate(np.array(wrench).reshape(4, 1)).copy()


def thesis_rhs(_t: float, s: Array, f_t: float, tau: Array, w_r: float) -> list[float]:
    """(1.18) with its errata fixed, typed from the thesis and not from the code under test."""
    phi, theta, psi, p, q, r, u, v, w = s[:9]
    ix = iy = 8e-3
    iz, jr, m = 14.2e-3, 1.08e-6, 1.0
    sp, cp, st, ct, ss, cs = (
        math.sin(phi),
        math.cos(phi),
        math.sin(theta),
        math.cos(theta),
        math.sin(psi),
        math.cos(psi),
    )
    return [
        p + r * cp * math.tan(theta) + q * sp * math.tan(theta),
        q * cp - r * sp,
        (r * cp + q * sp) / ct,
        (iy - iz) / ix * r * q + tau[0] / ix - 0.03 * p - jr * p * w_r,
        (iz - ix) / iy * p * r + tau[1] / iy - 0.03 * q + jr * q * w_r,
        (ix - iy) / iz * p * q + tau[2] / iz - 0.01 * r,
        r * v - q * w - G * st - 0.048 * u,
        p * w - r * u + G * sp * ct - 0.11 * v,
        q * u - p * v + G * ct * cp - f_t / m - 0.046 * w,
        w * (sp * ss + cp * cs * st) - v * (cp * ss - cs * sp * st) + u * cs * ct,
        v * (cp * cs + sp * ss * st) - w * (cs * sp - cp * ss * st) + u * ct * ss,
        w * cp * ct - u * st + v * ct * sp,
    ]


@pytest.mark.parametrize("seed", range(5))
def test_plant_follows_the_thesis_equations(seed: int) -> None:
    rng = np.random.default_rng([seed, 0, 1])
    euler = rng.uniform(-0.5, 0.5, 3)
    plant = plant_at(euler=tuple(euler))
    plant.state[4:7, 0] = rng.uniform(-0.5, 0.5, 3)
    plant.state[7:10, 0] = rng.uniform(-2, 2, 3)
    tau = rng.uniform(-4e-3, 4e-3, 3)
    f_t = float(rng.uniform(8, 11))
    start = np.concatenate([euler, plant.state[4:, 0]])
    rotor = forces(plant, f_t, *tau)
    w1, w2, w3, w4 = np.sqrt(rotor[:, 0] / 54.2e-6)
    truth = solve_ivp(thesis_rhs, (0, 0.6), start, args=(f_t, tau, w1 - w2 + w3 - w4), rtol=1e-10, atol=1e-12).y[:, -1]
    for _ in range(150):
        plant.step(rotor)
    ours = np.concatenate([plant.euler_rad[:, 0], plant.state[4:, 0]])
    np.testing.assert_allclose(ours, truth, atol=2e-6)


def test_integrator_is_third_order() -> None:
    ends = []
    for dt_s in (0.02, 0.01, 0.0025):
        plant = plant_at(dt_s=dt_s)
        rotor = forces(plant, 12.0, 0.02, 0.015, 0.001)
        for _ in range(round(0.5 / dt_s)):
            plant.step(rotor)
        ends.append(plant.state[:, 0].copy())
    coarse, fine = np.abs(ends[0] - ends[2]).max(), np.abs(ends[1] - ends[2]).max()
    assert 6.0 < coarse / fine < 11.0  # 2^3, within the reference's own error


def test_free_fall_moves_only_z_and_w() -> None:
    plant = plant_at(dt_s=0.02)
    for _ in range(500):  # thesis experiment 1, 10 s
        plant.step(np.zeros((4, 1)))
    moved = np.flatnonzero(plant.state[:, 0])
    assert moved.tolist() == [0, 9, 12]  # qw = 1, w, z
    terminal = G / 0.046
    assert plant.state[9, 0] == pytest.approx(terminal * (1 - math.exp(-0.46)), rel=1e-6)


@pytest.mark.parametrize(
    ("euler_deg", "axis", "sign"),
    [((0, 10, 0), 0, -1), ((10, 0, 0), 1, +1), ((0, 10, 90), 1, -1), ((10, 0, 90), 0, -1)],
)
def test_golden_directions(euler_deg: tuple[float, float, float], axis: int, sign: int) -> None:
    """Nose up flies backwards (x'' = -(f/m) sin(theta)), roll right flies right; yaw 90 deg turns both."""
    plant = plant_at(euler=tuple(math.radians(a) for a in euler_deg))  # type: ignore[arg-type]
    rotor = forces(plant, G, 0, 0, 0)
    for _ in range(25):
        plant.step(rotor)
    velocity = plant.vel_ned_m_s[:, 0]
    assert velocity[axis] == pytest.approx(sign * G * math.sin(math.radians(10)) * 0.1, rel=0.02)
    assert abs(velocity[1 - axis]) < 1e-9


@pytest.mark.parametrize(("row", "wrench"), [(4, (G, 1e-3, 0, 0)), (5, (G, 0, 1e-3, 0)), (6, (G, 0, 0, 1e-3))])
def test_positive_torque_turns_positive(row: int, wrench: tuple[float, ...]) -> None:
    plant = plant_at()
    plant.step(forces(plant, *wrench))
    inertia = (8e-3, 8e-3, 14.2e-3)[row - 4]
    assert plant.state[row, 0] == pytest.approx(1e-3 / inertia * 0.004, rel=1e-3)
    assert np.count_nonzero(np.abs(plant.state[4:7, 0]) > 1e-9) == 1


def test_allocation_is_exact_inside_the_limits() -> None:
    plant = plant_at()
    wrench = np.array([[9.0], [0.2], [-0.1], [0.03]])
    np.testing.assert_allclose(plant.mixer.wrench_of_forces @ plant.mixer.allocate(wrench), wrench, atol=1e-12)


@pytest.mark.parametrize("wrench", [(-20, 0, 0, 0), (40, 0, 0, 0), (10, 9, -9, 0), (10, 0, 0, 50), (0, 1, 1, -50)])
def test_rotors_stay_within_their_limits(wrench: tuple[float, ...]) -> None:
    plant = plant_at()
    rotor = forces(plant, *wrench)
    assert rotor.min() >= 0.0
    assert rotor.max() <= 5.0


def test_yaw_takes_only_the_room_roll_and_pitch_leave() -> None:
    plant = plant_at()
    achieved = plant.mixer.wrench_of_forces @ forces(plant, 10.0, 0.3, -0.2, 5.0)
    np.testing.assert_allclose(achieved[:3, 0], [10.0, 0.3, -0.2], atol=1e-12)
    assert 0 < achieved[3, 0] < 0.2


def test_a_tumbling_vehicle_stays_finite() -> None:
    plant = plant_at()
    rotor = np.array([[0.0], [0.0], [5.0], [5.0]])
    for _ in range(5000):
        plant.step(rotor)
    assert np.isfinite(plant.state).all()
    assert np.abs(plant.state[4:7]).max() <= RATE_LIMIT_RAD_S
    assert np.linalg.norm(plant.state[:4, 0]) == pytest.approx(1.0)


def test_vertical_attitude_is_not_singular() -> None:
    plant = plant_at(euler=(0.3, math.pi / 2, 0.2))
    for _ in range(100):
        plant.step(forces(plant, 5.0, 0, 0.01, 0))
    assert np.isfinite(plant.state).all()
    assert np.isfinite(plant.euler_rad).all()


def test_ground_carries_and_lets_go() -> None:
    plant = plant_at(ground=True)
    for _ in range(250):
        plant.step(forces(plant, 9.0, 0.05, 0.05, 0))
    np.testing.assert_allclose(plant.pos_ned_m[:, 0], 0.0, atol=1e-7)
    np.testing.assert_array_equal(plant.rate_frd_rad_s[:, 0], 0.0)
    assert plant.contact[0]
    for _ in range(50):
        plant.step(forces(plant, 12.0, 0, 0, 0))
    assert plant.pos_ned_m[2, 0] == pytest.approx(-0.5 * (12.0 - G) * 0.2**2, rel=0.05)
    assert not plant.contact[0]


def test_touch_down_stops_without_penetration() -> None:
    plant = plant_at(euler=(0.2, -0.1, 0.7), ground=True)
    plant.state[10:13, 0] = 0.0, 0.0, -1.0
    plant.state[7, 0] = 3.0
    deepest = -math.inf
    for _ in range(750):
        plant.step(np.zeros((4, 1)))
        deepest = max(deepest, float(plant.pos_ned_m[2, 0]))
    assert deepest <= 0.0
    assert np.abs(plant.vel_ned_m_s).max() < 1e-9
    np.testing.assert_allclose(plant.euler_rad[:2, 0], 0.0, atol=1e-9)
    assert plant.euler_rad[2, 0] == pytest.approx(0.7, abs=0.1)  # the heading it came down with


def test_steps_that_would_change_nothing_are_left_out_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plant that forgets before every step that it is at rest computes them all, to the same bits."""
    plants = [Plant(PRESETS["x500"], np.zeros((2, 3)), 0.004) for _ in range(2)]
    computed = [0, 0]
    for number, plant in enumerate(plants):

        def count(number: int = number, integrate: Callable[[], None] = plant._integrate) -> None:
            computed[number] += 1
            integrate()

        monkeypatch.setattr(plant, "_integrate", count)
    rng = np.random.default_rng(5)
    for thrust_n, wind_m_s, steps in ((0.0, 0.0, 50), (0.0, 3.0, 50), (12.0, 3.0, 200), (0.0, 0.0, 700), (3.0, 0.0, 9)):
        wrench = np.array([[thrust_n] * 2, *rng.normal(0.0, 1e-3 * (thrust_n > 9.0), (3, 2))])
        for plant in plants:
            plant.set_wind(np.full((3, 2), wind_m_s))
        for _ in range(steps):
            plants[1]._at_rest = None
            for plant in plants:
                plant.step(plant.mixer.allocate(wrench))
            np.testing.assert_array_equal(plants[0].state, plants[1].state)
            np.testing.assert_array_equal(plants[0].vel_ned_m_s, plants[1].vel_ned_m_s)
    assert computed[1] == 1009
    assert computed[0] < 970  # before take-off; wind would move them a little


def test_each_vehicle_has_its_own_ground() -> None:
    plant = Plant(PRESETS["thesis"], np.array([[0.0, 0, 0], [1, 0, 2.5]]), 0.004)
    for _ in range(100):
        plant.step(np.zeros((4, 2)))
    np.testing.assert_array_equal(plant.pos_ned_m[2], [0.0, 2.5])


def test_batch_equals_single_vehicles() -> None:
    batch = Plant(PRESETS["thesis"], np.zeros((3, 3)), 0.004, ground=False)
    wrench = np.array([[9.0, 10.0, 11.0], [0.01, 0, -0.01], [0, 0.02, 0], [0.001, 0, 0]])
    for _ in range(100):
        batch.step(batch.mixer.allocate(wrench))
    for i in range(3):
        single = plant_at()
        for _ in range(100):
            single.step(forces(single, *wrench[:, i]))
        np.testing.assert_allclose(batch.state[:, i], single.state[:, 0], atol=1e-12)


def test_mass_scale_changes_the_mass_and_not_the_thrust() -> None:
    heavy = Plant(PRESETS["thesis"], np.zeros((1, 3)), 0.004, ground=False, mass_scale=1.5)
    for _ in range(25):
        heavy.step(forces(heavy, G, 0, 0, 0))
    assert heavy.vel_ned_m_s[2, 0] == pytest.approx((G - G / 1.5) * 0.1, rel=0.01)
    assert heavy.hover_thrust_01 == pytest.approx(1.5 * G / 20.0)


def test_x500_motor_lag_and_drag() -> None:
    plant = plant_at("x500")
    plant.step(np.full((4, 1), 5.0))
    assert plant.rotor_force_n[0, 0] == pytest.approx(5.0 * (1 - math.exp(-0.004 / 0.05)))
    falling = plant_at("x500")
    for _ in range(2500):
        falling.step(np.zeros((4, 1)))
    assert falling.vel_ned_m_s[2, 0] == pytest.approx(G, rel=1e-3)  # 1 kg, 1 N/(m/s)


def test_wind_carries_a_hovering_vehicle_along() -> None:
    plant = plant_at("x500")
    plant.set_wind(np.array([[2.0], [-1.0], [0.0]]))
    for _ in range(2500):
        plant.step(forces(plant, G, 0, 0, 0))
    np.testing.assert_allclose(plant.vel_ned_m_s[:2, 0], [2.0, -1.0], atol=1e-3)


def test_a_clamp_holds_under_full_thrust() -> None:
    plant = plant_at()
    plant.held[:] = True
    for _ in range(100):
        plant.step(forces(plant, 20.0, 0.1, 0, 0))
    np.testing.assert_array_equal(plant.state[1:, 0], 0.0)
