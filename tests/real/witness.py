"""A witness of the truth: true positions from the autopilots' own simulators, and whether a vehicle is armed.

It listens on other links than the bridge: PX4 sends its simulator's state to a display, and heartbeats to a ground
station; ArduCopter has a second serial port on TCP. It is also the ground station of a test's pilot.
"""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pymap3d
from numpy.typing import NDArray
from pymavlink.dialects.v20 import development as mav

from swarmctl.core.types import GeoOrigin
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import cut_frames, frames, message_id
from swarmctl.process_priority import request_realtime_for_this_thread
from tests.real.autopilots import ARDUCOPTER, Fleet

ARMED_FLAG = 128
TRUTH_MESSAGES = {mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, mav.MAVLINK_MSG_ID_SIM_STATE}
HOST = "127.0.0.1"
MAX_DATAGRAM = 4096
CONNECT_S = 0.2
PAUSE_S = 0.004
ASK_EVERY_S = 2.0
# ArduCopter sends nothing unasked [us].
ASKED_US = {
    mav.MAVLINK_MSG_ID_SIM_STATE: 40_000,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 1_000_000,
}
GRID_S = 0.04
_TRIES, _ANSWER_S = 20, 1.0  # a PX4 that boots answers nothing yet
_FEED_PRIORITY = 12  # above launched agents, at 10: a late position is a wrong one


@dataclass(frozen=True, slots=True)
class Truth:
    """State of one vehicle in its own simulator, about the origin."""

    pos_ned_m: tuple[float, float, float]
    vel_ned_m_s: tuple[float, float, float]
    q_nb: tuple[float, ...]


