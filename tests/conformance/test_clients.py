"""Clients that share no code with this project fly the simulator: mavsdk-grpc, MAVProxy, and libmav's own codec."""

from __future__ import annotations

import asyncio
import math
import queue
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import libmav
import pymavlink.dialects.v20 as dialects
import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.studies.bench.free_ports import free_ports
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import message_id
from swarmctl.process_priority import request_realtime
from tests.conformance import vocabulary as v
from tests.conformance.dialogue import Dialogue
from tests.conformance.partners import InProcess
from tests.conformance.player import Player
from tests.conformance.rows_missions import AROUND, download, upload
from tests.conformance.simulator_process import simulator, wait_for

DEFINITIONS = str(Path(dialects.__file__).with_name("development.xml"))
TAKEOFF_ALTITUDE_M = 1.5


# --- mavsdk-grpc ---


@pytest.mark.process
def test_mavsdk_grpc_walk() -> None:
    with simulator() as port:
        asyncio.run(asyncio.wait_for(fly_with_grpc(port), 40.0))


async def fly_with_grpc(port: int) -> None:
    from mavsdk_grpc import System  # starts a server process of its own

    vehicle = System(port=free_ports(1)[0])
    try:
        await vehicle.connect(system_address=f"udpin://127.0.0.1:{port}")
        async for state in vehicle.core.connection_state():
            if state.is_connected:
                break
        async for healthy in vehicle.telemetry.health_all_ok():
            if healthy:
                break
        await vehicle.param.set_param_int("COM_OBL_RC_ACT", 4)
        assert await vehicle.param.get_param_int("COM_OBL_RC_ACT") == 4
        await vehicle.action.set_takeoff_altitude(TAKEOFF_ALTITUDE_M)
        await vehicle.action.arm()
        await vehicle.action.takeoff()
        async for position in vehicle.telemetry.position():
            if position.relative_altitude_m > TAKEOFF_ALTITUDE_M - 0.3:
                break
        north_deg = position.latitude_deg + 5.0 / 111_200
        await vehicle.action.goto_location(north_deg, position.longitude_deg, position.absolute_altitude_m, 0.0)
        async for position in vehicle.telemetry.position():
            if abs(position.latitude_deg - north_deg) < 1.0 / 111_200:
                break
        await vehicle.action.land()
        async for armed in vehicle.telemetry.armed():
            if not armed:
                break
        async for in_air in vehicle.telemetry.in_air():
            assert not in_air
            break
    finally:
        vehicle._stop_mavsdk_server()


# --- MAVProxy ---


