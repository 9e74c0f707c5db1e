"""Frames packed from tuples against pymavlink, messages its dialect lacks against their definitions; what they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from fastcrc import crc16
from pymavlink.dialects.v20 import ardupilotmega
from pymavlink.dialects.v20 import development as mav

from sitl.arducopter import streams as arducopter_streams
from sitl.net.wire import KINDS, LACKING, FrameWriter
from sitl.px4.link.schedule import OFFBOARD_HZ
from sitl.px4.link.streams_health import STREAMS
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from tests.benches.px4_bench import Bench, taken_off


@pytest.mark.parametrize("number", sorted(mav.mavlink_map))
def test_frames_are_those_of_pymavlink(number: int) -> None:
    kind = KINDS[number]
    rng = np.random.default_rng(number)
    payload = rng.integers(1, 64, kind.layout.size, dtype=np.uint8).tobytes()  # finite as floats, ASCII as text
    ours = FrameWriter(3, 1).frame(kind, kind.layout.unpack(payload))
    message = Codec(1, 1).decode(ours)
    assert message is not None
    assert Codec(3, 1).encode(message) == ours


@pytest.mark.parametrize("number", sorted(arducopter_streams.STREAMS))
def test_arducopters_messages_are_those_of_its_own_dialect(number: int) -> None:
    """One more field, an extension, is left out of EKF_STATUS_REPORT: it is zero, and so not sent."""
    kind, theirs = KINDS[number], ardupilotmega.mavlink_map[number]
    assert kind.seed == bytes([theirs.crc_extra])
    assert number == int.from_bytes(kind.number_bytes, "little")
    fields = kind.layout.unpack(bytes(kind.layout.size))
    assert fields == theirs.unpacker.unpack(bytes(theirs.unpacker.size))[: len(fields)]
    assert theirs.unpacker.size - kind.layout.size == (4 if theirs.msgname == "EKF_STATUS_REPORT" else 0)


@pytest.mark.parametrize("number", sorted(LACKING))
def test_seeds_follow_from_the_definitions(number: int) -> None:
    """CRC over the name, then type and name of each field in wire order, arrays with their length."""
    name, layout, seed, fields = LACKING[number]
    crc = crc16.mcrf4xx(f"{name} ".encode())
    size = 0
    for field in fields:
        kind, label, *length = field.split()
        crc = crc16.mcrf4xx(f"{kind} {label} ".encode(), crc)
        if length:
            crc = crc16.mcrf4xx(bytes([int(length[0])]), crc)
        size += int(length[0] if length else 1) * {"float": 4}.get(
            kind, int("".join(filter(str.isdigit, kind)) or 32) // 8
        )
    assert (crc & 0xFF) ^ (crc >> 8) == seed
    assert KINDS[number].layout.size == size, layout


def test_the_same_method_gives_the_seed_of_a_known_message() -> None:
    """Negative control for the seeds above."""
    crc = crc16.mcrf4xx(b"PING ")
    for field in ("uint64_t time_usec ", "uint32_t seq ", "uint8_t target_system ", "uint8_t target_component "):
        crc = crc16.mcrf4xx(field.encode(), crc)
    assert (crc & 0xFF) ^ (crc >> 8) == mav.MAVLink_ping_message.crc_extra


def test_frames_of_both_versions_are_found_in_junk() -> None:
    second = Codec(1, 1).encode(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    first = mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav.MAVLink(None, 1, 1), force_mavlink1=True)
    assert first[0] == 0xFE
    assert list(frames(b"\x00\x11" + second + b"\x55" + first + second[:5], version_1=True)) == [second, first]


def test_a_first_version_frame_is_obeyed() -> None:
    bench = Bench()
    arm = mav.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    bench.link.send(arm.pack(mav.MAVLink(None, 1, 191), force_mavlink1=True))
    bench.run(0.01)
    assert bench.pilot.armed


def test_every_default_message_goes_out_and_holds_sense() -> None:
    bench = Bench("x500", every_stream=True, wait_s=3.2)
    assert set(bench.received) >= set(OFFBOARD_HZ)
    for message in LACKING:
        for frame in bench.received[message]:
            body = frame[:-2]
            seed = KINDS[message].seed
            assert crc16.mcrf4xx(body[1:] + seed).to_bytes(2, "little") == frame[-2:]
    (imu, *_) = bench.said(mav.MAVLINK_MSG_ID_HIGHRES_IMU)
    assert (imu.xacc, imu.yacc, imu.zacc) == pytest.approx((0.0, 0.0, -9.81), abs=0.01)
    assert imu.abs_pressure == pytest.approx(955.9, abs=0.5)  # standard atmosphere at 489 m
    (pressure, *_) = bench.said(mav.MAVLINK_MSG_ID_SCALED_PRESSURE)
    assert pressure.press_abs == pytest.approx(imu.abs_pressure, abs=0.01)
    (target, *_) = bench.said(mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED)
    assert math.isnan(target.x)


def test_what_sensors_feel_in_flight() -> None:
    """Specific force is thrust in a hover and nothing in free fall; the lidar sees the ground."""
    bench = taken_off("x500")
    for message in (105, 132, 291, 85):
        bench.endpoint.request(message, 0.0)
    bench.run(0.02)
    (imu,) = bench.said(105)
    assert imu.zacc == pytest.approx(-9.81, abs=0.1)
    assert bench.said(132)[-1].current_distance == pytest.approx(250, abs=12)
    assert bench.said(85)[-1].z == pytest.approx(0.0 - 2.5, abs=0.05)
    assert bench.command(400, 0, 21196) == 0
    bench.run(0.4)
    bench.forget()
    bench.endpoint.request(105, 0.0)
    bench.run(0.01)
    (imu,) = bench.said(105)
    assert abs(imu.zacc) < 3.5  # only drag and what is left of the rotors


def test_a_number_no_field_holds_is_dropped_and_counted() -> None:
    bench = Bench()
    bench.endpoint.send(KINDS[mav.MAVLINK_MSG_ID_MISSION_ITEM_REACHED], 70000)
    assert bench.endpoint.ignored["not_sent MISSION_ITEM_REACHED"] == 1


def test_extreme_states_still_report() -> None:
    """A vehicle far away and tumbling fills no field beyond what it holds."""
    bench = Bench(every_stream=True)
    bench.world.plant.state[10:13, 0] = 9e5, -9e5, -9e4
    bench.world.plant.state[7:10, 0] = 900.0, -900.0, 900.0
    for message in STREAMS:
        bench.endpoint.request(message, 0.0)
    bench.run(0.1)
    assert not [key for key in bench.endpoint.ignored if key.startswith("not_sent")]
    assert np.isfinite(bench.world.plant.state).all()
