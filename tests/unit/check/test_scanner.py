"""Scans of a vehicle: what is received on a link, what is requested, and that a scan changes nothing."""

from __future__ import annotations

import os
import socket
import struct
import sys
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.check.parameters import names_to_read
from swarmctl.check.scan.link_facts import VehicleFacts
from swarmctl.check.scan.link_statistics import Answer, FrameStatistics, round_trip, vehicle_time
from swarmctl.check.scan.listener import NOWHERE, Address, ReceivedDatagram, UdpListener, open_listener
from swarmctl.check.scan.scan_facts import facts_of
from swarmctl.check.scan.scanner import ASKED, SCANNER_COMPID, VehicleScan
from swarmctl.check.swarm import exit_code, findings
from swarmctl.check.table import as_json
from swarmctl.config import load
from swarmctl.core.types import FlightMode, GeoOrigin, Landed
from swarmctl.errors import StartError
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.dialects.dialect import Dialect
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.framing import frames

SHARED = GeoOrigin(47.397742, 8.545594, 489.4)
VEHICLE, STRANGER = ("10.0.0.1", 14580), ("10.0.0.9", 4000)
PX4, COPTER = 12, 3
HOLD, GUIDED = 4 << 16 | 3 << 24, 4
STEP_US = 10_000


class ScriptedListener:
    """A link whose other end is a function: frames sent to it are answered by what it returns."""

    refused = None

    def __init__(self) -> None:
        self.dropped = 0
        self.inbox: list[ReceivedDatagram] = []
        self.sent: list[tuple[Any, Address]] = []
        self.now_us = 1_000_000
        self._codec = Codec(99, 99)

    def receive(self) -> list[ReceivedDatagram]:
        heard, self.inbox = self.inbox, []
        return heard

    def send(self, data: bytes, to: Address) -> None:
        self.sent += [(self._codec.decode(frame), to) for frame in frames(data)]

    def fd(self) -> int | None:
        return None

    def close(self) -> None:
        self.inbox = []


class Vehicle:
    """The autopilot side of a scan."""

    def __init__(self, listener: ScriptedListener, sysid: int = 1, autopilot: int = PX4, mode: int = HOLD) -> None:
        self.listener, self.sysid, self.autopilot, self.mode = listener, sysid, autopilot, mode
        self.armed = False
        self.values: dict[str, tuple[int, float | int]] = {}  # name -> kind, value
        self.silent_about: set[str] = set()
        self.health = 0  # of SYS_STATUS, which it sends only when asked; 0: never
        self.codec = Codec(sysid, 1)
        self._read = 0

    def say(self, message: Any, sender: Address = VEHICLE, codec: Codec | None = None) -> None:
        self.listener.inbox.append(
            ReceivedDatagram(self.listener.now_us, (codec or self.codec).encode(message), sender)
        )

    def beat(self, sender: Address = VEHICLE) -> None:
        base = 29 | (128 if self.armed else 0)
        self.say(mavlink.MAVLink_heartbeat_message(2, self.autopilot, base, self.mode, 3, 3), sender)

    def answer(self) -> None:
        """Answer what has been asked since the last call."""
        asked, self._read = self.listener.sent[self._read :], len(self.listener.sent)
        for message, _ in asked:
            kind = message.get_type()
            if kind == "TIMESYNC":
                self.say(mavlink.MAVLink_timesync_message(self.listener.now_us * 1000 + 5_000_000_000, message.ts1))
            elif kind == "PING":
                self.say(mavlink.MAVLink_ping_message(message.time_usec, message.seq, 1, SCANNER_COMPID))
            elif kind == "COMMAND_LONG" and message.param1 == mavlink.MAVLINK_MSG_ID_SYS_STATUS and self.health:
                self.say(mavlink.MAVLink_sys_status_message(1, 1, self.health, 0, 0, 0, -1, 0, 0, 0, 0, 0, 0))
            elif kind == "PARAM_REQUEST_READ":
                self._param(message.param_id)

    def _param(self, name: str) -> None:
        if name in self.silent_about:
            return
        if name not in self.values:
            if self.autopilot == PX4:
                self.say(mavlink.MAVLink_param_error_message(1, SCANNER_COMPID, name.encode(), -1, 1))
            return
        kind, value = self.values[name]
        wire = float(value)
        if kind != 9 and self.autopilot == PX4:
            wire = struct.unpack("<f", struct.pack("<i", int(value)))[0]
        self.say(mavlink.MAVLink_param_value_message(name.encode(), wire, kind, len(self.values), 0))


