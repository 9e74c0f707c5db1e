"""Link of one vehicle: which bytes are believed, in which frame and at which time, and which setpoints are sent."""

from __future__ import annotations

import math
import struct
from itertools import pairwise
from typing import Any

import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.clock import SimClock
from swarmctl.core.types import AttitudeSetpoint, FlightMode, GeoOrigin, Landed
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.transport import PipeTransport, pipe_pair
from swarmctl.mavlink.vehicle.autopilot import Autopilot
from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock

SHARED = GeoOrigin(47.397742, 8.545594, 489.4)
LEVEL = (1.0, 0.0, 0.0, 0.0)
PX4_OFFBOARD, PX4_HOLD, PX4_LAND = 6 << 16, 4 << 16 | 3 << 24, 4 << 16 | 6 << 24


class Bench:
    """An `Autopilot` and the vehicle's end of its link."""

    def __init__(self, sysid: int = 1) -> None:
        self.clock = SimClock()
        ours, self.vehicle = pipe_pair(self.clock.now_us)
        self.own_codec = Codec(sysid, 191)
        self.frames: list[bytes] = []
        self.pilot = Autopilot(ours, self.own_codec, sysid, SHARED, on_frame=self.frames.append)
        self.codec = Codec(sysid, 1)

    def say(self, message: Any, codec: Codec | None = None) -> None:
        self.vehicle.send((codec or self.codec).encode(message))

    def heartbeat(self, custom_mode: int = PX4_OFFBOARD, autopilot: int = 12, base: int = 128, status: int = 4) -> None:
        self.say(dialect.MAVLink_heartbeat_message(2, autopilot, base, custom_mode, status, 3))

    def origin(self, lat_deg: float, lon_deg: float, alt_m: float) -> None:
        lat, lon, alt = round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3)
        self.say(dialect.MAVLink_gps_global_origin_message(lat, lon, alt))

    def ready(self) -> Bench:
        self.heartbeat()
        self.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
        return self

    def poll(self) -> Any:
        return self.pilot.poll(self.clock.now_us())


def odometry(
    stamp_us: int = 1_000_000,
    pos: tuple[float, ...] = (0.0, 0.0, 0.0),
    vel: tuple[float, ...] = (0.0, 0.0, 0.0),
    q: tuple[float, ...] = LEVEL,
    rate: tuple[float, ...] = (0.0, 0.0, 0.0),
    child: int = 1,
) -> Any:
    nothing = [math.nan] * 21
    return dialect.MAVLink_odometry_message(stamp_us, 1, child, *pos, list(q), *vel, *rate, nothing, nothing, 0, 2, 90)


def test_no_state_before_mode_origin_and_position_are_all_known() -> None:
    bench = Bench()
    bench.say(odometry())
    assert bench.poll() is None
    bench.heartbeat()
    assert bench.poll() is None
    bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    state = bench.poll()
    np.testing.assert_allclose(state.pos_ned_m, [0.0, 0.0, 0.0], atol=0.01)
    assert (state.armed, state.mode, state.failsafe) == (True, FlightMode.EXTERNAL, False)


