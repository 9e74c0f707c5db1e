"""What ground stations see of a vehicle that an agent flies, and what they may ask of it. Over real UDP."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as dialect

from swarmctl.config import load
from swarmctl.errors import ConfigError
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.forwarding import Forwarding
from swarmctl.mavlink.transport import PipeTransport, pipe_pair

VEHICLE, STATION = Codec(1, 1), Codec(255, 190)
READS: list[Any] = [
    dialect.MAVLink_param_request_read_message(1, 1, b"NAV_RCL_ACT", -1),
    dialect.MAVLink_param_request_list_message(1, 1),
    dialect.MAVLink_mission_request_list_message(1, 1, 0),
    dialect.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0),
]
COMMANDS: list[Any] = [
    dialect.MAVLink_command_long_message(1, 1, 400, 0, 0, 21196, 0, 0, 0, 0, 0),
    dialect.MAVLink_set_mode_message(1, 1, 4 << 16),
    dialect.MAVLink_param_set_message(1, 1, b"NAV_RCL_ACT", 0.0, 6),
    dialect.MAVLink_mission_clear_all_message(1, 1, 0),
]
NEVER: list[Any] = [
    dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
    dialect.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.5),
    dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0, *[0.0] * 11),
    dialect.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0),
    dialect.MAVLink_setup_signing_message(1, 1, [0] * 32, 0),
    dialect.MAVLink_vision_position_estimate_message(0, 0, 0, 0, 0, 0, 0),
]


def kind(message: Any) -> str:
    return str(message.get_type())


@dataclass
class Bench:
    link: Forwarding
    vehicle: PipeTransport
    station: socket.socket
    may_command: bool

    def asked(self, frame: bytes, times: int = 1) -> list[bytes]:
        """What reaches the vehicle of a frame that the station sends, in one tick."""
        self.vehicle.send(b"\xfd")  # so that the station knows where to send
        self.link.receive(0)
        _, address = self.station.recvfrom(2048)
        for _ in range(times):
            self.station.sendto(frame, address)
        self.link.receive(0)
        return [datagram.data for datagram in self.vehicle.receive(0)]


@pytest.fixture(params=[False, True], ids=["read only", "commands"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    ours, vehicle = pipe_pair(lambda: 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(5.0)
        link = Forwarding(ours, [station.getsockname()], 1, commands=request.param)
        yield Bench(link, vehicle, station, request.param)
        link.close()


def test_stations_receive_what_the_agent_receives(bench: Bench) -> None:
    frames = [VEHICLE.encode(dialect.MAVLink_attitude_message(t, 0, 0, 0, 0, 0, 0)) for t in range(5)]
    for frame in frames:
        bench.vehicle.send(frame)
    assert [datagram.data for datagram in bench.link.receive(0)] == frames
    assert [bench.station.recv(2048) for _ in frames] == frames


def test_without_a_station_the_link_is_as_it_was(bench: Bench) -> None:
    bench.station.close()
    for _ in range(3):  # the first one comes back as an error
        bench.vehicle.send(b"frame")
        assert [datagram.data for datagram in bench.link.receive(0)] == [b"frame"]


@pytest.mark.parametrize("message", READS, ids=kind)
def test_stations_may_read(bench: Bench, message: Any) -> None:
    frame = STATION.encode(message)
    assert bench.asked(frame) == [frame]


@pytest.mark.parametrize("message", COMMANDS, ids=kind)
def test_stations_command_only_where_they_are_allowed_to(bench: Bench, message: Any) -> None:
    frame = STATION.encode(message)
    assert bench.asked(frame) == ([frame] if bench.may_command else [])
    assert bench.link.dropped == ({} if bench.may_command else {"read only": 1})


@pytest.mark.parametrize("message", NEVER, ids=kind)
def test_setpoints_heartbeats_and_keys_never_pass(bench: Bench, message: Any) -> None:
    assert bench.asked(STATION.encode(message)) == []
    assert bench.link.dropped == {"not for stations": 1}


def test_nobody_speaks_in_the_name_of_the_vehicle(bench: Bench) -> None:
    assert bench.asked(Codec(1, 190).encode(READS[0])) == []
    assert bench.link.dropped == {"in the vehicle's name": 1}


def test_only_the_station_is_heard(bench: Bench) -> None:
    bench.vehicle.send(b"\xfd")
    bench.link.receive(0)
    _, address = bench.station.recvfrom(2048)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.bind(("127.0.0.1", 0))
        stranger.sendto(STATION.encode(READS[0]), address)
        bench.link.receive(0)
        assert bench.vehicle.receive(0) == []


def test_a_flood_is_passed_on_in_portions(bench: Bench) -> None:
    assert 0 < len(bench.asked(STATION.encode(READS[0]), times=100)) <= 20


def test_what_stations_ask_is_signed_where_the_link_is() -> None:
    ours, vehicle = pipe_pair(lambda: 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        link = Forwarding(ours, [station.getsockname()], 1, sign=lambda frame: frame + b"signed")
        frame = STATION.encode(READS[0])
        assert Bench(link, vehicle, station, may_command=False).asked(frame) == [frame + b"signed"]
        link.close()


@pytest.mark.parametrize("url", ["udpin://0.0.0.0:14550", "14550", "udpout://10.0.0.1:0"])
def test_only_addresses_are_forwarded_to(url: str) -> None:
    with pytest.raises(ConfigError, match=r"mavlink\.forward\.0 = "):
        load(None, [f"mavlink.forward=['{url}']"])