def names(*wanted: str) -> Callable[[Dialect], Sequence[str]]:
    return lambda dialect: wanted


def run(scan: VehicleScan, vehicle: Vehicle, seconds: float, beating: bool = True) -> VehicleFacts:
    """Run both ends, step by step, on one simulated clock."""
    listener = vehicle.listener
    until_us = listener.now_us + round(seconds * 1e6)
    while listener.now_us < until_us:
        if beating and listener.now_us % 1_000_000 < STEP_US:
            vehicle.beat()
        vehicle.answer()
        scan.step(listener.now_us)
        listener.now_us += STEP_US
    return facts_of(scan, 0, "udpin://0.0.0.0:14540", 1, shared=SHARED, now_us=listener.now_us)


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch) -> ScriptedListener:
    scripted = ScriptedListener()
    monkeypatch.setattr("swarmctl.check.scan.scanner.monotonic_us", lambda: scripted.now_us)
    return scripted


# --- nothing is changed by asking ---


@pytest.mark.parametrize("armed", [False, True])
def test_asking_changes_nothing(listener: ScriptedListener, armed: bool) -> None:
    vehicle = Vehicle(listener)
    vehicle.armed = armed
    vehicle.values = {"COM_OBL_RC_ACT": (6, 0)}
    scan = VehicleScan(listener, NOWHERE, 1, names("COM_OBL_RC_ACT", "COM_NOT_THERE"), seconds=2.0)
    run(scan, vehicle, 3.0)
    kinds = {message.get_type() for message, _ in listener.sent}
    assert kinds == {"HEARTBEAT", "TIMESYNC", "PING", "COMMAND_LONG", "PARAM_REQUEST_READ"}
    commands = {message.command for message, _ in listener.sent if message.get_type() == "COMMAND_LONG"}
    assert commands == {mavlink.MAV_CMD_REQUEST_MESSAGE}
    beats = [message for message, _ in listener.sent if message.get_type() == "HEARTBEAT"]
    assert all(beat.type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER for beat in beats)  # a GCS's loss is a failsafe
    assert all(message.tc1 == 0 for message, _ in listener.sent if message.get_type() == "TIMESYNC")


def test_nothing_is_sent_before_an_autopilot_was_received(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0)
    run(scan, vehicle, 1.5, beating=False)
    assert listener.sent == []
    assert not scan.found_autopilot
    run(scan, vehicle, 1.5)
    assert {to for _, to in listener.sent} == {VEHICLE}


# --- what is heard ---


