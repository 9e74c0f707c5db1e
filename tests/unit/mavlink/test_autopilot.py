"""Link of one vehicle: which bytes are believed, in which frame and at which time, and which setpoints are sent."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.types import AttitudeSetpoint, FlightMode, Landed
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.transport import PipeTransport
from tests.benches.autopilot_link import LEVEL, PX4_HOLD, PX4_LAND, PX4_OFFBOARD, PX4_TAKEOFF, SHARED, Bench, odometry


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


def test_no_state_of_a_vehicle_that_has_not_told_its_mode() -> None:
    bench = Bench()
    bench.say(odometry())
    bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    assert bench.poll() is None
    bench.heartbeat()
    assert bench.poll() is not None


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


@pytest.mark.parametrize(("lat_e7", "lon_e7"), [(0, 0), (900_000_001, 0), (473977420, 1_800_000_001)])
def test_a_place_that_is_not_known_is_no_origin(lat_e7: int, lon_e7: int) -> None:
    """Zeros would put the vehicle 5000 km away, and 2000 km below the height of its start."""
    bench = Bench()
    bench.heartbeat()
    bench.say(dialect.MAVLink_gps_global_origin_message(lat_e7, lon_e7, 0))
    for _ in range(40):
        bench.clock.advance(100_000)
        now_us = bench.clock.now_us()
        bench.say(odometry(now_us))
        bench.say(dialect.MAVLink_global_position_int_message(now_us // 1000, lat_e7, lon_e7, 0, 0, 0, 0, 0, 0))
        bench.heartbeat()
        assert bench.poll() is None
    bench.origin(SHARED.lat_deg, SHARED.lon_deg, SHARED.alt_m)
    assert bench.poll() is not None


@pytest.mark.parametrize(
    ("base", "status", "armed", "failsafe"),
    [(128, 4, True, False), (81, 3, False, False), (209, 5, True, True), (128, 6, True, True), (0, 8, False, True)],
)
def test_armed_and_failsafe_of_a_heartbeat(base: int, status: int, armed: bool, failsafe: bool) -> None:
    bench = Bench()
    bench.heartbeat(custom_mode=PX4_HOLD, base=base, status=status)
    bench.poll()
    assert (bench.pilot.armed, bench.pilot.failsafe) == (armed, failsafe)


@pytest.mark.parametrize(("status", "failsafe"), [(4, False), (5, False), (6, True), (8, True)])
def test_who_follows_setpoints_while_its_status_is_critical_only_warns(status: int, failsafe: bool) -> None:
    bench = Bench()
    bench.heartbeat(status=status)  # ArduCopter tells 5 for the rest of a flight in which it has said "battery low"
    bench.poll()
    assert bench.pilot.failsafe == failsafe


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


def told(custom: int, mode: FlightMode, ago_s: float) -> Bench:
    """A vehicle that told HOLD in a HEARTBEAT, and so long ago a mode in a CURRENT_MODE."""
    bench = Bench().ready()
    bench.heartbeat(PX4_HOLD)
    flying(bench, 1.0, mode_hz=0.0)
    bench.say(dialect.MAVLink_current_mode_message(0, custom, 0))
    assert flying(bench, ago_s, mode_hz=0.0).mode is mode
    return bench


def changed_to_offboard() -> Bench:
    """A vehicle that has told its change to OFFBOARD, and 60 ms later tells HOLD in a HEARTBEAT."""
    bench = told(PX4_OFFBOARD, FlightMode.EXTERNAL, 0.06)
    bench.heartbeat(PX4_HOLD)
    assert flying(bench, 0.1, mode_hz=0.0) is None, "in doubt: nothing is sent"
    return bench


def test_a_copy_of_the_heartbeat_from_before_a_change_of_mode_is_no_takeover() -> None:
    bench = changed_to_offboard()
    asked = [dialect.MAVLink(None).decode(bytearray(frame)) for frame in bench.frames[-3:]]
    assert any(m.get_type() == "COMMAND_LONG" and m.command == 512 for m in asked)
    bench.heartbeat(PX4_OFFBOARD)
    assert flying(bench, 0.02, mode_hz=0.0).mode is FlightMode.EXTERNAL
    assert bench.pilot.watch.departures == 1, "the one before"


def test_a_pilot_who_takes_over_right_after_a_change_of_mode_is_believed_with_the_second_heartbeat() -> None:
    bench = changed_to_offboard()
    bench.heartbeat(PX4_HOLD)
    assert flying(bench, 0.02, mode_hz=0.0).mode is FlightMode.HOLD
    assert bench.pilot.watch.departures == 2


def test_a_change_that_a_heartbeat_and_a_mode_tell_at_once_is_believed() -> None:
    """The mode before was told 0.1 s ago, so that the first of both contradicts it; a tick stamps them alike."""
    bench = told(PX4_HOLD, FlightMode.HOLD, 0.1)
    bench.heartbeat(PX4_OFFBOARD)
    bench.say(dialect.MAVLink_current_mode_message(0, PX4_OFFBOARD, 0))
    assert bench.poll().mode is FlightMode.EXTERNAL


def test_a_heartbeat_that_contradicts_a_mode_of_the_same_tick_puts_it_in_doubt() -> None:
    bench = told(PX4_HOLD, FlightMode.HOLD, 1.0)
    bench.say(dialect.MAVLink_current_mode_message(0, PX4_OFFBOARD, 0))
    bench.heartbeat(PX4_HOLD)
    assert flying(bench, 0.1, mode_hz=0.0) is None
    bench.heartbeat(PX4_HOLD)
    assert flying(bench, 0.02, mode_hz=0.0).mode is FlightMode.HOLD


def test_a_failsafe_that_came_and_went_between_two_polls_is_shown_once() -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    bench.heartbeat(status=8)
    bench.heartbeat(status=4)
    assert bench.poll().failsafe
    assert not flying(bench, 0.02, mode_hz=0.0).failsafe


def test_a_status_told_in_another_mode_is_no_failsafe_of_who_follows_setpoints_again() -> None:
    bench = Bench().ready()
    flying(bench, 1.0)
    bench.heartbeat(PX4_LAND, status=5)
    assert flying(bench, 0.5, mode_hz=0.0).failsafe
    bench.say(dialect.MAVLink_current_mode_message(0, PX4_OFFBOARD, 0))  # an operator has resumed
    bench.poll()
    state = flying(bench, 0.1, mode_hz=0.0)
    assert (state.mode, state.failsafe) == (FlightMode.EXTERNAL, False)
    bench.say(dialect.MAVLink_current_mode_message(0, PX4_LAND, 0))
    assert flying(bench, 0.1, mode_hz=0.0).failsafe, "by the newest mode, whatever has told it"


def test_a_vehicle_is_told_that_it_is_attended_only_while_somebody_can_fly_it() -> None:
    bench = Bench()

    def is_attended() -> bool:
        bench.poll()
        return bench.pilot.is_attended(bench.clock.now_us())

    assert is_attended(), "before the first state heartbeats say where to send it to"
    bench.ready()
    flying(bench, 1.0)
    assert is_attended()
    bench.clock.advance(250_000)
    assert is_attended(), "a gap is none"
    bench.clock.advance(100_000)
    assert not is_attended(), "nothing is heard"
    bench.heartbeat()
    assert not is_attended(), "it follows setpoints, and nobody can send any"
    bench.heartbeat(PX4_HOLD)
    assert is_attended(), "a pilot may fly it"
    bench.clock.advance(350_000)
    assert not is_attended()
    flying(bench, 0.1)
    assert is_attended()


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


@pytest.mark.parametrize(
    ("base", "flags", "lost"),
    [
        (128, (0x65, 0x65), True),
        (128, (0x65, 0x37F), False),
        (128, (0x65, 0x37F, 0x65), False),  # it drops out for a moment
        (128, (0x6D, 0x6D), False),  # a position by optical flow is relative only
        (0, (0x65, 0x65), False),  # on the ground an estimator may take its time
    ],
)
def test_an_estimate_that_has_lost_its_position_is_not_taken(base: int, flags: tuple[int, ...], lost: bool) -> None:
    bench = Bench().ready()
    bench.heartbeat(base=base)
    bench.say(odometry(stamp_us=1_000_000))
    for each in flags:
        bench.say(dialect.MAVLink_estimator_status_message(0, each, 0, 0, 0, 0, 0, 0, 2.9, 0.5))
    bench.say(odometry(stamp_us=1_020_000, pos=(3.0, 0.0, 0.0)))
    assert bench.poll().pos_ned_m[0] == pytest.approx(0.0 if lost else 3.0, abs=0.01)
    assert bench.pilot.states.is_lost == lost
    bench.say(dialect.MAVLink_estimator_status_message(0, 0x37F, 0, 0, 0, 0, 0, 0, 0.3, 0.5))
    bench.say(odometry(stamp_us=1_040_000, pos=(4.0, 0.0, 0.0)))
    bench.poll()
    assert bench.pilot.states.newest is not None
    assert bench.pilot.states.newest.vehicle_us == 1_040_000


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


def test_hover_thrust_is_learned_where_a_climb_ends() -> None:
    bench = Bench()
    bench.heartbeat(PX4_TAKEOFF)
    bench.say(dialect.MAVLink_param_value_message(b"MPC_THR_HOVER", 0.5, 9, 1, 0))

    def target(landed: int, down_m_s: float, thrust_01: float) -> float | None:
        bench.say(dialect.MAVLink_extended_sys_state_message(0, landed))
        bench.clock.advance(20_000)
        bench.say(odometry(bench.clock.now_us(), vel=(0.0, 0.0, down_m_s)))
        bench.poll()
        bench.say(dialect.MAVLink_attitude_target_message(0, 0, list(LEVEL), 0.0, 0.0, 0.0, thrust_01))
        bench.poll()
        return bench.pilot.own_hover_01

    on_ground, taking_off = 1, 3
    assert target(on_ground, 0.0, 0.1) is None
    assert target(taking_off, -0.1, 0.2) is None, "its rotors spin up"
    assert target(taking_off, -0.8, 0.7) is None, "it climbs"
    assert target(taking_off, -0.1, 0.61) == pytest.approx(0.61)
    assert target(on_ground, 0.0, 0.1) is None
    assert target(taking_off, 0.0, 0.2) is None, "the next take-off"


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


@pytest.mark.parametrize("told_mm", [500, 0], ids=["as before", "none"])
def test_without_a_fix_the_accuracy_gets_worse_from_the_last_one_that_was_told(told_mm: int) -> None:
    bench = Bench().ready()
    bench.heartbeat(4, autopilot=3)  # an ArduCopter
    for k in range(40):
        has_fix = k < 20
        accuracy_mm = 500 if has_fix else told_mm
        bench.say(dialect.MAVLink_gps_raw_int_message(0, 3 if has_fix else 1, 0, 0, 0, 0, 0, 0, 0, 10, 0, accuracy_mm))
        bench.clock.advance(100_000)
        bench.poll()
    assert bench.pilot.pos_accuracy_m == pytest.approx(0.5 + 0.05 * 2.0**2, abs=0.03)
