"""Two links of one vehicle, open ports, and the effect of a reboot on either."""

from __future__ import annotations

import math
import socket
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.fault_socket import ControlSocket
from sitl.net.mavlink_values import Result
from sitl.net.ports import OpenPort
from sitl.net.tcp import serve_tcp
from sitl.px4.modes import Px4Mode
from sitl.px4.parameters import REAL32
from sitl.studies.bench.free_ports import free_ports
from swarmctl.mavlink.transport import bind_udp
from tests.benches.px4_bench import COARSE, SPAWN_NED_M, Bench

BEAT, ACK, TEXT, VALUE = 0, 77, 253, 22
GCS_BEAT = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, 8, 0, 0, 4, 3)


def test_texts_go_to_the_link_that_hears_a_ground_station() -> None:
    bench = Bench(gcs=True)
    bench.send(GCS_BEAT, gcs=True)
    bench.run(0.02)
    assert bench.arm() == Result.ACCEPTED
    bench.run(0.3)
    texts = [m.text for m in bench.said(TEXT, gcs=True)]
    assert texts == ["Armed by external command\t", "[logger] ./log/2026-01-01/00_00_00.ulg\t"]
    assert [m.id for m in bench.said(TEXT, gcs=True)] == [1, 2]
    assert not bench.said(TEXT)
    bench.send(GCS_BEAT)  # now the offboard link hears one too
    bench.run(0.02)
    bench.command(400, 0)
    bench.run(0.2)
    assert [m.text for m in bench.said(TEXT)][-1] == "Disarmed by external command\t"


def test_a_parameter_set_on_one_link_is_sent_on_the_other() -> None:
    bench = Bench(gcs=True)
    bench.send(mav.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 0.5, REAL32))
    bench.run(0.02)
    for gcs in (False, True):
        assert [(m.param_id, m.param_value) for m in bench.said(VALUE, gcs=gcs)] == [("COM_OF_LOSS_T", 0.5)]


def test_the_parameter_list_begins_with_its_hash() -> None:
    bench = Bench()
    bench.send(mav.MAVLink_param_request_list_message(1, 1))
    bench.run(0.6)
    first, *rest = bench.said(VALUE)
    assert (first.param_id, first.param_index, first.param_type) == ("_HASH_CHECK", 65535, 5)
    assert [m.param_index for m in rest] == list(range(first.param_count))
    before = bench.pilot.parameters.checksum().value
    bench.pilot.parameters.assign("COM_OF_LOSS_T", 0.7)
    assert bench.pilot.parameters.checksum().value != before
    bench.forget()
    bench.send(mav.MAVLink_param_request_list_message(1, 1))
    bench.run(0.02)
    bench.send(mav.MAVLink_param_set_message(1, 1, b"_HASH_CHECK", before, 5))  # it knows them: stop
    bench.run(0.5)
    assert len(bench.said(VALUE)) < 40


def test_an_open_port_receives_from_every_sender_and_answers_the_first() -> None:
    nobody, first, second = (bind_udp("127.0.0.1", 0) for _ in range(3))
    for sock in (nobody, first, second):
        sock.settimeout(1.0)
    port = OpenPort(bind_udp("127.0.0.1", 0), nobody.getsockname())
    place = port._sock.getsockname()
    port.send(b"one")
    assert nobody.recv(10) == b"one"
    first.sendto(b"a", place)
    second.sendto(b"b", place)
    got: list[bytes] = []
    while len(got) < 2:
        got += [d.data for d in port.receive(0)]
    assert got == [b"a", b"b"]
    port.send(b"two")
    assert first.recv(10) == b"two"
    second.setblocking(False)
    with pytest.raises(BlockingIOError):
        second.recv(10)
    port.close()
    for sock in (nobody, first, second):
        sock.close()


class Flood:
    """A socket whose other end never stops sending."""

    def __init__(self, data: bytes = b"x") -> None:
        self.data, self.reads = data, 0

    def recvfrom(self, size: int) -> tuple[bytes, tuple[str, int]]:
        return self.recv(size), ("127.0.0.1", 9)

    def recv(self, size: int) -> bytes:
        self.reads += 1
        assert self.reads < 5000, "it is read without end"
        return self.data

    def sendto(self, data: bytes, to: object) -> None:
        return

    def close(self) -> None:
        return


def test_a_flood_does_not_stop_the_simulation(tmp_path: Path) -> None:
    flood: Any = Flood()
    port = OpenPort(bind_udp("127.0.0.1", 0), ("127.0.0.1", 9))
    port._sock.close()
    port._sock = flood
    assert 100 < len(port.receive(0)) < 1000
    assert port.receive(1), "the rest is taken by the next"
    [server] = serve_tcp("127.0.0.1", free_ports(1)[0], 1)
    server._client = Flood(b"x" * 4096)  # type: ignore[assignment]
    server.receive(0)
    server.close()
    control = ControlSocket(tmp_path / "control.sock")
    control._socket.close()
    control._socket = Flood(b"no request")  # type: ignore[assignment]
    control.poll(Bench().world)
    control.close()


def test_a_closed_peer_does_not_stop_a_port() -> None:
    gone = bind_udp("127.0.0.1", 0)
    where = gone.getsockname()
    gone.close()
    port = OpenPort(bind_udp("127.0.0.1", 0), where)
    for _ in range(3):
        port.send(b"x")
        assert port.receive(0) == []
    port.close()


