"""Samples of a vehicle's state: the newest one wins by its own clock, and what can't be one is refused."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.types import FlightMode
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock
from tests.benches.autopilot_link import LEVEL, PX4_HOLD, SHARED, Bench, odometry


def test_newest_sample_of_a_drained_link_wins_whatever_the_order_of_arrival() -> None:
    bench = Bench().ready()
    for stamp_us, north in ((1_000_000, 1.0), (1_020_000, 3.0), (1_010_000, 2.0)):
        bench.say(odometry(stamp_us, pos=(north, 0.0, 0.0)))
    assert bench.poll().pos_ned_m[0] == pytest.approx(3.0, abs=0.01)
    bench.say(odometry(1_015_000, pos=(9.0, 0.0, 0.0)))
    assert bench.poll().pos_ned_m[0] == pytest.approx(3.0, abs=0.01)


def test_vehicle_time_is_mapped_by_the_smallest_delay_so_jitter_does_not_make_old_samples_young() -> None:
    clock = VehicleClock()
    delays_us = [9_000, 30_000, 4_000, 12_000, 60_000, 5_000]
    found = [clock.to_local(5_000_000 + 10_000 * i, 10_000 * i + d) for i, d in enumerate(delays_us)]
    local = [t_us for t_us in found if t_us is not None]
    assert len(local) == len(found)
    # sample 4 left at 40 ms and took 60 ms; by the best delay seen (4 ms) it is 56 ms old on arrival
    assert local[4] == 40_000 + 4_000
    assert local[5] == 50_000 + 4_000
    assert all(b > a for a, b in pairwise(local[2:]))


def test_a_slow_drift_of_the_vehicle_clock_is_followed() -> None:
    clock = VehicleClock()
    error_us = 0
    for i in range(1000):  # 10 s at 100 Hz, vehicle clock 1000 ppm slow, delay 5 ms
        true_us = i * 10_000
        local_us = clock.to_local(round(true_us * 0.999), true_us + 5_000)
        assert local_us is not None
        error_us = local_us - true_us
    assert -1_000 < error_us <= 5_000  # two windows of 2 s: at most 4 ms behind


def stamped(bench: Bench, seconds: float, booted_us: int = 0, north_m: float = 0.0) -> Any:
    """The vehicle speaks for a while, state and attitude at 50 Hz, its clock begun at `booted_us`; the last state."""
    state = None
    for _ in range(round(seconds * 50)):
        bench.clock.advance(20_000)
        stamp_us = bench.clock.now_us() - booted_us
        bench.say(odometry(stamp_us, pos=(north_m, 0.0, 0.0)))
        bench.say(dialect.MAVLink_attitude_quaternion_message(stamp_us // 1000, *LEVEL, 0.0, 0.0, 0.0))
        bench.heartbeat()
        state = bench.poll()
    return state


def test_after_a_reboot_of_the_vehicle_its_new_clock_is_taken_and_its_samples_too() -> None:
    bench = Bench().ready()
    stamped(bench, 60.0, north_m=5.0)
    bench.clock.advance(3_000_000)
    booted_us = bench.clock.now_us()
    assert stamped(bench, 0.5, booted_us, 0.5) is None, "its local origin is another one now"
    assert bench.pilot.clock.boots == 1
    bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    state = stamped(bench, 0.02, booted_us, 0.5)
    assert state.pos_ned_m[0] == pytest.approx(0.5, abs=0.01)
    assert abs(state.t_us - bench.clock.now_us()) < 20_000
    stamped(bench, 5.0, booted_us, 0.5)
    assert bench.pilot.clock.boots == 1


@pytest.mark.parametrize("off_us", [-30_000_000, 900_000, 10**12])
def test_one_state_of_another_time_neither_reboots_the_vehicle_nor_freezes_what_is_known_of_it(off_us: int) -> None:
    bench = Bench().ready()
    stamped(bench, 31.0)
    bench.say(odometry(bench.clock.now_us() + off_us, pos=(9.0, 0.0, 0.0)))
    assert bench.poll().pos_ned_m[0] == pytest.approx(0.0, abs=0.01)
    state = stamped(bench, 0.02, north_m=0.1)
    assert state.pos_ned_m[0] == pytest.approx(0.1, abs=0.01)
    assert abs(state.t_us - bench.clock.now_us()) < 1_000
    assert (bench.pilot.clock.boots, bench.own_codec.refused["stamp not believed"]) == (0, 1)


def test_a_link_that_falls_a_second_and_a_half_behind_does_not_make_old_samples_young() -> None:
    clock = VehicleClock()
    for i in range(100):
        clock.to_local(i * 10_000, i * 10_000 + 5_000)
    arrived_us = 1_000_000 + 1_500_000
    local_us = clock.to_local(1_000_000, arrived_us)
    assert local_us is not None
    assert arrived_us - local_us > 1_400_000  # older than any failsafe allows


@pytest.mark.parametrize(("sysid", "compid"), [(2, 1), (1, 2), (255, 190), (1, 191)])
def test_others_on_the_link_are_not_believed(sysid: int, compid: int) -> None:
    bench = Bench().ready()
    bench.say(odometry(pos=(1.0, 0.0, 0.0)))
    bench.poll()
    frames = len(bench.frames)
    other = Codec(sysid, compid)
    bench.say(odometry(2_000_000, pos=(50.0, 0.0, 0.0)), other)
    bench.say(dialect.MAVLink_heartbeat_message(2, 12, 0, PX4_HOLD, 4, 3), other)
    state = bench.poll()
    assert state.pos_ned_m[0] == pytest.approx(1.0, abs=0.01)
    assert state.armed
    assert len(bench.frames) == frames


@pytest.mark.parametrize(("counter", "shown_m"), [(0, 0.1), (1, 0.0)])
def test_a_step_is_bridged_when_the_reset_counter_changes(counter: int, shown_m: float) -> None:
    bench = Bench().ready()
    bench.say(odometry())
    bench.poll()
    bench.clock.advance(20_000)
    message = odometry(1_020_000, pos=(0.1, 0.0, 0.0))
    message.reset_counter = counter
    bench.say(message)
    assert bench.poll().pos_ned_m[0] == pytest.approx(shown_m, abs=0.01)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["pos", "vel", "rate", "q"])
@pytest.mark.parametrize("axis", range(3))
def test_a_state_that_is_not_finite_is_refused_and_counted(field: str, axis: int, bad: float) -> None:
    bench = Bench().ready()
    bench.say(odometry(pos=(1.0, 0.0, 0.0)))
    bench.poll()
    values = list(LEVEL) if field == "q" else [0.0, 0.0, 0.0]
    values[axis] = bad
    message = {
        "pos": lambda: odometry(2_000_000, pos=tuple(values)),
        "vel": lambda: odometry(2_000_000, vel=tuple(values)),
        "rate": lambda: odometry(2_000_000, rate=tuple(values)),
        "q": lambda: odometry(2_000_000, q=tuple(values)),
    }[field]()
    bench.say(message)
    assert bench.poll().pos_ned_m[0] == pytest.approx(1.0, abs=0.01)
    assert bench.own_codec.refused["state not finite"] == 1


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("field", "most"), [("pos", 1e5), ("vel", 500.0), ("rate", 200.0)])
def test_a_state_that_is_no_quadrotors_is_refused(field: str, most: float, axis: int) -> None:
    bench = Bench().ready()
    for stamp_us, value in ((1_000_000, 0.0), (2_000_000, -1.001 * most), (3_000_000, 1e30)):
        values = [0.0, 0.0, 0.0]
        values[axis] = value
        bench.say(odometry(stamp_us, **{field: tuple(values)}))  # type: ignore[arg-type]
    state = bench.poll()
    assert max(map(abs, (*state.pos_ned_m, *state.vel_ned_m_s, *state.rate_frd_rad_s))) < 0.1
    assert bench.own_codec.refused["state not plausible"] == 2


def test_parameters_of_made_up_names_fill_no_memory() -> None:
    bench = Bench().ready()
    for number in range(5100):
        bench.say(dialect.MAVLink_param_value_message(f"P{number}".encode(), 1.0, 9, 1, 0))
    bench.say(dialect.MAVLink_param_value_message(b"P7", 2.0, 9, 1, 0))
    bench.poll()
    assert len(bench.pilot.params) == 5000
    assert bench.pilot.params["P7"] == 2.0, "a known one still changes"
    assert bench.own_codec.refused["too many parameters"] == 100


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0)])
def test_an_attitude_far_from_unit_length_is_refused(q: tuple[float, ...]) -> None:
    bench = Bench().ready()
    bench.say(odometry(q=q))
    assert bench.poll() is None


def test_an_attitude_nearly_of_unit_length_is_normalised() -> None:
    bench = Bench().ready()
    bench.say(odometry(q=(1.05, 0.0, 0.0, 0.0)))
    np.testing.assert_allclose(bench.poll().q_nb, LEVEL, atol=1e-7)


def test_velocity_that_came_in_body_axes_is_not_taken_for_ned() -> None:
    # MAVLink: ODOMETRY velocities are in child_frame_id; heading east, 2 m/s ahead is 2 m/s east
    bench = Bench().ready()
    half = math.sqrt(0.5)
    bench.say(odometry(vel=(2.0, 0.0, 0.0), q=(half, 0.0, 0.0, half), child=12))  # MAV_FRAME_BODY_FRD
    state = bench.poll()
    if state is not None:  # refusing it is as good as turning it
        np.testing.assert_allclose(state.vel_ned_m_s, [0.0, 2.0, 0.0], atol=1e-6)


def test_position_without_odometry_uses_the_newest_attitude_and_odometry_wins() -> None:
    bench = Bench().ready()
    bench.clock.advance(1_000_000)
    bench.heartbeat(base=0)  # after a silence the mode has to be told again; disarmed, positions may jump
    local = dialect.MAVLink_local_position_ned_message(1000, 4.0, 5.0, -6.0, 0.5, -0.5, 0.25)
    bench.say(local)
    assert bench.poll() is None  # no attitude yet
    bench.say(dialect.MAVLink_attitude_quaternion_message(1000, 0.6, 0.0, 0.8, 0.0, 0.1, 0.2, 0.3))
    bench.say(local)
    state = bench.poll()
    np.testing.assert_allclose(state.pos_ned_m, [4.0, 5.0, -6.0], atol=0.01)
    np.testing.assert_allclose(state.vel_ned_m_s, [0.5, -0.5, 0.25])
    np.testing.assert_allclose(state.q_nb, [0.6, 0.0, 0.8, 0.0], atol=1e-6)
    bench.say(odometry(1_000_000, pos=(7.0, 0.0, 0.0)))
    bench.say(dialect.MAVLink_local_position_ned_message(1010, 9.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert bench.poll().pos_ned_m[0] == pytest.approx(7.0, abs=0.01)


def attitude_at(stamp_us: int, q_nb: tuple[float, ...] = LEVEL) -> Any:
    return dialect.MAVLink_attitude_quaternion_message(stamp_us // 1000, *q_nb, 0.0, 0.0, 0.0)


def position_at(stamp_us: int, north_m: float = 0.0) -> Any:
    return dialect.MAVLink_local_position_ned_message(stamp_us // 1000, north_m, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_state_whose_attitudes_have_stopped_grows_old_though_positions_come_and_is_new_when_they_return() -> None:
    bench = Bench().ready()
    ages_s: list[float] = []
    for k in range(100):  # at 50 Hz
        bench.clock.advance(20_000)
        now_us = bench.clock.now_us()
        if not 30 <= k < 80:
            bench.say(attitude_at(now_us))
        bench.say(position_at(now_us))
        bench.heartbeat(custom_mode=4, autopilot=3)
        state = bench.poll()
        ages_s.append((now_us - state.t_us) * 1e-6)
    assert max(ages_s[:30]) < 0.001
    assert ages_s[79] == pytest.approx(1.0 - 0.1, abs=0.021), "from when the attitude was a tenth of a second old"
    assert max(ages_s[80:]) < 0.001
    assert bench.own_codec.refused["attitude of another time"] == 45


@pytest.mark.parametrize(("apart_ms", "is_taken"), [(0, True), (-60, True), (100, True), (101, False), (-101, False)])
def test_a_position_is_taken_with_an_attitude_of_its_time(apart_ms: int, is_taken: bool) -> None:
    bench = Bench().ready()
    bench.say(attitude_at(1_000_000))
    bench.say(position_at(1_000_000 + 1000 * apart_ms))
    assert (bench.poll() is not None) == is_taken


TURN_US = 2**32 * 1000  # 49.7 days, after which milliseconds of 32 bits begin again


def told_since_boot(bench: Bench, seconds: float, booted_us: int) -> Any:
    """An ArduPilot tells its state for a while, its clock begun at `booted_us`; the last state."""
    state = None
    for _ in range(round(seconds * 50)):
        bench.clock.advance(20_000)
        stamp_us = (bench.clock.now_us() - booted_us) % TURN_US
        bench.say(attitude_at(stamp_us))
        bench.say(position_at(stamp_us))
        bench.heartbeat(custom_mode=20, autopilot=3)
        state = bench.poll()
    return state


@pytest.mark.parametrize("turns", [1, 2])
def test_a_time_since_boot_that_begins_again_is_no_reboot_and_a_reboot_after_it_still_is_one(turns: int) -> None:
    bench = Bench().ready()
    booted_us = bench.clock.now_us() + 3_000_000 - turns * TURN_US
    for _ in range(300):
        state = told_since_boot(bench, 0.02, booted_us)
        assert abs(state.t_us - bench.clock.now_us()) < 20_000
    assert (bench.pilot.clock.boots, bench.pilot.clock.restarts, bench.own_codec.refused.total()) == (0, 0, 0)
    bench.clock.advance(3_000_000)
    rebooted_us = bench.clock.now_us()
    assert told_since_boot(bench, 0.5, rebooted_us) is None, "its local origin is another one now"
    assert bench.pilot.clock.boots == 1
    bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    assert told_since_boot(bench, 1.0, rebooted_us) is not None
    assert bench.pilot.clock.boots == 1


def test_the_first_position_after_a_reboot_is_not_combined_with_an_attitude_of_before() -> None:
    bench = Bench().ready()
    bench.say(attitude_at(60_000_000, (0.6, 0.0, 0.8, 0.0)))
    bench.say(position_at(60_000_000))
    assert bench.poll() is not None
    taken = bench.pilot.states.count
    for k in range(200):  # for longer than a run of other stamps may last, no attitude is sent
        bench.clock.advance(20_000)
        bench.say(position_at(1_000_000 + 20_000 * k))
        bench.poll()
    assert bench.pilot.states.count == taken
    for k in range(200, 400):
        bench.clock.advance(20_000)
        bench.say(attitude_at(1_000_000 + 20_000 * k))
        bench.say(position_at(1_000_000 + 20_000 * k))
        bench.heartbeat(custom_mode=4, autopilot=3)
        bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
        state = bench.poll()
    assert bench.pilot.clock.boots + bench.pilot.clock.restarts > 0
    np.testing.assert_allclose(state.q_nb, LEVEL, atol=1e-6)


@pytest.mark.parametrize(
    ("autopilot", "custom_mode", "mode"),
    [
        (12, 1 << 16, FlightMode.MANUAL),
        (12, 3 << 16, FlightMode.MANUAL),
        (12, 4 << 16 | 2 << 24, FlightMode.TAKEOFF),
        (12, 4 << 16 | 3 << 24, FlightMode.HOLD),
        (12, 4 << 16 | 4 << 24, FlightMode.MISSION),
        (12, 4 << 16 | 5 << 24, FlightMode.RTL),
        (12, 4 << 16 | 6 << 24, FlightMode.LAND),
        (12, 6 << 16, FlightMode.EXTERNAL),
        (12, 5 << 16, FlightMode.MANUAL),  # ACRO and everything unknown: somebody else flies
        (12, 4 << 16 | 9 << 24, FlightMode.MANUAL),
        (3, 0, FlightMode.MANUAL),  # STABILIZE
        (3, 3, FlightMode.MISSION),  # AUTO
        (3, 4, FlightMode.EXTERNAL),  # GUIDED
        (3, 5, FlightMode.HOLD),  # LOITER
        (3, 17, FlightMode.HOLD),  # BRAKE
        (3, 6, FlightMode.RTL),
        (3, 9, FlightMode.LAND),
        (3, 16, FlightMode.MANUAL),  # POSHOLD
    ],
)
def test_modes_of_both_autopilots(autopilot: int, custom_mode: int, mode: FlightMode) -> None:
    bench = Bench()
    bench.heartbeat(custom_mode, autopilot)
    bench.poll()
    assert bench.pilot.mode is mode