def test_two_vehicles_at_one_place_with_different_local_origins_are_at_one_place() -> None:
    # the place: 30 m north, 40 m east, 10 m above the shared origin
    lat, lon, alt = pymap3d.ned2geodetic(30.0, 40.0, -10.0, SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    found = []
    for north, east, down in ((0.0, 0.0, 0.0), (100.0, -50.0, 3.0), (-7.0, 60.0, -20.0)):
        bench = Bench()
        bench.heartbeat()
        origin = pymap3d.ned2geodetic(north, east, down, SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
        bench.origin(*origin)
        local = pymap3d.geodetic2ned(lat, lon, alt, *origin)
        bench.say(odometry(pos=tuple(float(c) for c in local)))
        found.append(bench.poll().pos_ned_m)
    for pos_ned_m in found:  # 1e-7 degrees are 11 mm
        np.testing.assert_allclose(pos_ned_m, [30.0, 40.0, -10.0], atol=0.02)


def test_origin_signs_north_is_x_east_is_y_higher_is_negative_z() -> None:
    bench = Bench()
    bench.heartbeat()
    bench.origin(SHARED.lat_deg + 1e-3, SHARED.lon_deg + 1e-3, SHARED.alt_m + 5.0)
    bench.say(odometry(pos=(1.0, 2.0, 3.0)))
    pos_ned_m = bench.poll().pos_ned_m
    # one degree of meridian is 111.18 km at this latitude, one of parallel 75.5 km
    np.testing.assert_allclose(pos_ned_m, [1.0 + 111.18, 2.0 + 75.5, 3.0 - 5.0], atol=0.2)


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


@pytest.mark.parametrize(
    ("base", "status", "armed", "failsafe"),
    [(128, 4, True, False), (81, 3, False, False), (209, 5, True, True), (128, 6, True, True), (0, 8, False, True)],
)
def test_armed_and_failsafe_of_a_heartbeat(base: int, status: int, armed: bool, failsafe: bool) -> None:
    bench = Bench()
    bench.heartbeat(base=base, status=status)
    bench.poll()
    assert (bench.pilot.armed, bench.pilot.failsafe) == (armed, failsafe)


def test_a_component_that_is_no_autopilot_changes_neither_mode_nor_armed() -> None:
    bench = Bench().ready()
    bench.heartbeat(custom_mode=0, autopilot=8, base=0)
    bench.poll()
    assert (bench.pilot.armed, bench.pilot.mode) == (True, FlightMode.EXTERNAL)


def test_landed_armable_and_hover_thrust() -> None:
    bench = Bench()
    bench.heartbeat(PX4_HOLD)
    target = dialect.MAVLink_attitude_target_message(0, 0, list(LEVEL), 0.0, 0.0, 0.0, 0.625)
    bench.say(target)
    bench.poll()
    assert (bench.pilot.landed, bench.pilot.armable) == (Landed.UNKNOWN, False)
    assert bench.pilot.hover_thrust_01 is None  # not in the air as far as is known
    bench.say(dialect.MAVLink_extended_sys_state_message(0, 2))
    bench.say(dialect.MAVLink_sys_status_message(0, 0, 1 << 28, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    bench.say(target)
    bench.poll()
    assert (bench.pilot.landed, bench.pilot.armable) == (Landed.IN_AIR, True)
    assert bench.pilot.hover_thrust_01 == 0.625
    bench.say(dialect.MAVLink_extended_sys_state_message(0, 77))
    bench.poll()
    assert bench.pilot.landed is Landed.UNKNOWN


@given(st.lists(st.tuples(st.sampled_from(sorted(dialect.mavlink_map)), st.binary(max_size=120)), max_size=8))
@settings(max_examples=150, deadline=None)
def test_hostile_messages_of_the_vehicle_itself_never_raise(messages: list[tuple[int, bytes]]) -> None:
    bench = Bench().ready()
    for number, payload in messages:
        bench.vehicle.send(raw(number, payload))
    state = bench.poll()
    if state is not None:
        assert np.isfinite(np.concatenate([state.pos_ned_m, state.vel_ned_m_s, state.q_nb, state.rate_frd_rad_s])).all()


def raw(number: int, payload: bytes) -> bytes:
    """A frame of the vehicle with a right checksum around any payload."""
    inside = bytes([len(payload), 0, 0, 0, 1, 1]) + number.to_bytes(3, "little") + payload
    crc = 0xFFFF
    for byte in inside + bytes([dialect.mavlink_map[number].crc_extra]):
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return b"\xfd" + inside + struct.pack("<H", crc)


# -- setpoints --------------------------------------------------------------------------------------------------------


def sent(vehicle: PipeTransport) -> list[bytes]:
    return [datagram.data for datagram in vehicle.receive(10**15)]


def setpoint(q: tuple[float, ...] = LEVEL, thrust_01: float = 0.5, valid_until_us: int = 100_000) -> AttitudeSetpoint:
    return AttitudeSetpoint(np.array(q), thrust_01, valid_until_us)


def test_bytes_of_a_setpoint_ignore_body_rates_and_carry_attitude_and_thrust() -> None:
    bench = Bench(sysid=7)
    assert bench.pilot.send(setpoint((0.5, -0.5, 0.5, -0.5), 0.625), 42_000) == ""
    (frame,) = sent(bench.vehicle)
    assert frame[7:10] == (82).to_bytes(3, "little")
    assert frame[5:7] == bytes([7, 191])
    time_ms, *fields = struct.unpack("<I4f3ff3B", frame[10:-2])
    assert time_ms == 42
    assert fields == [0.5, -0.5, 0.5, -0.5, 0.0, 0.0, 0.0, 0.625, 7, 1, 7]  # system, component, type_mask
    assert bench.frames == [frame]


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (setpoint((math.nan, 0.0, 0.0, 0.0)), "not finite"),
        (setpoint((1.0, 0.0, math.inf, 0.0)), "not finite"),
        (setpoint((0.0, 0.0, 0.0, 0.0)), "unit length"),
        (setpoint((1.01, 0.0, 0.0, 0.0)), "unit length"),
        (setpoint((1.0, 0.0, 0.0)), "not finite"),
        (setpoint(thrust_01=math.nan), "thrust"),
        (setpoint(thrust_01=math.inf), "thrust"),
        (setpoint(thrust_01=-0.001), "thrust"),
        (setpoint(thrust_01=1.001), "thrust"),
        (setpoint(valid_until_us=-1), "past its time"),
    ],
)
def test_a_setpoint_that_would_harm_never_leaves(bad: AttitudeSetpoint, why: str) -> None:
    bench = Bench()
    assert why in bench.pilot.send(bad, 0)
    assert sent(bench.vehicle) == []
    assert bench.frames == []
    assert bench.pilot.setpoints.refused == 1


@pytest.mark.parametrize("thrust_01", [0.0, 1.0])
def test_limits_of_thrust_and_time_are_inclusive(thrust_01: float) -> None:
    bench = Bench()
    assert bench.pilot.send(setpoint(thrust_01=thrust_01, valid_until_us=100), 100) == ""
    assert len(sent(bench.vehicle)) == 1


# -- what is in doubt -------------------------------------------------------------------------------------------------


def flying(bench: Bench, seconds: float, mode_hz: float = 25.0) -> Any:
    """The vehicle speaks for a while, polled at 50 Hz; the last state."""
    state = None
    for k in range(round(seconds * 50)):
        bench.clock.advance(20_000)
        bench.say(odometry(bench.clock.now_us()))
        if mode_hz and k % round(50 / mode_hz) == 0:
            bench.heartbeat()
        state = bench.poll()
    return state


def test_after_a_silent_link_there_is_no_state_until_the_mode_is_reported_again() -> None:
    bench = Bench().ready()
    assert flying(bench, 1.0) is not None
    bench.clock.advance(400_000)  # a failsafe may have acted: PX4 retakes OFFBOARD from a single setpoint
    assert flying(bench, 0.2, mode_hz=0.0) is None
    assert bench.pilot.invalid["mode not told since a silence"] == 10
    assert flying(bench, 0.1) is not None
    bench.clock.advance(200_000)
    assert flying(bench, 0.1, mode_hz=0.0) is not None, "shorter than any loss time-out"


def test_a_poll_after_a_sleep_does_not_believe_a_mode_from_a_buffer_that_filled_up() -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    for _ in range(10):  # 0.4 s into the buffer, the rest of a second is dropped
        bench.clock.advance(40_000)
        bench.say(odometry(bench.clock.now_us()))
        bench.heartbeat()
    bench.clock.advance(600_000)
    assert bench.poll() is None
    assert flying(bench, 0.1, mode_hz=0.0) is None
    assert flying(bench, 0.1) is not None


def test_a_poll_after_a_sleep_believes_a_mode_that_is_young() -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    for _ in range(20):
        bench.clock.advance(40_000)
        bench.say(odometry(bench.clock.now_us()))
        bench.heartbeat()
    assert bench.poll() is not None


def requests(bench: Bench) -> int:
    """How often the vehicle has been asked for its HEARTBEAT since the last call."""
    found = [dialect.MAVLink(None).decode(bytearray(data)) for data in sent(bench.vehicle)]
    return sum(m.get_type() == "COMMAND_LONG" and (m.command, m.param1) == (512, 0.0) for m in found)


@pytest.mark.parametrize("slept", [True, False], ids=["we slept", "the link was silent"])
def test_after_a_silence_the_vehicle_is_asked_and_its_answer_is_enough(slept: bool) -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    requests(bench)
    for _ in range(16):  # CURRENT_MODE would come within half a second, HEARTBEAT within one
        bench.clock.advance(20_000)
        if slept:
            bench.say(odometry(bench.clock.now_us()))
        else:
            bench.poll()
    if not slept:
        bench.say(odometry(bench.clock.now_us()))
    assert bench.poll() is None
    assert requests(bench) == 1
    bench.heartbeat()
    assert flying(bench, 0.02, mode_hz=0.0) is not None
    assert requests(bench) == 0


def test_a_vehicle_that_does_not_answer_is_asked_again_but_not_every_tick() -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    requests(bench)
    bench.clock.advance(400_000)
    assert flying(bench, 0.6, mode_hz=0.0) is None
    assert 8 <= requests(bench) <= 10


@pytest.mark.parametrize(("custom_mode", "mode"), [(PX4_LAND, FlightMode.LAND), (1 << 16, FlightMode.MANUAL)])
def test_a_mode_that_came_and_went_between_two_polls_is_shown_once(custom_mode: int, mode: FlightMode) -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    for custom in (custom_mode, PX4_OFFBOARD):
        bench.say(dialect.MAVLink_current_mode_message(0, custom, 0))
    assert bench.poll().mode is mode
    assert bench.poll().mode is mode, "the same tick"
    assert flying(bench, 0.02, mode_hz=0.0).mode is FlightMode.EXTERNAL
    assert bench.pilot.watch.departures == 1


def test_a_failsafe_that_came_and_went_between_two_polls_is_shown_once() -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    bench.heartbeat(status=5)
    bench.heartbeat(status=4)
    assert bench.poll().failsafe
    assert not flying(bench, 0.02, mode_hz=0.0).failsafe


def test_a_setpoint_gap_in_which_the_failsafe_may_have_acted_is_counted() -> None:
    bench = Bench().ready()
    bench.say(dialect.MAVLink_param_value_message(b"COM_OF_LOSS_T", 0.5, 9, 1, 0))

    def stream_after(seconds: float) -> tuple[int, float]:
        bench.clock.advance(round(seconds * 1e6))
        bench.heartbeat()
        bench.poll()
        bench.pilot.send(setpoint(valid_until_us=bench.clock.now_us() + 100_000), bench.clock.now_us())
        return bench.pilot.setpoints.gaps, round(bench.pilot.setpoints.gap_s, 2)

    assert stream_after(5.0) == (0, 0.0)
    assert stream_after(0.45) == (0, 0.0)
    assert stream_after(0.62) == (1, 0.62)
    bench.heartbeat(PX4_LAND)
    bench.poll()
    assert stream_after(10.0) == (1, 0.62), "it had left, and been seen to"


@pytest.mark.parametrize(("counted", "north_m"), [(True, 1.0), (True, 0.1), (False, 1.0)])
def test_an_estimate_that_jumps_does_not_move_the_vehicle_and_peers_are_given_a_margin(
    counted: bool, north_m: float
) -> None:
    """A step of 0.1 m is one only by the estimator's own word."""
    bench = Bench().ready()
    flying(bench, 1.0)
    jumped = odometry(bench.clock.now_us() + 20_000, pos=(north_m, 0.0, 0.0))
    jumped.reset_counter = int(counted)
    bench.clock.advance(20_000)
    bench.say(jumped)
    bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    assert bench.poll().pos_ned_m[0] == pytest.approx(0.0, abs=0.01)
    bench.clock.advance(20_000)
    again = odometry(bench.clock.now_us(), pos=(north_m, 0.0, 0.0))
    again.reset_counter = int(counted)
    bench.say(again)
    bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    assert bench.poll().pos_ned_m[0] == pytest.approx(0.0, abs=0.01)
    assert bench.pilot.frame.jumps == 1
    assert bench.pilot.frame.jump_m == pytest.approx(north_m, abs=0.02)
    assert 0.0 < bench.pilot.frame.margin_m <= north_m


@pytest.mark.parametrize(
    ("autopilot", "message", "sigma_m"),
    [
        (12, dialect.MAVLink_estimator_status_message(0, 0, 0, 0, 0, 0, 0, 0, 0.35, 0.5), 0.35),
        (12, dialect.MAVLink_estimator_status_message(0, 0, 0, 0, 0, 0, 0, 0, 0.0, 0.5), None),
        (12, dialect.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 0, 0, 0, 0, 9, 0, 900), None),
        (3, dialect.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 0, 0, 0, 0, 9, 0, 900), 0.9),
        (3, dialect.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 0, 0, 0, 0, 9, 0, 0), None),
    ],
)
def test_the_accuracy_an_autopilot_claims(autopilot: int, message: Any, sigma_m: float | None) -> None:
    bench = Bench()
    bench.heartbeat(autopilot=autopilot)
    bench.say(message)
    bench.poll()
    assert bench.pilot.pos_accuracy_m == (None if sigma_m is None else pytest.approx(sigma_m))