# --- reboot ---


def test_a_reboot_is_silence_and_then_a_new_beginning() -> None:
    bench = Bench(gcs=True)
    bench.pilot.parameters.assign("COM_OF_LOSS_T", 0.4)
    bench.setpoint()
    assert bench.mode(6) == Result.ACCEPTED
    assert bench.command(246, 1) == Result.ACCEPTED
    bench.run(0.45)
    bench.forget()
    bench.run(1.2)
    assert not bench.received
    assert not bench.gcs_received
    assert bench.command(400, 1) is None  # nobody listens
    bench.run(0.6)
    (beat, *_) = bench.said(BEAT)
    assert (beat.custom_mode, beat.base_mode) == (Px4Mode.AUTO_LOITER, 29)
    assert bench.said(ACK)[0].command == 211
    bench.command(512, mav.MAVLINK_MSG_ID_SYSTEM_TIME)
    assert 0 < bench.said(mav.MAVLINK_MSG_ID_SYSTEM_TIME)[-1].time_boot_ms < 1000  # a new clock
    assert bench.pilot.parameters.real("COM_OF_LOSS_T") == 0.4  # kept
    assert bench.arm() == Result.ACCEPTED


def test_no_reboot_while_armed() -> None:
    bench = Bench()
    bench.arm()
    assert bench.command(246, 1) == Result.DENIED
    bench.run(1.0)
    assert bench.pilot.armed
    assert bench.command(246, 0) == Result.ACCEPTED  # nothing asked
    bench.run(1.0)
    assert bench.pilot.armed


def test_the_local_frame_begins_where_it_boots() -> None:
    """Moved by hand between two boots: the new origin is there, and origin plus local position is still the truth."""
    bench = Bench()
    before = bench.pilot.boot.origin
    bench.world.plant.state[10:12, 0] += 40.0, -30.0
    bench.run(0.1)
    assert bench.command(246, 1) == Result.ACCEPTED
    bench.run(2.4)
    after = bench.pilot.boot.origin
    assert before is not None
    assert after is not None
    north_m = (after.lat_e7 - before.lat_e7) * after.metres_per_e7_north
    east_m = (after.lon_e7 - before.lon_e7) * after.metres_per_e7_east
    assert (north_m, east_m) == pytest.approx((40.0, -30.0), abs=0.02)
    assert bench.command(512, mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED) == Result.ACCEPTED
    local = bench.said(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED)[-1]
    assert math.hypot(local.x, local.y) < 0.02
    truth = bench.world.truth_rows()[0]["pos_ned_m"]
    assert (north_m + local.x + SPAWN_NED_M[0], east_m + local.y + SPAWN_NED_M[1]) == pytest.approx(
        (truth[0], truth[1]), abs=0.01
    )
    assert bench.said(mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)[-1].latitude == after.lat_e7


def test_a_reboot_ends_the_poison_of_a_bad_quaternion() -> None:
    bench = Bench("x500", **COARSE, reject_bad_setpoints=False).in_offboard()
    bench.setpoint(q=[0.0] * 4)
    bench.run(0.02)
    assert bench.pilot.stream.poisoned
    bench.command(400, 0, 21196)
    assert bench.command(246, 1) == Result.ACCEPTED
    bench.run(2.5)
    assert not bench.pilot.stream.poisoned


# --- body rates ---


@pytest.mark.parametrize("preset", ["thesis", "x500"])
def test_body_rates_are_flown(preset: str) -> None:
    bench = Bench(preset).in_offboard(height_m=4.0)
    turned = 0.0
    for _ in range(40):
        bench.setpoint(mask=128, rates=(0.5, 0.0, 0.0))
        bench.run(0.02)
        turned += float(bench.world.plant.rate_frd_rad_s[0, 0]) * 0.02
    assert float(bench.world.plant.rate_frd_rad_s[0, 0]) == pytest.approx(0.5, abs=0.06)
    assert turned == pytest.approx(0.4, abs=0.1)
    bench.run(0.6, 50)  # and an attitude again
    assert abs(float(bench.world.plant.euler_rad[0, 0])) < 0.35
    bench.run(0.02)
    assert bench.pilot.mode == Px4Mode.OFFBOARD


def test_a_yaw_rate_beside_an_attitude_is_fed_forward_and_mask_7_ignores_it() -> None:
    yaws = []
    for mask in (7, 3):
        bench = Bench("x500").in_offboard(height_m=2.0)
        for _ in range(60):
            bench.setpoint(mask=mask, rates=(0.3, 0.3, 0.4))
            bench.run(0.02)
        yaws.append(float(bench.world.plant.euler_rad[2, 0]))
    assert abs(yaws[0]) < 0.01
    assert yaws[1] > 0.05


def test_a_socket_is_what_a_port_needs() -> None:
    """The port's own descriptor is a bound datagram socket: selectors wait on it."""
    port = OpenPort(bind_udp("127.0.0.1", 0), ("127.0.0.1", 9))
    assert socket.socket(fileno=socket.dup(port.fd)).type == socket.SOCK_DGRAM
    port.close()
