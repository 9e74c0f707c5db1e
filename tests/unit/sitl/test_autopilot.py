"""Modes, arming, offboard loss and AUTO flight, driven over MAVLink bytes on a simulated clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sitl.px4.modes import MavState, OffboardLoss, Px4Mode, Result
from swarmctl.core.frames import quat_from_euler
from swarmctl.core.types import Landed
from tests.benches.px4_bench import COARSE, HOVER, LEVEL, NAN, Bench, taken_off

# --- arming ---


def test_arming_waits_for_the_estimator() -> None:
    bench = Bench(wait_s=0.5, ekf_ready_s=1.0)
    assert bench.pilot.system_status(0) == MavState.UNINIT
    assert bench.arm() == Result.TEMPORARILY_REJECTED
    assert any("Resolve system health" in t for t in bench.texts())
    bench.run(0.6)
    assert bench.arm() == Result.ACCEPTED
    assert bench.arm() == Result.ACCEPTED  # armed already


def test_arming_in_offboard_needs_a_stream() -> None:
    bench = Bench()
    assert bench.mode(6) == Result.ACCEPTED
    assert bench.pilot.base_mode() == 1
    assert bench.arm() == Result.TEMPORARILY_REJECTED
    assert bench.command(400, 1, 21196) == Result.TEMPORARILY_REJECTED
    bench.setpoint()
    bench.run(0.02)
    assert bench.pilot.base_mode() == 17
    assert bench.arm() == Result.ACCEPTED
    assert bench.pilot.base_mode() == 145


@pytest.mark.parametrize("main", [1, 2, 3, 5, 7])
def test_manual_modes_need_a_pilot(main: int) -> None:
    bench = Bench()
    assert bench.mode(main) == Result.ACCEPTED
    assert bench.arm() == Result.TEMPORARILY_REJECTED
    armed = Bench()
    armed.arm()
    assert armed.mode(main) == Result.TEMPORARILY_REJECTED


@pytest.mark.parametrize("params", [(1, 99), (0, 6), (1, 4, 1), (1, 4, 99), (NAN, 6), (1, NAN), (1e30, 6)])
def test_nonsense_modes_are_refused(params: tuple[float, ...]) -> None:
    bench = Bench()
    assert bench.command(176, *params) == Result.TEMPORARILY_REJECTED
    assert bench.pilot.mode == Px4Mode.AUTO_LOITER


def test_arm_with_a_strange_parameter_is_not_acknowledged() -> None:
    bench = Bench()
    assert bench.command(400, 5) is None
    assert not bench.pilot.armed


def test_disarm_in_the_air_needs_force() -> None:
    bench = Bench().in_offboard(height_m=1.0)
    assert bench.command(400, 0) == Result.TEMPORARILY_REJECTED
    assert bench.pilot.armed
    assert bench.command(400, 0, 21196) == Result.ACCEPTED
    assert not bench.pilot.armed
    bench.run(1.5)
    assert bench.height_m == pytest.approx(0.0, abs=1e-6)  # it falls, and not through the ground


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


def test_offboard_armed_needs_a_stream() -> None:
    bench = Bench().as_ground_station()
    bench.arm()
    assert bench.mode(6) == Result.TEMPORARILY_REJECTED
    assert any("Offboard is currently not available" in t for t in bench.texts())
    bench.setpoint()
    assert bench.mode(6) == Result.ACCEPTED  # one setpoint is enough


def test_attitude_only_takeoff_and_landed_state() -> None:
    bench = Bench().in_offboard()
    assert bench.pilot.landed == Landed.ON_GROUND
    bench.run(0.5, 50, thrust=0.6)
    assert bench.height_m > 0.15
    assert int(bench.pilot.landed) == Landed.IN_AIR


@pytest.mark.parametrize("limit_s", [0.1, 0.5, 1.0, 2.0])
def test_loss_timing_follows_the_parameter(limit_s: float) -> None:
    bench = Bench().in_offboard(height_m=1.0)
    bench.pilot.parameters.assign("COM_OF_LOSS_T", limit_s)
    bench.run(0.1, 50)
    bench.run(limit_s - 0.04)
    assert bench.pilot.mode == Px4Mode.OFFBOARD
    assert bench.world.plant.rotor_force_n.sum() == pytest.approx(9.81, rel=0.01)  # the last setpoint still flies
    bench.run(0.16)  # PX4 looks every 100 ms
    assert bench.pilot.mode != Px4Mode.OFFBOARD
    assert bench.pilot.system_status(0) == MavState.CRITICAL


@pytest.mark.parametrize("rate_hz", [50, 10, 2, 1.05])
def test_only_the_age_of_the_stream_counts(rate_hz: float) -> None:
    bench = Bench().in_offboard(height_m=1.0)
    bench.run(3.0, rate_hz)
    assert bench.pilot.mode == Px4Mode.OFFBOARD


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        (OffboardLoss.POSITION, Px4Mode.AUTO_RTL),
        (OffboardLoss.ALTITUDE, Px4Mode.AUTO_RTL),
        (OffboardLoss.STABILIZED, Px4Mode.AUTO_RTL),
        (OffboardLoss.RETURN, Px4Mode.AUTO_RTL),
        (OffboardLoss.LAND, Px4Mode.AUTO_LAND),
        (OffboardLoss.HOLD, Px4Mode.AUTO_LOITER),
        (99, Px4Mode.AUTO_RTL),
    ],
)
def test_loss_actions_that_fly(action: int, mode: Px4Mode) -> None:
    bench = Bench(**COARSE).in_offboard(height_m=2.0)
    bench.pilot.parameters.assign("COM_OBL_RC_ACT", action)
    bench.run(1.1)
    assert (bench.pilot.mode, bench.pilot.intended) == (mode, Px4Mode.OFFBOARD)
    assert bench.pilot.armed
    if action not in (OffboardLoss.POSITION, OffboardLoss.LAND, OffboardLoss.HOLD):
        return  # flown once for each mode
    bench.run(17.0)
    if mode == Px4Mode.AUTO_LOITER:
        assert bench.height_m > 1.5
        assert bench.speed_m_s < 0.05
    else:
        assert bench.height_m < 0.01
        assert not bench.pilot.armed
        assert bench.pilot.mode == Px4Mode.OFFBOARD  # as PX4: the mode that was commanded


def test_loss_action_terminate() -> None:
    bench = Bench().in_offboard(height_m=2.0)
    bench.pilot.parameters.assign("COM_OBL_RC_ACT", 6)
    bench.run(1.3)
    assert bench.pilot.system_status(0) == MavState.TERMINATION
    assert bench.pilot.mode == Px4Mode.OFFBOARD
    assert bench.world.plant.rotor_force_n.max() == 0.0
    assert bench.mode(4, 3) == Result.TEMPORARILY_REJECTED
    bench.run(1.0, 50)
    assert bench.world.plant.rotor_force_n.max() == 0.0  # setpoints bring nothing back


def test_loss_action_disarm() -> None:
    bench = Bench().in_offboard(height_m=2.0)
    bench.pilot.parameters.assign("COM_OBL_RC_ACT", 7)
    bench.run(1.1)
    assert not bench.pilot.armed
    assert bench.pilot.mode == Px4Mode.OFFBOARD
    bench.run(0.2, 50)
    assert not bench.pilot.armed


@pytest.mark.parametrize("action", [0, 4, 5])
def test_a_resumed_stream_takes_over_again(action: int) -> None:
    bench = Bench().in_offboard(height_m=3.0)
    bench.pilot.parameters.assign("COM_OBL_RC_ACT", action)
    bench.run(2.0)
    assert bench.pilot.mode != Px4Mode.OFFBOARD
    bench.run(0.048, 50)
    assert int(bench.pilot.mode) == Px4Mode.OFFBOARD
    assert bench.pilot.system_status(0) == MavState.ACTIVE


def test_a_commanded_mode_cancels_the_return_to_offboard() -> None:
    bench = Bench().in_offboard(height_m=3.0)
    bench.run(1.5)
    assert bench.mode(4, 3) == Result.ACCEPTED
    assert bench.pilot.system_status(0) == MavState.ACTIVE
    bench.run(1.0, 50)
    assert bench.pilot.mode == Px4Mode.AUTO_LOITER


@pytest.mark.parametrize("mask", [0, 1, 2, 3, 4, 5, 6, 7, 15, 23, 32, 39, 128, 132])
def test_masks_that_count_as_a_stream(mask: int) -> None:
    bench = Bench()
    bench.setpoint(mask=mask)
    bench.arm()
    assert bench.mode(6) == Result.ACCEPTED


@pytest.mark.parametrize("mask", [64, 71, 129, 130, 131, 135, 192])
def test_masks_that_are_no_stream(mask: int) -> None:
    bench = Bench()
    bench.setpoint(mask=mask)
    bench.arm()
    assert bench.mode(6) == Result.TEMPORARILY_REJECTED


def test_thrust_body_flag_means_free_fall() -> None:
    bench = Bench().in_offboard(height_m=2.0)
    bench.setpoint(mask=39)
    bench.run(0.02)
    assert bench.world.plant.rotor_force_n.sum() == 0.0


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


@pytest.mark.parametrize(("thrust", "newtons"), [(1.5, 20.0), (-0.5, 0.0)])
def test_thrust_is_clipped_at_the_motors(thrust: float, newtons: float) -> None:
    bench = Bench().in_offboard(height_m=2.0)
    bench.run(0.1, 50, thrust=thrust)
    assert bench.world.plant.rotor_force_n.sum() == pytest.approx(newtons, abs=0.5)


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


def test_landed_states_of_an_auto_flight() -> None:
    bench = Bench(**COARSE)
    bench.command(22, *[NAN] * 7)
    bench.arm()
    seen: list[Landed] = []
    for k in range(180):
        bench.run(0.1)
        if k == 95:
            assert bench.command(21) == Result.ACCEPTED
        if not seen or seen[-1] != bench.pilot.landed:
            seen.append(bench.pilot.landed)
    assert seen == [Landed.ON_GROUND, Landed.TAKEOFF, Landed.IN_AIR, Landed.LANDING, Landed.ON_GROUND]
    assert not bench.pilot.armed
    assert bench.pilot.mode == Px4Mode.AUTO_LOITER


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