def test_facts_of_a_px4(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    vehicle.values = {"COM_OBL_RC_ACT": (6, 4), "COM_OF_LOSS_T": (9, 0.5)}
    scan = VehicleScan(listener, NOWHERE, 1, names("COM_OBL_RC_ACT", "COM_OF_LOSS_T", "COM_NOT_THERE"), seconds=2.0)
    vehicle.beat()
    version, none = 0x01120080, [0] * 8
    git = [0, 0, 0, 0x80, 0xE5, 0xF4, 0xC4, 0x83]
    for message in (
        mavlink.MAVLink_autopilot_version_message(59647, version, version, 0, 1, git, none, none, 0, 0, 0),
        mavlink.MAVLink_extended_sys_state_message(0, 1),
        mavlink.MAVLink_sys_status_message(1, 1, 1, 0, 16200, -1, 87, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_estimator_status_message(0, 831, 0, 0, 0, 0, 0, 0, 0.25, 0.5),
        mavlink.MAVLink_gps_raw_int_message(0, 3, 0, 0, 0, 90, 90, 0, 0, 255, 0, 800),
        mavlink.MAVLink_gps_global_origin_message(473977420, 85455940, 490400, 0),
        mavlink.MAVLink_local_position_ned_message(0, 1.0, 2.0, -3.0, 0, 0, 0),
    ):
        vehicle.say(message)
    facts = run(scan, vehicle, 2.5)
    assert scan.finished(listener.now_us)
    assert (facts.autopilot, facts.mode, facts.armed, facts.landed) == ("PX4", FlightMode.HOLD, False, Landed.ON_GROUND)
    assert facts.version is not None
    assert (facts.version.firmware, facts.version.stage, facts.version.uid) == ((1, 18, 0), "beta", "0")
    assert facts.version.git.startswith("83c4f4e580") and facts.version.bytewise is True
    assert facts.sensors is not None and (facts.sensors.battery_v, facts.sensors.battery_01) == (16.2, 0.87)
    assert facts.estimator is not None and facts.pos_accuracy_m == 0.25
    assert facts.gps is not None and (facts.gps.satellites, facts.gps.pos_horiz_m) == (None, 0.8)
    assert facts.origin_told and facts.origin_ned_m is not None and facts.pos_ned_m is not None
    np.testing.assert_allclose(facts.origin_ned_m, (0.0, 0.0, -1.0), atol=0.02)
    np.testing.assert_allclose(facts.pos_ned_m, (1.0, 2.0, -4.0), atol=0.02)
    values = {name: p.value for name, p in (facts.parameters or {}).items()}
    assert values == {"COM_OBL_RC_ACT": 4, "COM_OF_LOSS_T": 0.5, "COM_NOT_THERE": None}
    assert facts.link.rates_hz["HEARTBEAT"] > 0
    assert facts.link.round_trip is not None and facts.link.round_trip.by == "TIMESYNC"
    assert facts.link.time is not None
    assert facts.link.time.offset_s == pytest.approx(5.0, abs=0.02)


def test_a_place_without_an_origin_message_comes_from_the_global_position(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    vehicle.beat()
    vehicle.say(mavlink.MAVLink_global_position_int_message(0, 473977420, 85455940, 499400, 0, 0, 0, 0, 0))
    vehicle.say(mavlink.MAVLink_local_position_ned_message(0, 0.0, 0.0, -8.0, 0, 0, 0))
    facts = run(VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0), vehicle, 1.5)
    assert not facts.origin_told and facts.pos_ned_m is not None and facts.origin_ned_m is not None
    np.testing.assert_allclose(facts.pos_ned_m, (0.0, 0.0, -10.0), atol=0.02)
    np.testing.assert_allclose(facts.origin_ned_m, (0.0, 0.0, -2.0), atol=0.02)


def test_what_is_missing_is_asked_for_a_few_times_and_no_more(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    run(VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0), vehicle, 8.0)
    asked = [m.param1 for m, _ in listener.sent if m.get_type() == "COMMAND_LONG"]
    assert asked.count(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == 4


def test_a_vehicle_that_is_not_ready_is_waited_for_and_asked_again(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener, autopilot=COPTER, mode=GUIDED)
    vehicle.health = 1
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0, patience_s=4.0)
    run(scan, vehicle, 2.5)
    assert not scan.finished(listener.now_us)
    vehicle.health = 1 | 1 << 28
    facts = run(scan, vehicle, 2.0)
    assert scan.finished(listener.now_us)
    assert facts.sensors is not None and facts.sensors.healthy == vehicle.health

    hopeless = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0, patience_s=1.0)
    vehicle.health = 1
    run(hopeless, vehicle, 2.5)
    assert hopeless.finished(listener.now_us)


def test_another_vehicle_is_reported_until_the_configured_one_sends(listener: ScriptedListener) -> None:
    other, wanted = Vehicle(listener, sysid=4), Vehicle(listener, sysid=1)
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0)
    other.beat()
    assert run(scan, wanted, 0.2, beating=False).sysid == 4
    wanted.beat()
    facts = run(scan, wanted, 0.2, beating=False)
    assert (facts.sysid, facts.link.autopilots) == (1, (1, 4))


def test_companions_and_ground_stations_are_not_vehicles(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    vehicle.autopilot = 8
    assert "no autopilot" in run(VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0), vehicle, 1.2).unreachable
    vehicle.say(mavlink.MAVLink_heartbeat_message(2, PX4, 29, HOLD, 3, 3), codec=Codec(1, 25))
    assert run(VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0), vehicle, 0.1, beating=False).unreachable


def test_a_second_sender_is_counted_and_the_vehicle_answered(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0)
    vehicle.beat()
    vehicle.beat(STRANGER)
    facts = run(scan, vehicle, 0.5, beating=False)
    assert facts.link.senders == 2
    assert {to for _, to in listener.sent} == {VEHICLE}


