"""`swarmctl check` against real simulator processes over UDP: what it finds, what it sets, what it leaves alone."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from pymavlink.dialects.v20 import development as mavlink

from sitl.studies.bench.free_ports import free_ports
from swarmctl.config import load
from swarmctl.errors import StartError
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.signing.key_file import write_new_key
from swarmctl.ops.vehicles.key_install import install
from swarmctl.ops.vehicles.vehicle_check import CheckOptions, check

pytestmark = pytest.mark.process

ROOT = Path(__file__).resolve().parents[2]
ENV = {**os.environ, "PYTHONPATH": str(ROOT)}
QUICK_S = 1.0


class Simulator:
    """`python -m sitl`, and where its vehicles send to."""

    def __init__(self, vehicles: int, autopilot: str = "px4") -> None:
        self.ports = free_ports(vehicles)
        arguments = ["--vehicles", f"{vehicles}", "--remote-ports", ",".join(map(str, self.ports))]
        arguments += [
            "--ekf-ready-s",
            "0.2",
            "--physics-hz",  # what is asked on the ground does not depend on it
            "100",
            "--local-port",
            f"{free_ports(1)[0]}",
            "--die-with-parent",
            "--autopilot-kind",
            autopilot,
        ]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sitl", *arguments], cwd=ROOT, env=ENV, stdout=subprocess.PIPE, text=True
        )

    def wait_until_up(self) -> None:
        assert self.process.stdout is not None
        lines = iter(self.process.stdout.readline, "")
        for _ in self.ports:  # before them it may say that it has found other ports of its own, the second being taken
            assert any("sysid=" in line for line in lines), "it has ended"

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.communicate(timeout=10)
        finally:
            self.process.kill()


@pytest.fixture(scope="module")
def simulators() -> Iterator[tuple[Simulator, Simulator]]:
    """One of two vehicles, and one of one vehicle that has the first one's system id."""
    begun = Simulator(2), Simulator(1)
    try:
        for simulator in begun:
            simulator.wait_until_up()
        yield begun
    finally:
        for simulator in begun:
            simulator.stop()


@pytest.fixture
def copter() -> Iterator[Simulator]:
    simulator = Simulator(1, "arducopter")
    try:
        simulator.wait_until_up()
        yield simulator
    finally:
        simulator.stop()


Simulators = tuple[Simulator, Simulator]
Check = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture
def run_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Check:
    """Check vehicles (system id, port) as configured; exit code, JSON and what was printed."""

    def run(
        *vehicles: tuple[int, int], apply: bool = False, more: str = "", to_fly: bool = False
    ) -> tuple[int, dict[str, Any], str]:
        text = f"[swarm]\nagents={len(vehicles)}\n[start]\ncenter_ned_m=[0.0,0.0,-2.0]\n[sitl]\nenabled=false\n"
        text += "".join(f'[[vehicles]]\nsysid={sysid}\nurl="udpin://127.0.0.1:{port}"\n' for sysid, port in vehicles)
        path = tmp_path / "check.toml"
        path.write_text(text + more)
        code = check(
            load(path),
            CheckOptions(apply=apply, seconds=QUICK_S, json=tmp_path / "check.json", connect_s=1.5, to_fly=to_fly),
        )
        return code, json.loads((tmp_path / "check.json").read_text()), capsys.readouterr().out

    return run


def verdict(found: dict[str, Any], topic: str, agent: int = 0) -> str:
    [line] = [line for line in found["findings"] if line["topic"] == topic and line["agent"] == agent]
    return str(line["verdict"])


class Pilot:
    """Somebody else on the vehicle's link, before or after a check."""

    def __init__(self, port: int) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", port))
        self._sock.settimeout(2.0)
        self._codec = Codec(1, 190)
        _, self._vehicle = self._sock.recvfrom(2048)

    def __enter__(self) -> Pilot:
        return self

    def __exit__(self, *_: object) -> None:
        self._sock.close()

    def ask(self, message: Any, answer: str) -> Any:
        """Send until a message of the kind `answer` comes."""
        deadline_s = time.monotonic() + 3.0
        while time.monotonic() < deadline_s:
            self._sock.sendto(self._codec.encode(message), self._vehicle)
            tried_s = time.monotonic() + 0.3
            while time.monotonic() < tried_s:
                for frame in frames(self._sock.recv(2048)):
                    heard = self._codec.decode(frame)
                    if heard is not None and heard.get_type() == answer:
                        return heard
        raise AssertionError(f"no {answer}")

    def arm(self, armed: bool) -> int:
        params = (1.0 if armed else 0.0, *[0.0] * 6)
        return int(self.ask(mavlink.MAVLink_command_long_message(1, 1, 400, 0, *params), "COMMAND_ACK").result)

    def parameter(self, name: str) -> bytes:
        asked = mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1)
        return bytes(self.ask(asked, "PARAM_VALUE").get_msgbuf())

    def armed(self) -> bool:
        beat = self.ask(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), "HEARTBEAT")
        return bool(beat.base_mode & 128)


