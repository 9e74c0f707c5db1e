"""MAVSDK's services for vehicles on the ground, against simulator processes over UDP."""

from __future__ import annotations

import os
import select
import tempfile
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from sitl.studies.bench.free_ports import free_ports
from swarmctl.check.ground_services import GroundServices, GroundVehicle, open_services
from swarmctl.check.scan.listener import open_listener
from swarmctl.check.scan.scanner import VehicleScan, run_scans
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.transport import bind_udp
from swarmctl.wall_clock import monotonic_us
from tests.process.test_check import Simulator

pytestmark = pytest.mark.process

READ = ("COM_OBL_RC_ACT", "COM_OF_LOSS_T", "GF_ACTION")


@pytest.fixture
def scans() -> Iterator[dict[int, VehicleScan]]:
    """The scans of two vehicles, finished."""
    simulator = Simulator(2)
    opened = [open_listener(f"udpin://127.0.0.1:{port}") for port in simulator.ports]
    try:
        simulator.wait_until_up()
        made = {
            agent: VehicleScan(listener, there, agent + 1, lambda _: READ, seconds=1.0)
            for agent, (listener, there) in enumerate(opened)
        }
        run_scans(list(made.values()), 20.0, 30.0, lambda: False)
        yield made
    finally:
        for listener, _ in opened:
            listener.close()
        simulator.stop()


def values(scan: VehicleScan) -> list[float | int | None]:
    """Return what a vehicle stores now."""
    assert scan.parameters is not None
    scan.parameters.read_again(READ)
    run_scans([scan], 0.0, 10.0, lambda: False)
    return [scan.parameters.facts()[name].value for name in READ]


def test_each_vehicle_is_given_its_own_values(scans: dict[int, VehicleScan]) -> None:
    assert values(scans[0]) == values(scans[1]) == [0, 1.0, 2]
    wanted: dict[int, dict[str, int | float]] = {0: {"COM_OBL_RC_ACT": 4}, 1: {"COM_OF_LOSS_T": 0.5, "GF_ACTION": 5}}
    with open_services(scans) as services:
        done = services.ask({agent: partial(GroundVehicle.set_parameters, values=own) for agent, own in wanted.items()})
    assert done == {0: True, 1: True}
    assert values(scans[0]) == [4, 1.0, 2]
    assert values(scans[1]) == [0, 0.5, 5]


def test_nothing_more_is_set_once_the_vehicle_is_armed(scans: dict[int, VehicleScan]) -> None:
    scan = scans[0]
    arm = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1.0, *[0.0] * 6)

    def job(vehicle: GroundVehicle) -> tuple[bool, bool, str]:
        first = vehicle.set_parameters({"COM_OBL_RC_ACT": 4})
        scan.forward(Codec(1, 190).encode(arm))
        until_s = time.monotonic() + 5.0
        while scan.may_change(monotonic_us()) and time.monotonic() < until_s:
            time.sleep(0.05)
        return first, vehicle.set_parameters({"GF_ACTION": 5}), vehicle.upload_fence([(0.0, 0.0)] * 3).problem

    with open_services({0: scan}) as services:
        told = services.ask({0: job})
    assert told == {0: (True, False, "it was armed, or fell silent, meanwhile")}
    assert values(scan) == [4, 1.0, 2]


class Relay(threading.Thread):
    """A link that moves every corner on its way to the vehicle north, by 1e-4 degrees."""

    def __init__(self, vehicle_port: int, our_port: int) -> None:
        super().__init__(daemon=True)
        self._theirs, self._ours = (bind_udp("127.0.0.1", port) for port in (vehicle_port, 0))
        self._us, self._vehicle = ("127.0.0.1", our_port), ("127.0.0.1", 0)
        self._codec, self._ended = Codec(1, 1), threading.Event()

    def run(self) -> None:
        while not self._ended.is_set():
            for sock in select.select([self._theirs, self._ours], [], [], 0.1)[0]:
                data, sender = sock.recvfrom(2048)
                if sock is self._theirs:
                    self._vehicle = sender
                    self._ours.sendto(data, self._us)
                else:
                    self._theirs.sendto(self._changed(data), self._vehicle)

    def _changed(self, data: bytes) -> bytes:
        message = self._codec.decode(data)
        if message is None or message.get_type() != "MISSION_ITEM_INT":
            return data
        message.x += 1000
        return Codec(data[5], data[6]).encode(message)

    def stop(self) -> None:
        self._ended.set()
        self.join(5.0)
        for sock in (self._theirs, self._ours):
            sock.close()


def test_a_geofence_is_what_the_vehicle_stores_and_not_what_was_sent() -> None:
    simulator, (our_port,) = Simulator(1), free_ports(1)
    relay = Relay(simulator.ports[0], our_port)
    listener, there = open_listener(f"udpin://127.0.0.1:{our_port}")
    relay.start()
    try:
        scan = VehicleScan(listener, there, 1, lambda _: READ, seconds=1.0)
        run_scans([scan], 20.0, 30.0, lambda: False)
        corners = [(47.3, 8.5), (47.3, 8.6), (47.4, 8.6)]
        with open_services({0: scan}) as services:
            stored = services.ask({0: partial(GroundVehicle.upload_fence, corners_deg=corners)})[0]
        assert (stored.problem, stored.others) == ("", 0)
        assert np.array(stored.corners_deg) - corners == pytest.approx(np.array([(1e-4, 0.0)] * 3), abs=2e-7)
    finally:
        relay.stop()
        listener.close()
        simulator.stop()


def test_what_the_simulator_does_not_speak_is_told_in_time(
    scans: dict[int, VehicleScan],
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # where nobody else starts a MAVSDK
    begun_s = time.monotonic()
    with open_services({0: scans[0]}) as services:
        assert services.ask({0: lambda vehicle: (vehicle.logs(), vehicle.arming_checks())}) == {0: (None, None)}
    assert time.monotonic() - begun_s < 25.0
    assert list(tmp_path.iterdir()) == []
    assert "TMPDIR" not in os.environ or Path(os.environ["TMPDIR"]).is_dir()
    assert "mavsdk" not in capfd.readouterr().out.lower(), "its lines would mix with the table"


def test_a_vehicle_that_is_gone_is_left_out(scans: dict[int, VehicleScan]) -> None:
    scans[0].listener.close()
    with open_services(scans) as services:
        assert_only_the_second(services)


def assert_only_the_second(services: GroundServices) -> None:
    assert services.ask(dict.fromkeys((0, 1), lambda vehicle: vehicle.fence().others)) == {1: 0}