class Console:
    """MAVProxy with piped input and output, as somebody without a terminal uses it."""

    def __init__(self, port: int, folder: Path) -> None:
        self._process = subprocess.Popen(
            [
                *(sys.executable, "-u", "-m", "MAVProxy.mavproxy", f"--master=udpin:127.0.0.1:{port}", "--mav20"),
                *("--default-modules=param,cmdlong,arm,mode", f"--state-basedir={folder}", "--target-system=1"),
            ],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        request_realtime(self._process.pid)  # a client without processor loses datagrams
        self._lines: queue.Queue[str] = queue.Queue()
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)

    def type(self, command: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def prints(self, text: str, timeout_s: float) -> bool:
        """Whether a new line contains the text by then."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.01, deadline_s - time.monotonic()))
            except queue.Empty:
                return False
            self.said.append(line)
            if text in line:
                return True

    def wait_for(self, *texts: str, timeout_s: float = 20.0) -> None:
        """Until new lines have contained every text, in any order: texts and the 1 Hz HEARTBEAT overtake each other."""
        missing, since = set(texts), len(self.said)
        while missing:
            found = self.prints("", timeout_s)
            missing -= {text for text in missing if any(text in line for line in self.said[since:])}
            assert found or not missing, f"MAVProxy did not print {missing}; it printed {''.join(self.said)}"

    def ask_until(self, command: str, text: str) -> None:
        for _ in range(10):
            self.type(command)
            if self.prints(text, 0.5):
                return
        pytest.fail(f"{command}: MAVProxy did not print {text!r}; it printed {''.join(self.said)}")

    def close(self) -> None:
        self._process.kill()
        self._process.wait(timeout=5.0)
        self._reader.join(timeout=5.0)


@contextmanager
def console(port: int, folder: Path) -> Iterator[Console]:
    opened = Console(port, folder)
    try:
        yield opened
    finally:
        opened.close()


@pytest.mark.process
def test_mavproxy_walk(tmp_path: Path) -> None:
    """`mode` is broken for PX4, and `takeoff` asks for a height over the sea: DO_SET_MODE by hand works."""
    # In Python it needs a fifth of a processor for what an autopilot sends: four times as much makes it lose messages.
    with simulator(speed=1) as port, console(port, tmp_path) as proxy:
        proxy.wait_for("Detected vehicle 1:1")
        proxy.wait_for("Received ")
        proxy.type("module list quiet")
        proxy.type("param show MIS_TAKEOFF_ALT")
        proxy.wait_for("MIS_TAKEOFF_ALT  2.5")
        proxy.type("param set MIS_TAKEOFF_ALT 2.2")
        proxy.ask_until("param fetch MIS_TAKEOFF_ALT", "MIS_TAKEOFF_ALT = 2.2")  # it sets when it finds time
        proxy.type("arm throttle")
        proxy.wait_for("COMPONENT_ARM_DISARM: ACCEPTED")
        proxy.wait_for("Armed by external command")
        proxy.type("long DO_SET_MODE 1 4 2 0 0 0 0")
        proxy.wait_for("Mode TAKEOFF", "Takeoff detected", "Mode LOITER")
        proxy.type("disarm")
        proxy.wait_for("COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED")
        proxy.wait_for("Disarming denied: not landed")
        proxy.type("long DO_SET_MODE 1 4 5 0 0 0 0")
        proxy.wait_for("DO_SET_MODE: ACCEPTED")
        proxy.wait_for("RTL: land at destination")
        proxy.wait_for("Disarmed by landing")


# --- libmav ---


class LibMav:
    """libmav as a ground station on a UDP port, with everything it has decoded."""

    def __init__(self, port: int) -> None:
        self.messages = libmav.MessageSet(DEFINITIONS)
        self.decoded: dict[tuple[int, int], dict[str, Any]] = {}  # by message id and sequence number
        self._interface = libmav.UDPServer(port)
        beat = self.build("HEARTBEAT", type=6, autopilot=8, system_status=4, mavlink_version=3)
        self._runtime = libmav.NetworkRuntime(libmav.Identifier(255, 190), self.messages, beat, self._interface)
        self.connection: Any = None

    def build(self, name: str, **fields: Any) -> Any:
        """A message with the fields given, all others 0 or empty."""
        message = self.messages.create(name)
        cls = mav.mavlink_map[message.id]
        lengths = {n: cls.array_lengths[cls.orders[i]] for i, n in enumerate(cls.fieldnames)}
        texts = {n for n, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True) if kind == "char"}
        empty = {n: "" if n in texts else [0] * length if length else 0 for n, length in lengths.items()}
        return message.set_from_dict(empty | fields)

    def connect(self, timeout_s: float = 10.0) -> None:
        """Wait for a heartbeat."""
        self.connection = self._runtime.await_connection(round(timeout_s * 1e3))
        self.connection.add_message_callback(self._keep)

    def _keep(self, message: Any) -> None:
        self.decoded[message.id, message.header.seq] = message.to_dict()

    def ask(self, request: Any, answer: str, timeout_s: float = 1.0) -> dict[str, Any]:
        """Send, and wait for the next message of a kind."""
        expected = self.connection.expect(answer)
        self.connection.send(request)
        fields: dict[str, Any] = self.connection.receive(expected, round(timeout_s * 1e3)).to_dict()
        return fields

    def command(self, number: int, *params: float) -> int:
        """Send a command; its result."""
        named = {f"param{i + 1}": float(value) for i, value in enumerate(params)}
        long = self.build("COMMAND_LONG", target_system=1, target_component=1, command=number, **named)
        ack = self.ask(long, "COMMAND_ACK")
        assert ack["command"] == number
        return int(ack["result"])

    def close(self) -> None:
        """When nobody sends any more: it waits, with the interpreter locked, for a thread that delivers messages."""
        time.sleep(0.2)
        self._runtime.stop()
        self._interface.close()


@contextmanager
def lib_mav(port: int) -> Iterator[LibMav]:
    client = LibMav(port)
    try:
        yield client
    finally:
        client.close()


def everything_said() -> dict[int, bytes]:
    """One frame of every message id the simulator sends in a dialogue that asks for all it has."""
    partner = InProcess()
    dialogue = Dialogue(partner)
    player = Player(dialogue)
    row = v.Row(
        name="everything",
        section="",
        start=v.State.LOITER,
        steps=(
            *upload(AROUND),
            *download(AROUND),
            v.Command(number=v.ARM_DISARM, params=(5.0,), ack=v.NO_ACK),
            v.Send(what=v.message("PARAM_REQUEST_READ", target_system=v.OWN, target_component=1, param_id="NO_SUCH")),
            v.Send(what=v.message("PING", time_usec=7, seq=9)),
            *(v.Command(number=v.REQUEST_MESSAGE, params=(number,)) for number in (49, 148, 242, 31, 85)),
            v.go(4, 4),
            v.sees("MISSION_ITEM_REACHED", 20.0),
        ),
    )
    player.play(row)
    newest = {a.number: a for came in dialogue.by_kind().values() for a in came}
    return {number: arrived.frame for number, arrived in newest.items() if number in mav.mavlink_map}


def same(ours: Any, theirs: Any) -> bool:
    """Equal to the last bit, NaN included."""
    if isinstance(ours, list):
        return all(same(a, b) for a, b in zip(ours, theirs, strict=True))
    if isinstance(ours, float):
        return struct.pack("<f", ours) == struct.pack("<f", theirs) or (math.isnan(ours) and math.isnan(theirs))
    return bool(ours == theirs)


def differences(message: Any, theirs: dict[str, Any]) -> list[str]:
    """Fields libmav reads otherwise than our codec."""
    ours = {name: getattr(message, name) for name in message.fieldnames}
    assert set(ours) == {name for name in theirs if not name.startswith("_")}
    return [f"{name}: {ours[name]!r} {theirs[name]!r}" for name in ours if not same(ours[name], theirs[name])]


def test_libmav_reads_every_message_as_we_do() -> None:
    frames = everything_said()
    assert len(frames) > 30
    codec, port = Codec(255, 1), free_ports(1)[0]
    with lib_mav(port) as client, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(frames[mav.MAVLINK_MSG_ID_HEARTBEAT], ("127.0.0.1", port))
        client.connect()
        for frame in frames.values():
            sender.sendto(frame, ("127.0.0.1", port))
        wait_for(lambda: len({number for number, _ in client.decoded}) == len(frames), 2.0, "everything decoded")
    wrong = {}
    for number, frame in frames.items():
        message = codec.decode(frame)
        assert message is not None
        assert message_id(frame) == number
        found = differences(message, client.decoded[number, frame[4]])
        if found:
            wrong[message.get_type()] = found
    assert wrong == {}
    altered = dict(client.decoded[mav.MAVLINK_MSG_ID_ODOMETRY, frames[mav.MAVLINK_MSG_ID_ODOMETRY][4]])
    altered["x"] += 1e-3
    assert differences(codec.decode(frames[mav.MAVLINK_MSG_ID_ODOMETRY]), altered), "control: a difference is seen"


@pytest.mark.process
def test_libmav_flies() -> None:
    port = free_ports(1)[0]
    with lib_mav(port) as client, simulator(port=port):  # who sends ends first
        client.connect()
        wait_for(lambda: any(number == mav.MAVLINK_MSG_ID_ODOMETRY for number, _ in client.decoded), 3.0, "a position")
        asked = client.build("PARAM_REQUEST_READ", target_system=1, target_component=1, param_id="MAV_SYS_ID")
        asked["param_index"] = -1
        value = client.ask(asked, "PARAM_VALUE")
        assert (value["param_id"], struct.pack("<f", value["param_value"])) == ("MAV_SYS_ID", struct.pack("<i", 1))
        assert client.command(31999) == v.UNSUPPORTED
        wait_for(lambda: client.command(v.ARM_DISARM, 1.0) == v.ACCEPTED, 3.0, "armed")
        level = client.build("SET_ATTITUDE_TARGET", target_system=1, target_component=1, type_mask=7, thrust=0.7)
        level["q"] = [1.0, 0.0, 0.0, 0.0]
        client.connection.send(level)
        assert client.command(v.SET_MODE, 1.0, 6.0) == v.ACCEPTED
        deadline_s = time.monotonic() + 3.0
        height_m = 0.0
        while height_m < 1.0 and time.monotonic() < deadline_s:
            client.connection.send(level)
            height_m = -client.connection.receive("LOCAL_POSITION_NED", 500).to_dict()["z"]
        assert height_m >= 1.0
        assert client.command(v.SET_MODE, 1.0, 4.0, 6.0) == v.ACCEPTED
