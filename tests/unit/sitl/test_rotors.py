"""Rotors: thrust curve, lag, failure, ground effect, battery, mass; each gone when it is switched off."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sitl.plant.airframes import PRESETS
from sitl.plant.battery import Battery
from sitl.plant.physics import outfitted
from sitl.plant.vehicle import Plant
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.simulator_config import BatteryParams, SimulatorParams
from tests.benches.flown_world import FlownWorld

X500 = PRESETS["x500"]
DT_S = 0.004


def plant_at(height_m: float = 5.0, **options: object) -> Plant:
    plant = Plant(X500, np.zeros((1, 3)), DT_S, **options)  # type: ignore[arg-type]
    plant.state[12] = -height_m
    plant.contact[:] = False
    plant.refresh()
    return plant


def lift_m_s2(plant: Plant, thrust_01: float) -> float:
    """Upward acceleration at rest under a steady thrust setpoint, gravity not counted."""
    wrench = np.array([[thrust_01 * X500.thrust_max_n], [0.0], [0.0], [0.0]])
    commanded = plant.mixer.allocate(wrench)
    plant.rotor_force_n[...] = plant._achievable(commanded)
    plant.step(commanded)
    return GRAVITY_M_S2 - float(plant.vel_ned_m_s[2, 0]) / DT_S


@pytest.mark.parametrize("thrust_01", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("k", [0.0, 0.3, 1.0])
def test_thrust_curve(k: float, thrust_01: float) -> None:
    force_01 = (1 - k) * thrust_01 + k * thrust_01**2
    assert lift_m_s2(plant_at(thrust_curve_01=k), thrust_01) == pytest.approx(20.0 * force_01, abs=0.06)


def test_hover_thrust_knows_the_curve() -> None:
    for k in (0.0, 0.4, 1.0):
        plant = plant_at(thrust_curve_01=k)
        assert lift_m_s2(plant, plant.hover_thrust_01) == pytest.approx(GRAVITY_M_S2, rel=1e-3)


def test_motor_lag_is_what_was_asked_for() -> None:
    for tau_s in (0.02, 0.1):
        plant = Plant(outfitted(X500, SimulatorParams(motor_tau_s=tau_s)), np.zeros((1, 3)), DT_S, ground=False)
        for _ in range(round(tau_s / DT_S)):
            plant.step(np.ones((4, 1)))
        assert plant.rotor_force_n[0, 0] == pytest.approx(1 - math.exp(-1), rel=0.02)
    at_once = Plant(outfitted(X500, SimulatorParams(motor_tau_s=0.0)), np.zeros((1, 3)), DT_S, ground=False)
    at_once.step(np.ones((4, 1)))
    assert at_once.rotor_force_n[0, 0] == 1.0
    assert outfitted(X500, SimulatorParams()) == X500


def test_ground_effect_is_cheeseman_and_bennetts() -> None:
    radius_m = X500.rotor_radius_m
    for height_m in (0.05, 0.2, 2.0):
        z_m = height_m + radius_m
        gain = 1.0 / (1.0 - (radius_m / (4.0 * z_m)) ** 2)
        assert lift_m_s2(plant_at(height_m, ground_effect=True), 0.5) == pytest.approx(10.0 * gain, rel=2e-3)
        assert lift_m_s2(plant_at(height_m), 0.5) == pytest.approx(10.0, rel=2e-3)
    assert lift_m_s2(plant_at(0.01, ground_effect=True), 0.5) > 10.5


def test_a_failed_rotor_gives_its_share_only() -> None:
    plant = plant_at()
    plant.rotor_share_01 = np.array([[0.5], [1.0], [1.0], [1.0]])
    assert lift_m_s2(plant, 0.5) == pytest.approx(10.0 * 3.5 / 4.0, rel=2e-3)
    assert plant.rate_frd_rad_s[1, 0] > 0.0  # the rear one: the tail drops
    plant = plant_at()
    lift_m_s2(plant, 0.5)
    assert plant.rate_frd_rad_s[1, 0] == 0.0


def test_another_mass_changes_thrust_and_drag_per_kilogram() -> None:
    plant = plant_at()
    plant.mass_ratio = np.array([2.0])
    assert lift_m_s2(plant, 0.5) == pytest.approx(5.0, rel=2e-3)
    heavy, built_heavy = plant_at(), plant_at(mass_scale=1.5)
    heavy.mass_ratio = np.array([1.5])
    for plant in (heavy, built_heavy):
        plant.set_wind(np.array([[3.0], [1.0], [0.0]]))
        for _ in range(100):
            plant.step(plant.mixer.allocate(np.array([[12.0], [0.02], [0.0], [0.0]])))
    assert heavy.state == pytest.approx(built_heavy.state, abs=1e-3)


def test_battery_empties_by_what_the_rotors_draw() -> None:
    battery = Battery(BatteryParams(capacity_mah=5000), X500, 1)
    hover_n = np.full((4, 1), X500.mass_kg * GRAVITY_M_S2 / 4)
    battery.advance(1.0, hover_n)
    assert 4.0 < float(battery.amperes[0]) < 12.0  # 1 kg on 10 inch propellers: about 80 W
    for _ in range(60):
        battery.advance(10.0, hover_n)
    minutes = 10.0 / (1.0 - float(battery.charge_01[0]))
    assert 40 < minutes < 80
    assert float(battery.volts[0]) < 16.3
    assert float(battery.force_01[0]) == pytest.approx((float(battery.volts[0]) / 16.8) ** 2)


def test_load_sags_the_voltage() -> None:
    battery = Battery(BatteryParams(capacity_mah=5000, resistance_ohm=0.1), X500, 1)
    stiff = Battery(BatteryParams(capacity_mah=5000, resistance_ohm=0.0), X500, 1)
    for pack in (battery, stiff):
        pack.advance(0.02, np.full((4, 1), 4.0))
    assert stiff.volts[0] - battery.volts[0] == pytest.approx(0.1 * battery.amperes[0], rel=0.01)


def test_negative_control_without_a_model_nothing_is_drawn() -> None:
    battery = Battery(BatteryParams(), X500, 1)
    battery.advance(1000.0, np.full((4, 1), 5.0))
    assert battery.charge_01[0] == 1.0
    assert battery.force_01[0] == 1.0
    flown = FlownWorld(preset="x500")
    flown.step(1.0)
    assert flown.world.plant.rotor_share_01 is None


def test_an_empty_battery_costs_thrust_in_flight() -> None:
    """Hovering on 20 % needs a higher setpoint than on a full pack, and the autopilot knows charge and voltage."""
    setpoints = []
    for charge_01 in (1.0, 0.2):
        realism = {"battery": {"capacity_mah": 3000.0, "charge_01": charge_01, "resistance_ohm": 0.05}}
        flown = FlownWorld(preset="x500", realism=realism)
        flown.take_off()
        flown.step(3.0)
        setpoints.append(float(flown.world.autopilots[0].output.thrust_01))
        told = flown.world.estimator.of(0, 0).battery
        assert told.charge_01 == pytest.approx(charge_01, abs=0.02)
        assert told.volts == pytest.approx(float(flown.world.physics.battery.volts[0]))
        assert told.amperes > 3.0
    assert setpoints[1] > 1.2 * setpoints[0]


def test_crazyflie_hovers_and_is_quick() -> None:
    flown = FlownWorld(preset="crazyflie")
    flown.take_off()
    assert flown.pos_ned_m[0, 2] == pytest.approx(-2.5, abs=0.2)
    assert flown.tilt_deg[0] < 0.5
    assert 0.40 < flown.world.plant.hover_thrust_01 < 0.47  # 28 g under 65 g