def test_mavlink_1_is_recognised(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = mavlink.MAVLink_heartbeat_message(2, PX4, 29, HOLD, 3, 3).pack(packer, force_mavlink1=True)
    listener.inbox.append(ReceivedDatagram(listener.now_us, beat, VEHICLE))
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0)
    scan.step(listener.now_us)
    facts = facts_of(scan, 0, "udpin://0.0.0.0:14540", 1, shared=SHARED, now_us=listener.now_us)
    assert (facts.link.mavlink1, facts.link.mavlink2, facts.sysid, facts.unreachable) == (1, 0, 1, "")
    assert list(frames(beat + vehicle.codec.encode(mavlink.MAVLink_ping_message(0, 0, 0, 0)) + b"x", version_1=True))


def test_an_unsupported_autopilot_is_reported_without_parameters(listener: ScriptedListener) -> None:
    scan = VehicleScan(listener, NOWHERE, 1, names("X"), seconds=1.0)
    facts = run(scan, Vehicle(listener, autopilot=4), 1.5)
    assert (facts.unreachable, facts.autopilot, facts.autopilot_number, facts.parameters) == ("", "", 4, {})
    assert scan.finished(listener.now_us)


def test_junk_is_survived(listener: ScriptedListener) -> None:
    rng = np.random.default_rng([7])
    vehicle = Vehicle(listener)
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0)
    good = vehicle.codec.encode(mavlink.MAVLink_heartbeat_message(2, PX4, 29, HOLD, 3, 3))
    for _ in range(2000):
        frame = bytearray(good)
        frame[int(rng.integers(1, len(frame)))] ^= 1 << int(rng.integers(8))
        listener.inbox.append(
            ReceivedDatagram(listener.now_us, bytes(frame[: int(rng.integers(1, len(frame) + 1))]), STRANGER)
        )
    listener.inbox += [
        ReceivedDatagram(listener.now_us, data, STRANGER) for data in (b"", b"\xfd\xff", b"\xfe", bytes([0xFD] * 300))
    ]
    scan.step(listener.now_us)
    assert not scan.found_autopilot


def test_whatever_an_autopilot_says_a_check_ends_in_words(listener: ScriptedListener) -> None:
    rng = np.random.default_rng([11])
    config = load(None, ["swarm.agents=1"])
    kinds = [
        *ASKED,
        *(mavlink.MAVLINK_MSG_ID_TIMESYNC, mavlink.MAVLINK_MSG_ID_PING, mavlink.MAVLINK_MSG_ID_PARAM_VALUE),
    ]
    for autopilot in (PX4, COPTER):
        vehicle = Vehicle(listener, autopilot=autopilot)
        for _ in range(60):
            scan = VehicleScan(listener, NOWHERE, 1, lambda dialect: names_to_read(dialect, config), seconds=1.0)
            vehicle.beat()
            read = names_to_read(DIALECTS[autopilot], config)
            for kind in kinds:
                size = mavlink.mavlink_map[kind].unpacker.size
                payload = bytearray(
                    rng.choice(np.array([0, 0x7F, 0x80, 0xFF, *rng.integers(256, size=4)]), size).tolist()
                )
                if kind == mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
                    payload[8:24] = str(rng.choice(np.array(read))).encode().ljust(16, b"\0")
                listener.inbox.append(ReceivedDatagram(listener.now_us, raw_frame(1, 1, kind, bytes(payload)), VEHICLE))
            scan.step(listener.now_us)
            facts = facts_of(scan, 0, "udpin://0.0.0.0:14540", 1, shared=SHARED, now_us=listener.now_us + 10_000)
            assert facts.sysid == 1
            lines = findings([facts], config)
            assert as_json([facts], lines, [], exit_code([facts], lines))
            listener.now_us += STEP_US


def raw_frame(sysid: int, compid: int, kind: int, payload: bytes) -> bytes:
    """A MAVLink 2 frame with a good checksum around any payload."""
    body = bytes([len(payload), 0, 0, 0, sysid, compid]) + kind.to_bytes(3, "little") + payload
    crc = mavlink.x25crc(body + bytes([mavlink.mavlink_map[kind].crc_extra])).crc
    return b"\xfd" + body + int(crc).to_bytes(2, "little")