def test_a_wrong_parameter_is_found_applied_and_then_nothing_is_left(simulators: Simulators, run_check: Check) -> None:
    vehicles = list(enumerate(simulators[0].ports, 1))
    code, found, printed = run_check(*vehicles)
    assert code == 0
    assert verdict(found, "COM_OBL_RC_ACT") == verdict(found, "COM_OBL_RC_ACT", 1) == "NOTE"
    assert "note agent-0, agent-1 COM_OBL_RC_ACT: 0" in printed, "agents set it for their flight"
    facts = found["vehicles"][0]
    assert (facts["autopilot"], facts["sysid"], facts["mode"], facts["landed"]) == ("PX4", 1, "HOLD", "ON_GROUND")
    assert facts["link"]["round_trip"]["answers"] > 10
    assert facts["link"]["lost_01"] < 0.01
    assert facts["origin_told"] and facts["pos_ned_m"] is not None
    assert found["changes"] == []

    code, found, printed = run_check(*vehicles, apply=True)
    assert code == 0
    changes = [(c["name"], c["before"], c["after"], c["done"]) for c in found["changes"]]
    assert sorted(changes) == [("COM_OBL_RC_ACT", 0, 4, True)] * 2 + [("COM_OF_LOSS_T", 1, 0.5, True)] * 2
    assert "agent-1 COM_OBL_RC_ACT: 0 -> 4" in printed

    code, found, printed = run_check(*vehicles)  # by another process of the same vehicles: it has stayed
    assert code == 0
    assert {line["verdict"] for line in found["findings"]} <= {"OK", "NOTE"}
    assert "2 of 2 vehicles reached, nothing to fix" in printed


FENCE = "[geofence]\ncorners_ne_m=[[20.0,20.0],[20.0,-20.0],[-20.0,-20.0],[-20.0,20.0]]\n"


def test_a_geofence_is_uploaded_only_on_request_and_read_back(copter: Simulator, run_check: Check) -> None:
    own = Simulator(1)  # it stays with the vehicle
    try:
        own.wait_until_up()
        vehicle = (1, own.ports[0])
        code, found, printed = run_check(vehicle, more=FENCE)
        assert (code, verdict(found, "geofence")) == (4, "FIX")
        assert "geofence: 0 corners. --apply uploads it" in printed
        code, found, printed = run_check(vehicle, more=FENCE, apply=True)
        assert (code, verdict(found, "geofence")) == (0, "OK")
        code, found, printed = run_check(vehicle, more=FENCE)  # without --apply nothing could have been mended
        assert (code, verdict(found, "geofence")) == (0, "OK")
        code, found, printed = run_check(vehicle, more=FENCE.replace("[[20.0", "[[21.0"))
        assert (code, verdict(found, "geofence")) == (4, "FIX")
        assert "4 corners, not the same" in printed
        _, found, _ = run_check(vehicle)
        assert not any(line["topic"] in ("geofence", "GF_ACTION") for line in found["findings"]), "off by default"
    finally:
        own.stop()
    _, found, _ = run_check((1, copter.ports[0]), more=FENCE, apply=True)
    assert verdict(found, "geofence") == "NOTE", "it is PX4's"


def test_the_simulator_tells_no_arming_checks_and_nobody_waits_for_them(
    simulators: Simulators, run_check: Check
) -> None:
    begun_s = time.monotonic()
    _, found, _ = run_check((1, simulators[0].ports[0]))
    assert time.monotonic() - begun_s < 5.0
    [line] = [line for line in found["findings"] if line["topic"] == "arming checks"]
    assert (line["verdict"], line["found"]) == ("OK", "not told by this autopilot; see sensors")