@dataclass(kw_only=True)
class Seen:
    """Samples of one vehicle. Times are of the monotonic clock."""

    t_s: list[float] = field(default_factory=list)
    pos_ned_m: list[tuple[float, float, float]] = field(default_factory=list)  # about the origin
    beats: list[tuple[float, bool, int]] = field(default_factory=list)  # time, armed, custom_mode
    placed: bool = False  # its filter has a position
    parameters: dict[str, float] = field(default_factory=dict)  # as told; of whole ones a PX4 tells the bits

    @property
    def armed(self) -> bool:
        return bool(self.beats) and self.beats[-1][1]

    @property
    def was_armed(self) -> bool:
        return any(armed for _, armed, _ in self.beats)

    def height_m(self) -> float:
        """Return the height above its first place."""
        return self.pos_ned_m[0][2] - self.pos_ned_m[-1][2]

    def at(self, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions (T, 3) at these times."""
        samples = np.array(self.pos_ned_m)
        times_s = self.t_s[: len(samples)]  # it is still being added to
        return np.stack([np.interp(t_s, times_s, samples[:, axis]) for axis in range(3)], axis=1)


class UdpLink:
    """A port that every vehicle sends to, and what it receives by instance; replies go to `towards` + i."""

    def __init__(self, port: int, towards: int) -> None:
        self._towards = towards
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, port))
        self._socket.setblocking(False)

    def send(self, data: bytes, index: int) -> None:
        self._socket.sendto(data, (HOST, self._towards + index))

    def frames(self) -> Iterator[bytes]:
        with contextlib.suppress(BlockingIOError):
            while True:
                yield from frames(self._socket.recv(MAX_DATAGRAM))

    def close(self) -> None:
        self._socket.close()


class TcpLink:
    """A client of one vehicle's port, which may not exist yet."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._buffer = bytearray()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._connected = False

    def send(self, data: bytes, index: int) -> None:
        if not self._connected:
            self._socket.settimeout(CONNECT_S)
            self._connected = self._socket.connect_ex((HOST, self._port)) == 0
            self._socket.setblocking(False)
        if self._connected:
            with contextlib.suppress(OSError):
                self._socket.send(data)

    def frames(self) -> Iterator[bytes]:
        with contextlib.suppress(OSError):
            while self._connected and (data := self._socket.recv(MAX_DATAGRAM)):
                self._buffer += data
        yield from cut_frames(self._buffer)

    def close(self) -> None:
        self._socket.close()


Link = UdpLink | TcpLink


class Witness:
    """Listens until it is closed."""

    def __init__(self, fleet: Fleet, on_truth: Callable[[Witness, int, Truth], None] | None = None) -> None:
        self.vehicles = [Seen() for _ in range(fleet.count)]
        self._judged_from_s = 0.0
        self._on_truth = on_truth
        self._fleet = fleet
        self._codec = Codec(255, 190)
        self._ending = threading.Event()
        with fleet.network.inside():
            self._links = self._open()
        self._thread = threading.Thread(target=self._listen, name="witness")
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        for link in self._links:
            link.close()

    def say(self, index: int, message: mav.MAVLink_message) -> None:
        """Send a message to one vehicle, as a ground station."""
        link = self._links[index if self._fleet.kind is ARDUCOPTER else 0]
        link.send(self._codec.encode(message), index)

    def ask_truth_every(self, index: int, interval_us: int) -> None:
        """Ask a PX4 for samples of its simulator's state at this interval on the link to its display."""
        params = (mav.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, interval_us, 0, 0, 0, 0, 0)
        message = mav.MAVLink_command_long_message(index + 1, 1, mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, *params)
        self._links[1 + index].send(self._codec.encode(message), index)

    def command(self, index: int, number: int, *params: float) -> None:
        padded = [*params, *[0.0] * (7 - len(params))]
        self.say(index, mav.MAVLink_command_long_message(index + 1, 1, number, 0, *padded))

    def set_parameter(self, index: int, name: str, value: float) -> None:
        self.say(index, mav.MAVLink_param_set_message(index + 1, 1, name.encode(), value, mav.MAV_PARAM_TYPE_REAL32))

    def read_parameter(self, index: int, name: str) -> float:
        """Ask a vehicle for a parameter until it answers."""
        told = self.vehicles[index].parameters
        told.pop(name, None)
        for _ in range(_TRIES):
            self.say(index, mav.MAVLink_param_request_read_message(index + 1, 1, name.encode(), -1))
            until_s = time.monotonic() + _ANSWER_S
            while time.monotonic() < until_s:
                if name in told:
                    return told[name]
                time.sleep(PAUSE_S)
        raise AssertionError(f"vehicle {index} does not tell {name}")

    # --- what has been seen ---

    def judge_from_now(self) -> None:
        """Leave distances until now out of `min_separation_m`."""
        self._judged_from_s = time.monotonic()

    def min_separation_m(self) -> float:
        """Return the least true distance of two vehicles while all were flying."""
        begin_s, end_s = self._all_armed()
        grid_s = np.arange(begin_s, end_s, GRID_S)
        paths = [vehicle.at(grid_s) for vehicle in self.vehicles]
        grounds_m = [vehicle.pos_ned_m[0][2] for vehicle in self.vehicles]
        aloft = np.all([ground_m - path[:, 2] > 0.3 for ground_m, path in zip(grounds_m, paths, strict=True)], axis=0)
        pairs = [(a, b) for i, a in enumerate(paths) for b in paths[i + 1 :]]
        return float(min(np.linalg.norm(a - b, axis=1)[aloft].min() for a, b in pairs))

    def _all_armed(self) -> tuple[float, float]:
        since_s, seen = self._judged_from_s, self.vehicles
        armed_s = [[t_s for t_s, armed, _ in vehicle.beats if armed and t_s >= since_s] for vehicle in seen]
        return max(times[0] for times in armed_s), min(times[-1] for times in armed_s)

    def highest_m(self, vehicle: int) -> float:
        heights = [-z for _, _, z in self.vehicles[vehicle].pos_ned_m]
        return max(heights) - heights[0]

    def wait(self, met: Callable[[], bool], limit_s: float, what: str) -> None:
        deadline_s = time.monotonic() + limit_s
        while not met():
            assert time.monotonic() < deadline_s, f"not within {limit_s:g} s: {what}"
            time.sleep(0.05)

    def all_placed(self) -> bool:
        return all(vehicle.placed for vehicle in self.vehicles)

    def all_rest(self) -> bool:
        """Return whether every vehicle is disarmed and, on its ground, at rest."""
        return all(vehicle.pos_ned_m and not vehicle.armed and vehicle.height_m() < 0.3 for vehicle in self.vehicles)

    # --- listening ---

    def _open(self) -> list[Link]:
        each = range(self._fleet.count)
        if self._fleet.kind is ARDUCOPTER:
            return [TcpLink(5762 + 10 * i) for i in each]
        return [UdpLink(14550, 18570), *(UdpLink(19410 + i, 19450) for i in each)]

    def _listen(self) -> None:
        request_realtime_for_this_thread(_FEED_PRIORITY)
        asked_s = 0.0
        while not self._ending.is_set():
            now_s = time.monotonic()
            if self._fleet.kind is ARDUCOPTER and now_s - asked_s > ASK_EVERY_S:
                asked_s = now_s
                for index, (number, every_us) in itertools.product(range(self._fleet.count), ASKED_US.items()):
                    self.command(index, mav.MAV_CMD_SET_MESSAGE_INTERVAL, number, every_us)
            for link in self._links:
                for frame in link.frames():
                    self._note(frame, now_s)
            time.sleep(PAUSE_S)

    def _note(self, frame: bytes, t_s: float) -> None:
        number, index = message_id(frame), frame[5] - 1
        if frame[6] != 1 or not 0 <= index < len(self.vehicles):
            return
        seen = self.vehicles[index]
        if number == mav.MAVLINK_MSG_ID_HEARTBEAT:
            message = self._codec.decode(frame)
            if message is not None:
                seen.beats.append((t_s, bool(message.base_mode & ARMED_FLAG), message.custom_mode))
        elif number == mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            seen.placed = True
        elif number == mav.MAVLINK_MSG_ID_PARAM_VALUE:
            message = self._codec.decode(frame)
            if message is not None:
                seen.parameters[message.param_id] = message.param_value
        elif number in TRUTH_MESSAGES:
            message = self._codec.decode(frame)
            if message is not None:
                truth = _truth(message, self._fleet.kind.origin)
                seen.t_s.append(t_s)
                seen.pos_ned_m.append(truth.pos_ned_m)
                if self._on_truth is not None:
                    self._on_truth(self, index, truth)


def _truth(message: mav.MAVLink_message, origin: GeoOrigin) -> Truth:
    if message.get_type() == "SIM_STATE":
        lat_deg, lon_deg, alt_m = message.lat_int * 1e-7, message.lon_int * 1e-7, message.alt
        q_nb, vel = (message.q1, message.q2, message.q3, message.q4), (message.vn, message.ve, message.vd)
    else:
        lat_deg, lon_deg, alt_m = message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3
        q_nb, vel = tuple(message.attitude_quaternion), (message.vx * 0.01, message.vy * 0.01, message.vz * 0.01)
    pos = pymap3d.geodetic2ned(lat_deg, lon_deg, alt_m, origin.lat_deg, origin.lon_deg, origin.alt_m)
    return Truth((float(pos[0]), float(pos[1]), float(pos[2])), vel, q_nb)