def test_values_are_read_again_on_request_and_unknown_until_then(listener: ScriptedListener) -> None:
    vehicle = Vehicle(listener)
    vehicle.values = {"AN_INT": (6, 1), "A_REAL": (9, 3.0)}
    scan = VehicleScan(listener, NOWHERE, 1, names("AN_INT", "A_REAL"), seconds=1.0)
    assert run(scan, vehicle, 1.5).number("AN_INT") == 1
    vehicle.values["AN_INT"] = (6, 4)
    assert run(scan, vehicle, 1.5).number("AN_INT") == 1
    assert scan.parameters is not None
    scan.parameters.read_again(["AN_INT"])
    assert scan.parameters.facts()["AN_INT"].value is None
    assert not scan.finished(listener.now_us)
    assert run(scan, vehicle, 1.5).number("AN_INT") == 4
    assert scan.finished(listener.now_us)
    reads = [m.param_id for m, _ in listener.sent if m.get_type() == "PARAM_REQUEST_READ"]
    assert sorted(reads) == ["AN_INT", "AN_INT", "A_REAL"]


def test_the_tap_gets_what_the_vehicle_sends_and_forwards_to_it_alone(listener: ScriptedListener) -> None:
    vehicle, tapped = Vehicle(listener), list[bytes]()
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0)
    run(scan, vehicle, 1.5)
    scan.tap = tapped.append
    vehicle.say(mavlink.MAVLink_statustext_message(6, b"from a stranger"), STRANGER)
    vehicle.say(mavlink.MAVLink_statustext_message(6, b"from the vehicle"))
    scan.step(listener.now_us)
    assert len(tapped) == 1 and b"from the vehicle" in tapped[0]
    scan.forward(Codec(255, 192).encode(mavlink.MAVLink_param_request_list_message(1, 1)))
    message, to = listener.sent[-1]
    assert (message.get_type(), to) == ("PARAM_REQUEST_LIST", VEHICLE)


@pytest.mark.parametrize("why", ["armed", "silent", "another"])
def test_nothing_may_be_changed_on_a_vehicle_that_is_armed_silent_or_another(
    listener: ScriptedListener, why: str
) -> None:
    vehicle = Vehicle(listener, sysid=4 if why == "another" else 1)
    scan = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0)
    run(scan, vehicle, 1.5)
    assert scan.may_change(listener.now_us) is (why != "another")
    vehicle.armed = why == "armed"
    run(scan, vehicle, 3.0, beating=why != "silent")
    assert not scan.may_change(listener.now_us)


# --- counting ---


@pytest.mark.parametrize(
    ("seqs", "lost"),
    [
        (range(300), 0),
        ([0, 1, 4, 5], 2),
        ([254, 255, 0, 1], 0),
        ([0, 1, 3, 2, 4], 0),
        ([0, 1, 1, 2], 0),
        ([0, 0, 2, 2, 4, 4], 2),
        ([0, 2, 0, 4, 2, 6, 4], 3),
        ([0, 3, 1, 1, 1, 4], 1),
        ([200, 255, 200, 200, 255], 54),
    ],
)
def test_lost_frames(seqs: Sequence[int], lost: int) -> None:
    statistics = FrameStatistics()
    for seq in seqs:
        statistics.frame(seq % 256, 20)
    assert statistics.lost == lost
    assert statistics.lost_01(dropped=0) == pytest.approx(lost / (lost + len(seqs)))
    assert statistics.lost_01(dropped=lost) == 0.0


def test_a_frame_that_arrives_damaged_is_lost(listener: ScriptedListener) -> None:
    scan, codec = VehicleScan(listener, NOWHERE, 1, names(), seconds=1.0), Codec(1, 1)
    for k in range(100):
        beat = bytearray(codec.encode(mavlink.MAVLink_heartbeat_message(2, PX4, 0, HOLD, 4, 3)))
        beat[12] ^= k % 10 == 5
        listener.inbox.append(ReceivedDatagram(listener.now_us, bytes(beat), STRANGER))
    scan.step(listener.now_us)
    assert (scan.statistics[1].frames, scan.statistics[1].lost) == (90, 10)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells")