def test_an_arducopter_is_asked_and_set_in_its_own_encoding(copter: Simulator, run_check: Check) -> None:
    wanted = "[agent.autopilot_params]\nGUID_OPTIONS=8\nFS_GCS_ENABLE=5\nFS_GCS_TIMEOUT=2.0\nATC_ANGLE_BOOST=0\n"
    code, found, printed = run_check((1, copter.ports[0]), apply=True, more=wanted)
    assert code == 0, printed
    assert found["vehicles"][0]["autopilot"] == "ArduCopter"
    assert ("GUID_OPTIONS", 0, 8, True) in [(c["name"], c["before"], c["after"], c["done"]) for c in found["changes"]]
    assert all(c["done"] for c in found["changes"])
    assert verdict(found, "origin") == verdict(found, "sensors") == "OK"


def test_a_missing_vehicle_and_one_with_anothers_id(simulators: Simulators, run_check: Check) -> None:
    pair, single = simulators
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        vehicles = (
            (1, pair.ports[0]),
            (2, single.ports[0]),
            (3, free_ports(1)[0]),
            (4, int(taken.getsockname()[1])),
        )
        code, found, printed = run_check(*vehicles, apply=True)
    assert code == 3
    assert [bool(v["unreachable"]) for v in found["vehicles"]] == [False, False, True, True]
    assert "can't be bound" in found["vehicles"][3]["unreachable"]
    assert verdict(found, "system id") == "OK"
    assert verdict(found, "system id", 1) == verdict(found, "system ids", -1) == "FIX"
    assert "2 of 4 vehicles reached" in printed
    assert {c["done"] for c in found["changes"] if c["agent"] == 1} == {False}  # not the vehicle that was meant
    assert "it is vehicle 1, not 2" in printed


def on_two_hosts(folder: Path, port: int, *, more: str = "") -> Path:
    """Write a swarm of which alpha reaches a vehicle with id 2, and bravo at the same place one with id 1."""
    path = folder / "two.toml"
    text = '[sitl]\nenabled=false\n[swarm]\nagents=2\n[bus]\nidentities="ids"\n'
    text += "[start]\npositions_ned_m=[[0,-3,-2],[0,0,-2]]\n"
    for sysid in (2, 1):
        text += f'[[vehicles]]\nsysid={sysid}\nurl="udpin://127.0.0.1:{port}"\n'
    for number, name in enumerate(("alpha", "bravo")):
        text += f'[[hosts]]\nname="{name}"\naddress="10.20.0.{number + 1}:7448"\nagents=[{number}]\n'
    path.write_text(text + more)
    return path


def on_command_line(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "swarmctl", "check", *map(str, arguments), "--seconds=1"]
    return subprocess.run(command, cwd=ROOT, env=ENV, capture_output=True, text=True, timeout=60)


def test_a_host_checks_its_own_vehicles_and_needs_their_keys_alone(simulators: Simulators, tmp_path: Path) -> None:
    """The link was opened as agent-0's, too, who was told to change the id of agent-1's vehicle."""
    path, result = on_two_hosts(tmp_path, simulators[1].ports[0]), tmp_path / "check.json"
    said = on_command_line(path, "--host", "bravo", "--json", result)
    found = json.loads(result.read_text())
    assert [(v["agent"], v["unreachable"]) for v in found["vehicles"]] == [(1, "")], said.stderr
    assert verdict(found, "system id", 1) == "OK"
    assert "agent-0" not in said.stdout

    write_new_key(tmp_path / "1.key")
    path = on_two_hosts(tmp_path, simulators[1].ports[0], more='[mavlink]\nsigning_keys=["0.key","1.key"]\n')
    said = on_command_line(path, "--host", "bravo")
    assert "0.key" not in said.stderr and "1 vehicles reached" in said.stdout, said.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "vehicles.0 and vehicles.1 are at udpin://127.0.0.1:1 of two computers: name the one that this is"),
        (("--host", "charlie"), "no such computer in [[hosts]]; there are: alpha, bravo"),
        (("--host", "bravo", "--identify"), "--identify flies all vehicles"),
    ],
)
def test_which_host_is_meant_has_to_be_said(tmp_path: Path, options: tuple[str, ...], words: str) -> None:
    said = on_command_line(on_two_hosts(tmp_path, 1), *options)
    assert (said.returncode, said.stdout) == (2, "")
    assert words in said.stderr


