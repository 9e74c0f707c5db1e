"""Faults: each has its effect while it lasts and none after, on its vehicle only; invalid ones are refused."""

from __future__ import annotations

import itertools
import json
import shutil
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.fault_socket import ControlSocket, handle
from sitl.net.lossy import LossyLink
from swarmctl.errors import ConfigError, StartError
from swarmctl.mavlink.framing import message_id
from swarmctl.mavlink.transport import Datagram
from swarmctl.ops.orders.fault import as_json, inject, line_of, parse_fault
from swarmctl.ops.running_launches import RunningLaunch
from swarmctl.process_lifetime import remove_socket
from swarmctl.simulator_config import FAULTS, FaultParams
from tests.benches.flown_world import FlownWorld
from tests.benches.px4_bench import COARSE

STEP_US = 4000


class Wire:
    """The far end of a link: keeps what was sent, delivers what is given."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.coming: list[Datagram] = []

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def receive(self, now_us: int) -> list[Datagram]:
        coming, self.coming = self.coming, []
        return coming

    def close(self) -> None:
        return


def through(count: int = 1000, *, outwards: bool = True, seed: int = 1, **impaired: float) -> list[tuple[int, bytes]]:
    """Return (step, datagram) of numbered datagrams, one per step, that leave an impaired link."""
    wire = Wire()
    link = LossyLink(wire, (seed,))
    direction = link.from_vehicle if outwards else link.to_vehicle
    for key, value in impaired.items():
        direction.set_impairment(key, value)
    out = []
    for k in range(count + 50):
        if not outwards and k < count:
            wire.coming.append(Datagram(k * STEP_US, k.to_bytes(2, "big")))
        out += [(k, datagram.data) for datagram in link.receive(k * STEP_US)]
        if outwards and k < count:
            link.send(k.to_bytes(2, "big"))
        out += [(k, data) for data in wire.sent]
        wire.sent.clear()
    return out


@pytest.mark.parametrize("outwards", [True, False])
def test_link_impairments(outwards: bool) -> None:
    plain = [(k, k.to_bytes(2, "big")) for k in range(1000)]
    assert through(outwards=outwards) == plain
    assert not through(outwards=outwards, loss_01=1.0)
    assert len(through(outwards=outwards, loss_01=0.3)) == pytest.approx(700, abs=50)
    assert len(through(outwards=outwards, duplicate_01=0.5)) == pytest.approx(1500, abs=50)
    delayed = through(outwards=outwards, delay_ms=100.0)
    assert [data for _, data in delayed] == [data for _, data in plain]
    assert {step - k for k, (step, _) in enumerate(delayed)} == {25}
    jittered = through(outwards=outwards, jitter_ms=100.0)
    assert {data for _, data in jittered} == {data for _, data in plain}
    late = [step - int.from_bytes(data, "big") for step, data in jittered]
    assert (min(late), max(late)) == (1, 25)
    assert np.mean(late) == pytest.approx(13.0, abs=1.0)
    assert any(b < a for a, b in itertools.pairwise(int.from_bytes(data, "big") for _, data in jittered))
    mixed = [int.from_bytes(data, "big") for _, data in through(outwards=outwards, reorder_01=0.2)]
    assert sorted(mixed) == list(range(1000))
    assert 100 < sum(b < a for a, b in itertools.pairwise(mixed)) < 200
    spoilt = through(outwards=outwards, corrupt_01=0.5)
    wrong = [bin(int.from_bytes(data, "big") ^ k).count("1") for k, (_, data) in enumerate(spoilt)]
    assert set(wrong) == {0, 1}
    assert sum(wrong) == pytest.approx(500, abs=60)


def test_impairments_repeat_with_their_seed() -> None:
    assert through(loss_01=0.5, seed=3) == through(loss_01=0.5, seed=3)
    assert through(loss_01=0.5, seed=3) != through(loss_01=0.5, seed=4)


def test_every_kind_has_a_rule_and_an_effect() -> None:
    from sitl.faults import _BEGIN

    assert set(_BEGIN) == set(FAULTS)


@pytest.fixture
def flown() -> FlownWorld:
    """Two vehicles that loiter; one gets the fault."""
    world = FlownWorld(2, preset="x500", **COARSE)
    world.take_off()
    world.step(2.0)
    return world


def begin(flown: FlownWorld, **fault: Any) -> None:
    flown.world.faults.begin(FaultParams.model_validate({"vehicle": 0, **fault}), flown.world.since_boot_us)


def test_a_weak_motor_tilts_its_vehicle_only_while_it_lasts(flown: FlownWorld) -> None:
    worst = np.zeros(2)

    def watch() -> None:
        nonlocal worst
        worst = np.maximum(worst, flown.tilt_deg)

    begin(flown, kind="motor", value=0.7, for_s=1.0)
    flown.step(1.0, watch)
    assert worst[0] > 5.0
    assert worst[1] < 1.0
    flown.step(8.0)
    assert flown.tilt_deg[0] < 1.5
    assert flown.world.plant.height_m[0] > 0.5


def test_a_dead_motor_brings_a_quadrotor_down(flown: FlownWorld) -> None:
    begin(flown, kind="motor", rotor=2)
    flown.step(4.0)
    assert flown.world.plant.height_m[0] < 0.1
    assert flown.world.plant.height_m[1] > 2.0


def test_the_estimate_jumps_and_the_vehicle_follows_it(flown: FlownWorld) -> None:
    before = flown.pos_ned_m
    begin(flown, kind="estimator_jump", value=1.0, towards_deg=90.0, for_s=8.0)
    believed = flown.world.estimator.of(0, 0).pos_ned_m
    assert believed[1] - flown.pos_ned_m[0, 1] == pytest.approx(1.0)
    flown.step(7.5)
    assert flown.pos_ned_m[0, 1] - before[0, 1] == pytest.approx(-1.0, abs=0.25)  # back to where it believes it was
    assert np.abs(flown.pos_ned_m[1] - before[1]).max() < 0.1
    flown.step(0.6)
    assert flown.world.estimator.of(0, 0).pos_ned_m[1] == pytest.approx(flown.pos_ned_m[0, 1])


def test_a_frozen_estimate_stays_while_its_stamp_goes_on(flown: FlownWorld) -> None:
    begin(flown, kind="estimator_freeze", for_s=0.5)
    begin(flown, kind="gust", value=8.0, for_s=2.0)
    first = flown.world.estimator.of(0, 1)
    flown.step(0.4)
    then = flown.world.estimator.of(0, 2)
    assert (then.pos_ned_m, then.q_nb, then.t_us) == (first.pos_ned_m, first.q_nb, 2)
    assert abs(flown.pos_ned_m[0, 0] - first.pos_ned_m[0]) > 0.01
    flown.step(0.2)
    assert flown.world.estimator.of(0, 3).pos_ned_m != first.pos_ned_m


def test_without_gps_the_position_drifts_and_says_so(flown: FlownWorld) -> None:
    begin(flown, kind="gps_loss", for_s=10.0)
    flown.step(8.0)
    lost, fine = flown.world.estimator.of(0, 0), flown.world.estimator.of(1, 0)
    error_m = np.hypot(*(np.array(lost.pos_ned_m) - flown.pos_ned_m[0])[:2])
    assert error_m == pytest.approx(0.5 * 0.05 * 64, rel=0.05)
    assert lost.pos_accuracy_m[0] == pytest.approx(error_m, rel=0.05)
    assert (lost.gps_ok, fine.gps_ok) == (False, True)
    assert fine.pos_accuracy_m[0] < 0.1
    flown.step(2.5)
    assert flown.world.estimator.of(0, 0).gps_ok
    assert flown.world.estimator.of(0, 0).pos_ned_m == pytest.approx(flown.pos_ned_m[0])


def test_a_gust_pushes_and_passes(flown: FlownWorld) -> None:
    before = flown.pos_ned_m
    begin(flown, kind="gust", value=8.0, towards_deg=180.0, for_s=1.0)
    flown.step(1.0)
    assert flown.pos_ned_m[0, 0] < before[0, 0] - 0.1
    assert abs(flown.pos_ned_m[1, 0] - before[1, 0]) < 0.05
    flown.step(0.1)
    assert flown.world.physics.air.still


def test_a_wind_blows_from_one_instant_to_the_next_and_on_one_vehicle_only(flown: FlownWorld) -> None:
    begin(flown, kind="wind", value=8.0, towards_deg=90.0, for_s=1.0)
    flown.step(0.01)
    air = flown.world.physics.air.velocity_ned_m_s(0.0, np.full(2, 10.0), np.zeros((3, 2)))
    np.testing.assert_allclose(air, [[0.0, 0.0], [8.0, 0.0], [0.0, 0.0]], atol=1e-12)
    flown.step(1.1)
    assert flown.world.physics.air.still


def test_winds_that_begin_at_once_add_up_whatever_another_fault_does(flown: FlownWorld) -> None:
    begin(flown, kind="gps_loss", for_s=9.0)
    begin(flown, kind="wind", value=3.0, for_s=1.0)
    begin(flown, kind="gps_loss")  # in the place of the first one, and to the end
    begin(flown, kind="wind", value=2.0, for_s=1.0)
    air = flown.world.physics.air.velocity_ned_m_s(0.0, np.full(2, 10.0), np.zeros((3, 2)))
    np.testing.assert_allclose(air, [[5.0, 0.0], [0.0, 0.0], [0.0, 0.0]], atol=1e-12)


def test_mass_and_battery(flown: FlownWorld) -> None:
    begin(flown, kind="mass", value=1.3, for_s=8.0)
    begin(flown, kind="battery", value=0.1)
    flown.step(6.0)
    outputs = [pilot.output.thrust_01 for pilot in flown.world.autopilots]
    assert outputs[0] / outputs[1] == pytest.approx(1.3, rel=0.03)
    assert [flown.world.estimator.of(i, 0).battery.charge_01 for i in (0, 1)] == [0.1, 1.0]
    flown.step(8.0)
    assert flown.world.autopilots[0].output.thrust_01 == pytest.approx(0.49, abs=0.01)


def test_a_lost_link_is_silent_and_comes_back(flown: FlownWorld) -> None:
    for vehicle in (0, 1):
        flown.received(vehicle)
    begin(flown, kind="link_loss", direction="from_vehicle", for_s=1.0)
    flown.step(0.9)
    assert not flown.received(0)
    assert flown.received(1)
    flown.step(0.5)
    assert flown.received(0)


def test_a_rebooted_autopilot_is_silent_and_begins_anew(flown: FlownWorld) -> None:
    for vehicle in (0, 1):
        flown.received(vehicle)
    begin(flown, kind="reboot")
    assert [pilot.armed for pilot in flown.world.autopilots] == [False, True]
    flown.step(1.0)
    assert not flown.received(0)
    assert flown.received(1)
    flown.step(1.0)
    stamps_us = [
        int.from_bytes(frame[10:18], "little")
        for frame in flown.received(0)
        if message_id(frame) == mav.MAVLINK_MSG_ID_HIGHRES_IMU
    ]
    assert stamps_us
    assert max(stamps_us) < 2_000_000  # since its boot; the simulation is at 13 s
    assert flown.world.plant.height_m[0] < 0.1  # nobody flew it


def test_a_newer_fault_of_a_kind_replaces_the_older(flown: FlownWorld) -> None:
    begin(flown, kind="motor", value=0.9, for_s=0.1)
    begin(flown, kind="motor", value=0.8, for_s=1.0)
    flown.step(0.5)
    assert flown.world.physics.rotor_health_01[0, 0] == 0.8
    flown.step(0.6)
    assert flown.world.physics.rotor_health_01[0, 0] == 1.0


@pytest.mark.parametrize("long_first", [True, False])
def test_the_end_of_a_loss_in_one_direction_does_not_end_that_in_both(flown: FlownWorld, long_first: bool) -> None:
    """From 0.8 s until 2 s, whichever of the two began first."""
    link = flown.world.links_of(0)[0]

    def losses_01() -> tuple[float, float]:
        return link.to_vehicle.impairments.loss_01, link.from_vehicle.impairments.loss_01

    both, one = {"for_s": 2.0}, {"for_s": 0.8, "value": 0.5, "direction": "to_vehicle"}
    for fault in (both, one) if long_first else (one, both):
        begin(flown, kind="link_loss", **fault)
    flown.step(0.5)
    assert losses_01() == ((0.5, 1.0) if long_first else (1.0, 1.0)), "the newer one acts"
    flown.step(0.5)
    assert losses_01() == (1.0, 1.0)
    flown.step(1.1)
    assert losses_01() == (0.0, 0.0)


def test_scheduled_faults_happen_at_their_time_and_are_logged() -> None:
    faults = [
        {"kind": "motor", "at_s": 0.5, "value": 0.5, "for_s": 0.25},
        {"kind": "link_delay", "at_s": 0.2, "vehicle": 1, "value": 50.0},
    ]
    flown = FlownWorld(2, realism={"faults": faults})
    told: list[tuple[str, float, Any, Any]] = []
    flown.world.faults.on_event = lambda name, t_us, f: told.append((name, t_us / 1e6, f["kind"], f["vehicle"]))
    flown.step(1.0)
    assert told == [
        ("fault_began", 0.2, "link_delay", 1),
        ("fault_began", 0.5, "motor", 0),
        ("fault_began", 0.5, "motor", 1),
        ("fault_ended", 0.752, "motor", 0),
        ("fault_ended", 0.752, "motor", 1),
    ]


@pytest.mark.parametrize(
    ("wanted", "complaints"),
    [
        (
            {"kind": "meteor", "vehicle": 9},
            ["KIND = 'meteor': input should be 'gps_loss', ", "--vehicle = 9: allowed: 0 to 2"],
        ),
        ({"kind": "motor", "value": 7.0, "vehicle": 3}, ["--vehicle = 3", "--value = 7.0: allowed for motor: 0 to 1"]),
        ({"kind": "motor", "value": 7.0, "for_s": -1.0}, ["--for = -1.0", "--value = 7.0"]),
        ({"kind": "motor", "rotor": 4}, ["--rotor = 4"]),
        ({"kind": "gust", "value": 3.0}, ["--for = 0.0: gust has to end"]),
        ({"kind": "gust", "for_s": 2.0}, ["--value: missing; gust takes -40 to 40"]),
        ({"kind": "battery", "value": 0.5, "for_s": 2.0}, ["--for = 2.0: battery happens at once"]),
        ({"kind": "link_loss", "direction": "up"}, ["--direction = 'up'"]),
        ({"kind": "gps_loss", "value": float("nan")}, ["--value = nan"]),
    ],
)
def test_wrong_faults_are_refused_with_all_problems(wanted: dict[str, Any], complaints: list[str]) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_fault(wanted, 3)
    assert refused.value.exit_code == 2
    for complaint in complaints:
        assert complaint in str(refused.value)


def launch_at(folder: Path) -> RunningLaunch:
    return RunningLaunch("circle-1", f"unixsock-stream/{folder}/bus.sock", 1, 0.0, 3, f"{folder}")


def test_a_run_with_real_vehicles_takes_no_faults(tmp_path: Path) -> None:
    shutil.copy(Path(__file__).parents[3] / "configs" / "px4_udp.toml", tmp_path / "config.toml")
    with pytest.raises(ConfigError, match="never for real ones") as refused:
        inject(launch_at(tmp_path), FaultParams(kind="gps_loss"))
    assert refused.value.exit_code == 2


def test_a_simulator_that_is_gone_is_said(tmp_path: Path) -> None:
    (tmp_path / "sitl.sock").touch()
    with pytest.raises(StartError, match="does not answer"):
        inject(launch_at(tmp_path), FaultParams(kind="gps_loss"))


def test_a_running_simulator_takes_a_fault_and_answers(tmp_path: Path) -> None:
    flown = FlownWorld(2)
    flown.step(0.1)
    control = ControlSocket(tmp_path / "sitl.sock")
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            control.poll(flown.world)
            time.sleep(0.005)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        fault = FaultParams(kind="motor", vehicle=1, value=0.25, for_s=2.0)
        began_s = inject(launch_at(tmp_path), fault)
        assert began_s == pytest.approx(0.1, abs=0.01)
        assert line_of(fault, began_s) == "motor on vehicle 1 for 2 s, 0.1 s after the simulator's start"
        told = json.loads(as_json("circle-1", fault, began_s))
        assert (told["run"], told["kind"], told["vehicle"], told["since_boot_s"]) == ("circle-1", "motor", 1, began_s)
        assert flown.world.physics.rotor_health_01[:, 1].tolist() == [0.25, 1, 1, 1]
        assert flown.world.physics.rotor_health_01[:, 0].tolist() == [1, 1, 1, 1]
        with pytest.raises(ConfigError, match="vehicle = 2: allowed: 0 to 1"):
            inject(launch_at(tmp_path), FaultParams(kind="gps_loss", vehicle=2))
    finally:
        done.set()
        thread.join()
        control.close()
    assert not (tmp_path / "sitl.sock").exists()


def test_vehicles_of_one_host_have_the_numbers_of_the_swarm_in_faults() -> None:
    """On the control socket as in the configuration: two vehicles from number 2 on are 2 and 3."""
    scheduled = {"kind": "motor", "vehicle": 3, "value": 0.5}
    flown = FlownWorld(2, first_vehicle=2, sysid_base=3, faults=[scheduled])
    flown.step(0.1)
    request = {"kind": "motor", "vehicle": 2, "value": 0.25}
    assert handle(json.dumps({"fault": request}).encode(), flown.world)["ok"]
    assert flown.world.physics.rotor_health_01[0].tolist() == [0.25, 0.5]
    refused = handle(json.dumps({"fault": {**request, "vehicle": 0}}).encode(), flown.world)
    assert refused["problems"] == ["vehicle = 0: allowed: 2 to 3, or -1 for all"]


@pytest.mark.parametrize(
    "request_", [b"", b"[]", b"{}", b"\xff", b'{"fault": 3}', b'{"fault": {"kind": "x"}}', b"[" * 5000]
)
def test_junk_on_the_control_socket_is_refused(request_: bytes) -> None:
    answer = handle(request_, FlownWorld(1).world)
    assert not answer["ok"]
    assert answer["problems"]
    json.dumps(answer)


def test_a_taken_control_path_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "sitl.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(str(path))
        with pytest.raises(ConfigError, match="control = "):
            ControlSocket(path)


@pytest.mark.parametrize("of_launch", [True, False])
def test_the_last_to_end_takes_a_launch_folder_away_and_no_other(tmp_path: Path, of_launch: bool) -> None:
    """A router that ends before the simulator finds the folder in use; a folder of the user's stays."""
    folder = tmp_path / "swarm-1"
    folder.mkdir()
    (folder / "bus.sock").touch()
    control = ControlSocket(folder / "sitl.sock", of_launch)
    remove_socket(folder / "bus.sock")
    assert folder.exists()
    control.close()
    assert folder.exists() is not of_launch
