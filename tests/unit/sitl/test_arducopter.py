"""Flight of the simulated ArduCopter: measured steps, thrust and climb-rate semantics, masks, timeouts, modes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from swarmctl.core.types import Landed
from tests.benches.arducopter_bench import (
    ACCEPTED,
    ALT_HOLD,
    BRAKE,
    FAILED,
    GUIDED,
    LAND,
    LOITER,
    RTL,
    STABILIZE,
    THRUST,
    Bench,
    of,
)

HOVER = 0.3645
COARSE: dict[str, Any] = {"physics_hz": 100}  # where only the autopilot's rate matters
NAN = math.nan


# --- response ---


@pytest.fixture(scope="module")
def roll_step() -> np.ndarray[Any, np.dtype[np.float64]]:
    """Roll [deg], one sample a physics step, from the first setpoint of a 50 Hz stream of 10 deg on."""
    bench = Bench(parameters=THRUST).airborne(20.0)
    bench.run(1.0, {"thrust": HOVER})
    samples = []
    for k in range(500):
        if k % 5 == 0:
            bench.setpoint(roll_deg=10.0, thrust=HOVER)
        bench.run(0.004)
        samples.append(bench.roll_deg)
    return np.array(samples)


@pytest.mark.parametrize(
    ("fraction", "low_s", "high_s"), [(0.1, 0.08, 0.10), (0.5, 0.18, 0.20), (0.63, 0.22, 0.24), (0.9, 0.38, 0.40)]
)
def test_roll_step(roll_step: Any, fraction: float, low_s: float, high_s: float) -> None:
    reached_s = (np.argmax(roll_step >= 10.0 * fraction) + 1) * 0.004
    assert low_s <= reached_s <= high_s


def test_roll_step_settles_without_overshoot(roll_step: Any) -> None:
    assert roll_step.max() <= 10.05
    assert roll_step[-50:] == pytest.approx(10.0, abs=0.05)


@pytest.mark.parametrize(("thrust", "down_m_s2"), [(0.318, 0.99), (0.418, -1.23), (0.468, -2.24), (0.366, 0.0)])
def test_thrust_steps_with_the_thrust_option(thrust: float, down_m_s2: float) -> None:
    """Mean NED z acceleration 0.25-0.7 s after a step from hover."""
    bench = Bench(parameters=THRUST).airborne(10.0)
    bench.run(1.0, {"thrust": HOVER})
    bench.run(0.25, {"thrust": thrust})
    before = bench.climb_m_s
    bench.run(0.45, {"thrust": thrust})
    assert (before - bench.climb_m_s) / 0.45 == pytest.approx(down_m_s2, abs=0.08)


@pytest.mark.parametrize(
    ("thrust", "climb_m_s"), [(0.5, 0.0), (0.3, -0.59), (0.7, 0.99), (1.0, 2.37), (NAN, 0.0), (7.0, 2.37)]
)
def test_thrust_is_climb_rate_by_default(thrust: float, climb_m_s: float) -> None:
    bench = Bench(**COARSE).airborne(6.0)
    bench.run(3.5, {"thrust": thrust})
    assert bench.climb_m_s == pytest.approx(climb_m_s, abs=0.17)


@pytest.mark.parametrize("parameter", ["WPNAV_SPEED_UP", "WPNAV_SPEED_DN"])
def test_climb_rate_scales_with_its_parameter(parameter: str) -> None:
    bench = Bench(parameters={parameter: 80.0}, **COARSE).airborne(6.0)
    bench.run(3.0, {"thrust": 1.0 if parameter.endswith("UP") else 0.0})
    assert abs(bench.climb_m_s) == pytest.approx(0.8, abs=0.05)


def test_negative_control_the_same_number_means_another_thing_with_the_option() -> None:
    falls, holds = Bench(parameters=THRUST, **COARSE).airborne(20.0), Bench(**COARSE).airborne(20.0)
    for bench in (falls, holds):
        bench.run(1.5, {"thrust": 0.5})
    assert holds.height_m == pytest.approx(20.0, abs=0.1)
    assert falls.height_m > 22.0, "0.5 of full thrust is 1.37 g"


def test_nan_thrust_is_no_thrust_with_the_option() -> None:
    bench = Bench(parameters=THRUST, **COARSE).airborne(20.0)
    bench.run(0.5, {"thrust": NAN})
    assert bench.climb_m_s < -3.0


@pytest.mark.parametrize(("boost", "climbs"), [(1, True), (0, False)])
def test_thrust_is_boosted_by_the_tilt_unless_switched_off(boost: int, climbs: bool) -> None:
    """ATC_ANGLE_BOOST: at 25 deg a level hover thrust is raised by 10 %."""
    bench = Bench(parameters={**THRUST, "ATC_ANGLE_BOOST": boost}, **COARSE).airborne(20.0)
    bench.run(1.5, {"thrust": HOVER, "roll_deg": 25.0})
    assert (bench.climb_m_s > -0.35) == climbs
    assert (bench.climb_m_s < -0.8) != climbs


# --- what counts as a setpoint ---

MASKS = (  # type_mask, what becomes of a vehicle that stands at 10 deg roll when 20 deg is sent with it
    (7, "flown"),
    (0, "flown"),
    (39, "flown"),
    (1, "stops"),
    (2, "stops"),
    (3, "stops"),
    (4, "stops"),
    (5, "stops"),
    (6, "stops"),
    (64, "ignored"),
    (71, "ignored"),
    (135, "ignored"),
    (192, "ignored"),
    (128, "held"),  # rates alone, and zero: stays as it is; level when it was
)


@pytest.mark.parametrize(("mask", "fate"), MASKS)
def test_type_masks(mask: int, fate: str) -> None:
    bench = Bench(**COARSE).airborne(6.0)
    bench.run(0.8, {"roll_deg": 10.0})
    bench.run(0.6, {"roll_deg": 20.0, "mask": mask})
    if fate == "stops":
        assert bench.roll_deg < -8.0, "it leans back"
    else:
        assert bench.roll_deg == pytest.approx(20.0 if fate == "flown" else 10.0, abs=1.5)
    assert bool(bench.pilot.refused) == (fate in ("ignored", "stops"))


@pytest.mark.parametrize(
    ("norm", "flown"), [(1.0, True), (1.0004, True), (1.002, False), (2.0, False), (0.0, False), (NAN, False)]
)
def test_quaternions_have_unit_norm_or_are_dropped(norm: float, flown: bool) -> None:
    bench = Bench(**COARSE).airborne(6.0)
    q = [norm * math.cos(math.radians(5)), norm * math.sin(math.radians(5)), 0.0, 0.0]
    bench.run(0.8, {"q": q})
    assert bench.roll_deg == pytest.approx(10.0 if flown else 0.0, abs=0.5)
    assert bool(bench.pilot.refused["not_unit_quaternion"]) != flown


def test_body_rates_turn_the_attitude() -> None:
    bench = Bench(**COARSE).airborne(6.0)
    bench.run(0.5, {"mask": 128, "rates": (0.2, 0.0, 0.0)})
    assert bench.roll_deg == pytest.approx(math.degrees(0.2 * 0.5), abs=2.5)


def test_rates_that_are_not_finite_are_refused() -> None:
    bench = Bench(**COARSE).airborne(6.0)
    bench.run(0.5, {"mask": 0, "rates": (NAN, 0.0, 0.0), "roll_deg": 10.0})
    assert bench.tilt_deg < 1.0 and bench.pilot.refused["not_finite"]


@pytest.mark.parametrize(("target", "flown"), [((1, 1), True), ((1, 250), True), ((0, 0), True), ((2, 1), False)])
def test_setpoints_are_addressed_by_system(target: tuple[int, int], flown: bool) -> None:
    bench = Bench(**COARSE).airborne(6.0)
    bench.run(0.8, {"roll_deg": 10.0, "target": target})
    assert bench.roll_deg == pytest.approx(10.0 if flown else 0.0, abs=0.6)


@pytest.mark.parametrize("mode", [LOITER, ALT_HOLD, STABILIZE, BRAKE])
def test_setpoints_in_other_modes_are_ignored(mode: int) -> None:
    bench = Bench(**COARSE).airborne(6.0)
    bench.mode(mode)
    bench.run(1.0, {"roll_deg": 20.0, "thrust": 1.0})
    assert bench.tilt_deg < 1.0 and abs(bench.height_m - 6.0) < 0.3
    assert bench.pilot.refused["not_guided"] == 50


# --- the stream stops ---


@pytest.mark.parametrize(("options", "thrust"), [(0.0, 0.5), (8.0, HOVER)])
@pytest.mark.parametrize("timeout_s", [3.0, 1.0])
def test_it_levels_after_the_timeout_stays_guided_and_drifts_on(
    timeout_s: float, options: float, thrust: float
) -> None:
    bench = Bench(parameters={"GUID_OPTIONS": options, "GUID_TIMEOUT": timeout_s}, **COARSE).airborne(20.0)
    texts = bench.texts()
    bench.run(1.5, {"roll_deg": 10.0, "thrust": thrust})
    bench.run(timeout_s - 0.05)
    assert bench.roll_deg == pytest.approx(10.0, abs=0.3), "flies the last setpoint till then"
    bench.run(0.55)
    assert bench.tilt_deg < 2.0
    bench.run(1.5)
    speed_m_s, height_m = float(np.linalg.norm(bench.truth("vel_ned_m_s")[:2])), bench.height_m
    assert bench.tilt_deg < 0.3 and speed_m_s > 1.6
    bench.run(2.0)
    assert abs(bench.height_m - height_m) < 0.15, "climb rate 0, whatever thrust meant"
    assert float(np.linalg.norm(bench.truth("vel_ned_m_s")[:2])) > 0.8 * speed_m_s
    assert bench.pilot.mode == GUIDED and bench.texts() == texts
    bench.run(0.5, {"roll_deg": -10.0, "thrust": thrust})
    assert bench.roll_deg < -8.5, "resumed setpoints are flown at once"


def test_negative_control_a_longer_timeout_keeps_the_tilt() -> None:
    bench = Bench(parameters={"GUID_TIMEOUT": 30.0}, **COARSE).airborne(20.0)
    bench.run(0.5, {"roll_deg": 10.0})
    bench.run(5.0)
    assert bench.roll_deg == pytest.approx(10.0, abs=0.3)


# --- arming, taking off, landing ---


def test_it_disarms_itself_on_the_ground() -> None:
    bench = Bench(**COARSE).booted()
    bench.mode(GUIDED)
    bench.arm()
    bench.run(9.7)
    assert bench.pilot.armed
    bench.run(0.5)
    assert not bench.pilot.armed and bench.texts()[-1] == "Disarming motors"


def test_the_disarm_delay_can_be_switched_off() -> None:
    bench = Bench(parameters={"DISARM_DELAY": 0}, **COARSE).booted()
    bench.arm()
    bench.run(15.0)
    assert bench.pilot.armed


def test_take_off_to_a_height_above_home() -> None:
    bench = Bench(**COARSE).booted()
    bench.mode(GUIDED)
    bench.arm()
    for _ in range(6):
        assert bench.command(22, 0, 0, 0, 0, 0, 0, 4.0) == ACCEPTED, "asked again, it goes on"
        bench.run(0.5)
        assert bench.height_m < 0.05 and bench.landed() == Landed.ON_GROUND, "motors spin up for 3 s"
    bench.run(0.5)
    assert bench.landed() == Landed.TAKEOFF
    assert bench.command(22, 0, 0, 0, 0, 0, 0, 4.0) == FAILED
    bench.run(0.5)
    assert bench.height_m > 0.1
    bench.run(6.0)
    assert bench.height_m == pytest.approx(4.0, abs=0.1)
    assert bench.landed() == Landed.IN_AIR and bench.pilot.mode == GUIDED


@pytest.mark.parametrize(
    ("options", "thrust", "leaves"), [(0, 0.7, True), (0, 0.5, False), (8, 0.45, True), (8, 0.0, False)]
)
def test_attitude_setpoints_alone_take_off_when_they_rise(options: float, thrust: float, leaves: bool) -> None:
    bench = Bench(parameters={"GUID_OPTIONS": options}, **COARSE).booted()
    bench.mode(GUIDED)
    bench.arm()
    bench.run(5.0, {"thrust": thrust})
    assert (bench.height_m > 1.0) == leaves
    assert (bench.landed() == Landed.IN_AIR) == leaves


@pytest.mark.parametrize("from_mode", [GUIDED, LOITER])
def test_land_ends_disarmed_in_land(from_mode: int) -> None:
    bench = Bench(**COARSE).airborne(3.0)
    bench.mode(from_mode)
    assert bench.mode(LAND) == ACCEPTED
    bench.run(2.0)
    assert bench.climb_m_s == pytest.approx(-0.5, abs=0.05) and bench.landed() == Landed.LANDING
    bench.run(10.0)
    assert not bench.pilot.armed and bench.height_m == pytest.approx(0.0, abs=1e-6)
    assert bench.pilot.mode == LAND and bench.arm() == FAILED
    assert np.linalg.norm(bench.truth("pos_ned_m")[:2] - (1.0, 2.0)) < 0.1


def test_landing_under_setpoints_waits_for_the_disarm_delay() -> None:
    bench = Bench(**COARSE).airborne(1.0)
    bench.run(5.0, {"thrust": 0.3})
    assert bench.landed() == Landed.ON_GROUND and bench.pilot.armed
    bench.run(10.0, {"thrust": 0.3})
    assert not bench.pilot.armed


# --- other modes ---


@pytest.mark.parametrize("mode", [LOITER, BRAKE])
def test_loiter_and_brake_come_to_rest(mode: int) -> None:
    bench = Bench(**COARSE).airborne(10.0)
    bench.run(2.0, {"roll_deg": 10.0})
    bench.mode(mode)
    bench.run(5.0)
    where = bench.truth("pos_ned_m").copy()
    bench.run(2.0)
    assert np.linalg.norm(bench.truth("pos_ned_m") - where) < 0.1


def test_stabilize_and_alt_hold_level_and_drift() -> None:
    for mode in (STABILIZE, ALT_HOLD):
        bench = Bench(**COARSE).airborne(10.0)
        bench.run(2.0, {"roll_deg": 10.0})
        bench.mode(mode)
        bench.run(3.0)
        assert bench.tilt_deg < 0.3 and abs(bench.height_m - 10.0) < 1.0
        assert np.linalg.norm(bench.truth("vel_ned_m_s")[:2]) > 2.0


def test_guided_again_stops_and_waits_for_setpoints() -> None:
    bench = Bench(**COARSE).airborne(10.0)
    bench.run(2.0, {"roll_deg": 10.0})
    bench.mode(STABILIZE)
    bench.mode(GUIDED)
    bench.run(5.0)
    assert np.linalg.norm(bench.truth("vel_ned_m_s")) < 0.1


def test_rtl_climbs_comes_home_waits_lands_and_disarms() -> None:
    bench = Bench(parameters={"RTL_ALT": 800}, **COARSE).airborne(3.0)
    bench.run(3.0, {"roll_deg": 15.0})
    assert bench.mode(RTL) == ACCEPTED
    highest_m = 0.0
    while bench.pilot.armed:
        bench.run(0.5)
        highest_m = max(highest_m, bench.height_m)
        assert bench.t_s < 120
    assert 7.5 < highest_m < 8.8
    assert np.linalg.norm(bench.truth("pos_ned_m")[:2] - (1.0, 2.0)) < 0.3
    assert bench.pilot.mode == RTL and bench.height_m == pytest.approx(0.0, abs=1e-6)


def test_modes_that_need_a_position_are_refused_armed_without_one() -> None:
    bench = Bench(ekf_ready_s=23.7, **COARSE)
    bench.run(5.0)
    assert bench.mode(GUIDED) == ACCEPTED and bench.mode(STABILIZE) == ACCEPTED, "disarmed: anything"
    assert bench.command(400, 1, 2989) == ACCEPTED
    assert bench.mode(GUIDED) == FAILED
    assert bench.texts()[-1] == "Mode change to GUIDED failed: requires position"


@pytest.mark.parametrize(
    ("sysid", "action", "becomes"), [(255, 0, GUIDED), (255, 1, RTL), (255, 5, LAND), (1, 5, GUIDED)]
)
def test_gcs_failsafe_counts_one_ground_station_only(sysid: int, action: int, becomes: int) -> None:
    bench = Bench(parameters={"FS_GCS_ENABLE": action}, **COARSE).airborne(3.0)
    beat = mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    bench.link.send(beat.pack(mav.MAVLink(None, srcSystem=sysid, srcComponent=190)))
    bench.run(4.8)
    assert bench.pilot.mode == GUIDED
    bench.run(0.5)
    assert bench.pilot.mode == becomes
    assert ("GCS Failsafe" in bench.texts()) == (becomes != GUIDED)
    assert of("HEARTBEAT", bench.run(1.1))[-1].system_status == (4 if becomes == GUIDED else 5)


def test_mass_and_airframe_are_the_plants() -> None:
    bench = Bench(preset="x500", parameters=THRUST, **COARSE).airborne(5.0)
    bench.run(2.0, {"thrust": 0.4905})
    assert abs(bench.climb_m_s) < 0.05