def test_an_armed_vehicle_is_reported_and_left_alone(simulators: Simulators, run_check: Check) -> None:
    port = simulators[1].ports[0]
    with Pilot(port) as pilot:
        before = pilot.parameter("COM_OBL_RC_ACT")
        assert pilot.arm(True) == 0
    code, found, printed = run_check((1, port), apply=True)
    assert code == 4
    assert found["vehicles"][0]["armed"] is True
    assert verdict(found, "state") == "NOTE"
    assert {(c["done"], c["refused"]) for c in found["changes"]} == {(False, "it is armed")}
    assert "not changed to 4 (it is armed)" in printed
    assert not any(line["topic"] == "to fly" for line in found["findings"])
    _, found, _ = run_check((1, port), to_fly=True)
    assert verdict(found, "to fly") == "FIX"
    with Pilot(port) as pilot:
        assert pilot.armed()
        assert pilot.parameter("COM_OBL_RC_ACT")[10:-2] == before[10:-2]
        assert pilot.arm(False) == 0


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder in which a socket's path is short enough, whatever the test is called."""
    with tempfile.TemporaryDirectory(prefix="sw") as folder:
        yield Path(folder)


def test_without_a_configuration_the_built_in_simulator_is_checked_and_ended(short_path: Path) -> None:
    command = [sys.executable, "-m", "swarmctl", "check", "--agents", "2", f"--seconds={QUICK_S}"]
    command += ["--json", str(short_path / "check.json")]
    env = {**ENV, "TMPDIR": str(short_path)}
    done = subprocess.run(command, cwd=short_path, env=env, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 of 2 vehicles reached, nothing to fix" in done.stdout
    assert [path.name for path in short_path.iterdir()] == ["check.json"]
    assert left_of(short_path) == []

    for signum in (signal.SIGTERM, signal.SIGHUP):  # a terminal that is closed says so more than once
        begun = subprocess.Popen([*command, "--seconds=60"], cwd=short_path, env=env, stdout=subprocess.DEVNULL)
        deadline_s = time.monotonic() + 20.0
        while not left_of(short_path, "sitl") and time.monotonic() < deadline_s:
            time.sleep(0.05)
        begun.send_signal(signum)
        time.sleep(0.02)
        begun.send_signal(signum)
        assert begun.wait(timeout=10) == 130
        assert [path.name for path in short_path.iterdir()] == ["check.json"]
        assert left_of(short_path) == []


def left_of(folder: Path, name: str = "") -> list[str]:
    """Command lines of processes that were told of a folder."""
    lines = [" ".join(p.info["cmdline"] or ()) for p in psutil.process_iter(["cmdline"])]
    return [line for line in lines if str(folder) in line and name in line]


def test_a_json_file_that_can_not_be_written_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    url = f"udpin://127.0.0.1:{free_ports(1)[0]}"
    path.write_text(f'[swarm]\nagents=1\n[sitl]\nenabled=false\n[[vehicles]]\nsysid=1\nurl="{url}"\n')
    with pytest.raises(StartError, match="is no folder"):  # before any vehicle is asked
        check(load(path), CheckOptions(json=tmp_path / "nowhere" / "check.json", connect_s=1e6))
    with pytest.raises(StartError, match="can't be written"):
        check(load(path), CheckOptions(json=tmp_path, connect_s=1e6))  # likewise


def test_a_vehicle_is_given_a_key_and_from_then_on_checked_and_set_over_signed_frames_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """MAVSDK, which can't sign, sets the parameters: its frames are signed on the way, and the answers verified."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    write_new_key(tmp_path / "0.key")
    simulator = Simulator(1)
    try:
        simulator.wait_until_up()
        path = tmp_path / "swarm.toml"
        path.write_text(
            '[sitl]\nenabled = false\n[mavlink]\nsigning_keys = ["0.key"]\n[swarm]\nagents = 1\n'
            f'[[vehicles]]\nsysid = 1\nurl = "udpin://127.0.0.1:{simulator.ports[0]}"\n'
        )
        config = load(path)
        assert check(config, CheckOptions(seconds=QUICK_S, connect_s=2.0)) == 3, "it does not sign yet"
        assert "frames are refused" in capsys.readouterr().out
        assert install(config, ()) == 0
        check(config, CheckOptions(apply=True, seconds=QUICK_S, connect_s=10.0))
        said = capsys.readouterr().out
        assert "COM_OF_LOSS_T: 1 -> 0.5" in said
        assert re.search(r"agent-0\s+signing\s+signed\s", said)
        check(load(path, ["mavlink.signing_keys=[]"]), CheckOptions(seconds=QUICK_S, connect_s=2.0))
        assert "it answers neither TIMESYNC nor PING" in capsys.readouterr().out, "without the key it takes nothing"
    finally:
        simulator.stop()
