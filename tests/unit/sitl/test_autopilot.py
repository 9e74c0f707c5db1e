"""Modes, arming, offboard loss and AUTO flight, driven over MAVLink bytes on a simulated clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sitl.net.mavlink_values import Result
from sitl.px4.modes import OffboardLoss, Px4Mode
from swarmctl.core.frames import quat_from_euler
from swarmctl.core.types import Landed
from tests.benches.px4_bench import COARSE, HOVER, LEVEL, NAN, Bench, taken_off

# --- arming ---


@pytest.mark.parametrize("main", [1, 2, 7])
def test_manual_modes_need_a_pilot(main: int) -> None:
    bench = Bench()
    assert bench.mode(main) == Result.ACCEPTED
    assert bench.arm() == Result.TEMPORARILY_REJECTED
    armed = Bench()
    armed.arm()
    assert armed.mode(main) == Result.TEMPORARILY_REJECTED


@pytest.mark.parametrize("params", [(1, 4, 1), (1, 4, 99), (NAN, 6), (1, NAN), (1e30, 6)])
def test_nonsense_modes_are_refused(params: tuple[float, ...]) -> None:
    bench = Bench()
    assert bench.command(176, *params) == Result.TEMPORARILY_REJECTED
    assert bench.pilot.mode == Px4Mode.AUTO_LOITER


@pytest.mark.parametrize("limit_s", [2.0, 5.0])
def test_preflight_disarm(limit_s: float) -> None:
    bench = Bench(**COARSE)
    bench.pilot.parameters.assign("COM_DISARM_PRFLT", limit_s)
    bench.arm()
    bench.run(limit_s + 0.9)  # and COM_SPOOLUP_TIME
    assert bench.pilot.armed
    bench.run(0.2)
    assert not bench.pilot.armed


# --- offboard ---


@pytest.mark.parametrize(("action", "mode"), [(OffboardLoss.LAND, Px4Mode.AUTO_LAND), (99, Px4Mode.AUTO_RTL)])
def test_loss_actions_land_and_keep_the_commanded_mode(action: int, mode: Px4Mode) -> None:
    bench = Bench(**COARSE).in_offboard(height_m=2.0)
    bench.pilot.parameters.assign("COM_OBL_RC_ACT", action)
    bench.run(1.1)
    assert (bench.pilot.mode, bench.pilot.intended) == (mode, Px4Mode.OFFBOARD)
    assert bench.pilot.armed
    bench.run(17.0)
    assert bench.height_m < 0.01
    assert not bench.pilot.armed
    assert bench.pilot.mode == Px4Mode.OFFBOARD


@pytest.mark.parametrize(
    ("q", "thrust"),
    [
        ([0.0] * 4, 0.5),
        ([NAN, 0, 0, 0], 0.5),
        ([1.0, 0, 0, math.inf], 0.5),
        (LEVEL, NAN),
        (LEVEL, math.inf),
        ([3e38] * 4, 0.5),
    ],
)
def test_unusable_setpoints_are_refused_and_no_stream(q: list[float], thrust: float) -> None:
    bench = Bench().in_offboard(height_m=2.0)
    bench.run(0.9, 50, q=q, thrust=thrust)
    assert bench.world.plant.rotor_force_n.sum() == pytest.approx(9.81, rel=0.02)
    assert sum(bench.pilot.refused.values()) == 45 or q == [3e38] * 4
    bench.run(0.3, 50, q=q, thrust=thrust)
    assert bench.pilot.mode == Px4Mode.OFFBOARD if q == [3e38] * 4 else Px4Mode.AUTO_RTL
    assert np.isfinite(bench.world.plant.state).all()


def test_a_setpoint_acts_in_the_next_physics_step() -> None:
    bench = Bench().in_offboard(height_m=1.0)
    before = bench.world.plant.rate_frd_rad_s[0, 0]
    bench.setpoint(q=quat_from_euler(0.05, 0, 0).tolist())
    bench.run(0.004)
    assert bench.world.plant.rate_frd_rad_s[0, 0] - before > 0.1


# --- AUTO ---


@pytest.mark.parametrize("preset", ["thesis", "x500"])
@pytest.mark.parametrize("mass_scale", [1.0, 1.3])
def test_takeoff_holds_at_its_altitude(preset: str, mass_scale: float) -> None:
    bench = taken_off(preset, mass_scale=mass_scale)
    bench.run(2.0)
    assert bench.height_m == pytest.approx(2.5, abs=0.05)
    assert bench.speed_m_s < 0.05
    assert bench.pilot.output.thrust_01 == pytest.approx(mass_scale * HOVER, rel=0.03)


@pytest.mark.parametrize("preset", ["thesis", "x500"])
def test_land_brakes_and_lands_softly(preset: str) -> None:
    bench = Bench(preset, **COARSE).in_offboard(height_m=4.0)
    bench.run(1.0, 50, q=quat_from_euler(0, -0.3, 0).tolist())  # nose down: off to the north
    start_m, speed = bench.world.truth_rows()[0]["pos_ned_m"][0], bench.speed_m_s
    assert speed > 1.5
    assert bench.command(21) == Result.ACCEPTED
    fastest_down = fastest_low = 0.0
    while bench.height_m > 0.001:
        bench.run(0.02)
        down_m_s = float(bench.world.truth_rows()[0]["vel_ned_m_s"][2])
        fastest_down = max(fastest_down, down_m_s)
        fastest_low = max(fastest_low, down_m_s if bench.height_m < 2.0 else 0.0)
        assert bench.clock.now_us() < 40e6
    assert bench.world.truth_rows()[0]["pos_ned_m"][0] - start_m < speed**2 / 2 + 2.0  # braked, not coasted
    assert fastest_down < 1.7  # MPC_Z_VEL_MAX_DN, and no plunge
    assert fastest_low < 0.9  # MPC_LAND_SPEED
    bench.run(3.0)
    assert not bench.pilot.armed


def test_disarm_after_landing_takes_its_parameter() -> None:
    bench = taken_off()
    bench.pilot.parameters.assign("COM_DISARM_LAND", 4.0)
    bench.command(21)
    while bench.pilot.landed != Landed.ON_GROUND:
        bench.run(0.1)
    bench.run(3.8)
    assert bench.pilot.armed
    bench.run(0.4)
    assert not bench.pilot.armed


@pytest.mark.parametrize("preset", ["thesis", "x500"])
def test_rtl_flies_home_and_lands(preset: str) -> None:
    bench = Bench(preset, **COARSE).in_offboard(height_m=3.0)
    bench.run(1.5, 50, q=quat_from_euler(0.25, 0, 0).tolist())
    bench.run(2.0, 50)
    away = bench.world.truth_rows()[0]["pos_ned_m"][1] - 2.0
    assert away > 3.0
    assert bench.mode(4, 5) == Result.ACCEPTED
    bench.run(28.0)
    end = bench.world.truth_rows()[0]["pos_ned_m"]
    assert math.dist(end, (1.0, 2.0, 0.5)) < 0.7
    assert not bench.pilot.armed


def test_air_start_hangs_until_offboard() -> None:
    bench = Bench(start="air", **COARSE)
    assert bench.pilot.landed == Landed.IN_AIR
    assert bench.arm() == Result.ACCEPTED
    bench.run(11.0)  # no preflight disarm: it is in the air
    start = bench.world.truth_rows()[0]["pos_ned_m"]
    np.testing.assert_allclose(start, [1.0, 2.0, 0.5], atol=1e-9)
    bench.setpoint()
    bench.mode(6)
    bench.run(0.5, 50, thrust=0.0)
    assert bench.world.truth_rows()[0]["pos_ned_m"][2] > 1.5  # free fall, and no ground to stop it


def test_terminate_command_is_final() -> None:
    bench = Bench().in_offboard(height_m=1.0)
    assert bench.command(185, 1) == Result.ACCEPTED
    assert bench.arm() == Result.TEMPORARILY_REJECTED
    bench.run(0.02)
    assert bench.world.plant.rotor_force_n.max() == 0.0