def test_hover_thrust_is_the_parameters_until_the_vehicle_hovers_by_itself() -> None:
    bench = Bench()
    bench.heartbeat(4, autopilot=3)
    bench.say(dialect.MAVLink_param_value_message(b"MOT_THST_HOVER", 0.39, 9, 1, 0))
    bench.say(dialect.MAVLink_extended_sys_state_message(0, 2))
    bench.poll()
    assert bench.pilot.hover_thrust_01 == pytest.approx(0.39)
    bench.say(odometry(20_000))
    target = dialect.MAVLink_attitude_target_message(0, 0, list(LEVEL), 0.0, 0.0, 0.0, 0.36)
    bench.say(target)  # GUIDED, and nobody has sent a setpoint: its own take-off
    bench.poll()
    assert bench.pilot.hover_thrust_01 == pytest.approx(0.36)
    bench.pilot.send(setpoint(thrust_01=0.8), bench.clock.now_us())
    bench.say(dialect.MAVLink_attitude_target_message(0, 0, list(LEVEL), 0.0, 0.0, 0.0, 0.8))
    bench.poll()
    assert bench.pilot.hover_thrust_01 == pytest.approx(0.36), "an echo of ours says nothing"


def test_only_answers_to_own_timesyncs_count() -> None:
    bench = Bench().ready()
    flying(bench, 0.3)
    asked = [f for d in bench.vehicle.receive(10**15) for f in [d.data] if f[7:10] == (111).to_bytes(3, "little")]
    assert asked
    question = dialect.MAVLink(None).decode(bytearray(asked[-1]))
    assert question.tc1 == 0
    bench.clock.advance(6_000)
    bench.say(dialect.MAVLink_timesync_message(bench.clock.now_us() * 1000, 12345))  # somebody else's answer
    bench.poll()
    assert bench.pilot.clock.answered == 0
    bench.say(dialect.MAVLink_timesync_message(bench.clock.now_us() * 1000, question.ts1))
    bench.poll()
    assert bench.pilot.clock.answered == 1


def test_what_the_autopilot_says_is_kept_in_order_and_of_a_flood_the_newest() -> None:
    bench = Bench().ready()
    assert bench.pilot.next_text() is None
    for k in range(30):
        bench.say(dialect.MAVLink_statustext_message(4, f"fence {k}\x1b".encode()))
    bench.say(dialect.MAVLink_statustext_message(2, b"of another vehicle"), Codec(9, 1))
    bench.poll()
    said = list(iter(bench.pilot.next_text, None))
    assert said == [(4, f"fence {k}\\x1b") for k in range(10, 30)]