def test_what_a_busy_computer_drops_is_not_lost_on_the_way() -> None:
    """Nobody reads while more arrives than the queue takes, as when the processor is busy; two are lost on the way."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)
    sock.bind(("127.0.0.1", 0))
    listener = UdpListener(sock)
    scan = VehicleScan(listener, NOWHERE, 1, lambda dialect: (), seconds=1.0)
    codec = Codec(1, 1)
    beats = [codec.encode(mavlink.MAVLink_heartbeat_message(2, PX4, 0, HOLD, 4, 3)) for _ in range(120)]
    del beats[5:7]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        for beat in beats[:-1]:
            vehicle.sendto(beat, sock.getsockname())
        scan.step(time.monotonic_ns() // 1000)
        vehicle.sendto(beats[-1], sock.getsockname())
        scan.step(time.monotonic_ns() // 1000)
    scan.listener.close()
    facts = facts_of(scan, 0, "", 1, shared=SHARED, now_us=time.monotonic_ns() // 1000)
    received = scan.statistics[1].frames
    assert facts.link.dropped == len(beats) - received > 50
    assert facts.link.lost_01 == pytest.approx(2 / (2 + received))


def test_rates_come_from_the_spacing() -> None:
    statistics = FrameStatistics()
    for k in range(10):
        statistics.message("ODOMETRY", 500_000 + k * 20_000)
    statistics.message("PING", 0)
    assert statistics.rates_hz(4.0) == pytest.approx({"ODOMETRY": 50.0, "PING": 0.25})


def test_offset_and_drift_of_a_clock() -> None:
    rng = np.random.default_rng([3])
    answers = []
    for k in range(80):
        sent_us = k * 50_000
        took_us = 2000 + rng.exponential(500)
        vehicle_us = 7e6 + (sent_us + took_us / 2) * 1.01
        answers.append(Answer(sent_us, round(sent_us + took_us), vehicle_us))
    time, trip = vehicle_time(answers), round_trip(answers, "TIMESYNC")
    assert time is not None and trip is not None
    assert time.drift_ppm == pytest.approx(10_000, abs=3 * time.sigma_ppm + 20)
    assert time.sigma_ppm < 100
    assert 2.0 < trip.p50_ms < trip.p99_ms < 10.0
    assert vehicle_time(answers[:4]) is not None and vehicle_time(answers[:4]).sigma_ppm == float("inf")  # type: ignore[union-attr]
    assert vehicle_time([Answer(0, 1, float("nan"))]) is None
    assert round_trip([], "PING") is None


# --- the link ---


@pytest.fixture
def bound() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(1.0)
        yield sock


def test_a_listener_receives_from_every_sender_and_answers_one(bound: socket.socket) -> None:
    own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    own.bind(("127.0.0.1", 0))
    listener = UdpListener(own)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        bound.sendto(b"one", own.getsockname())
        other.sendto(b"two", own.getsockname())
        heard = listener.receive()
    assert [h.data for h in heard] == [b"one", b"two"]
    assert len({h.sender for h in heard}) == 2
    listener.send(b"answer", heard[0].sender)
    assert bound.recv(100) == b"answer"
    listener.close()


def test_a_serial_link_is_read_and_written() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    listener, there = open_listener(f"serial://{os.ttyname(slave)}:57600")
    beat = Codec(1, 1).encode(mavlink.MAVLink_heartbeat_message(2, PX4, 29, HOLD, 3, 3))
    os.write(master, b"junk" + beat)
    heard: list[ReceivedDatagram] = []
    deadline_s = time.monotonic() + 2.0
    while not heard and time.monotonic() < deadline_s:
        heard = listener.receive()
    assert [(h.data, h.sender) for h in heard] == [(beat, there)]
    listener.send(beat, there)
    assert os.read(master, 100) == beat
    listener.close()
    os.close(master)
    os.close(slave)


def test_urls_that_can_not_be_opened_say_why(bound: socket.socket) -> None:
    host, port = bound.getsockname()
    with pytest.raises(StartError, match="can't be bound"):
        open_listener(f"udpin://{host}:{port}")
    listener, there = open_listener(f"udpout://{host}:{port}")
    assert there == (host, port)
    listener.send(b"hello", there)
    assert bound.recv(100) == b"hello"
    listener.close()
    with pytest.raises(StartError):
        open_listener("serial:///dev/does-not-exist:57600")
