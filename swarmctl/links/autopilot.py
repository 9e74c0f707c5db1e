"""One vehicle as the tick sees it: MAVLink in, `VehicleState` in the shared frame out; setpoints in, bytes out.

Newest sample wins. Times of the vehicle's clock are mapped to ours by the smallest transport delay seen lately. The
vehicle's local origin is converted to the shared one here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymap3d
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.frames import rotate_to_ned
from swarmctl.core.types import Array, AttitudeSetpoint, FlightMode, GeoOrigin, Landed, VehicleState
from swarmctl.links.commands import CommandPort
from swarmctl.links.mavlink import Codec, frames
from swarmctl.links.transport import Transport

_ATTITUDE_ONLY = 7  # type_mask: body rates ignored; mask 0 would fly rates and attitude against each other
_ARMED_FLAG = 128
_CRITICAL = 5
_PREARM = 1 << 28
_LOCAL_NED = dialect.MAV_FRAME_LOCAL_NED
_BODY_FRD = (dialect.MAV_FRAME_BODY_NED, dialect.MAV_FRAME_BODY_FRD)  # of ODOMETRY's velocity
_FAST = frozenset({dialect.MAVLINK_MSG_ID_ODOMETRY})  # not worth passing to the slow path


@dataclass(frozen=True, slots=True)
class Dialect:
    """What differs between autopilots."""

    name: str
    external: tuple[float, float]  # DO_SET_MODE main, sub
    hold: tuple[float, float]
    modes: dict[int, FlightMode]  # custom_mode -> mode


def _px4(main: int, sub: int = 0) -> int:
    return main << 16 | sub << 24


PX4 = Dialect(
    "PX4",
    (6.0, 0.0),
    (4.0, 3.0),
    {
        _px4(1): FlightMode.MANUAL,
        _px4(2): FlightMode.MANUAL,
        _px4(3): FlightMode.MANUAL,
        _px4(7): FlightMode.MANUAL,
        _px4(4, 2): FlightMode.TAKEOFF,
        _px4(4, 3): FlightMode.HOLD,
        _px4(4, 4): FlightMode.MISSION,
        _px4(4, 5): FlightMode.RTL,
        _px4(4, 6): FlightMode.LAND,
        _px4(6): FlightMode.EXTERNAL,
    },
)
ARDUCOPTER = Dialect(
    "ArduCopter",
    (4.0, 0.0),
    (5.0, 0.0),
    {
        0: FlightMode.MANUAL,
        2: FlightMode.MANUAL,
        3: FlightMode.MISSION,
        4: FlightMode.EXTERNAL,
        5: FlightMode.HOLD,
        6: FlightMode.RTL,
        9: FlightMode.LAND,
    },
)
DIALECTS = {12: PX4, 3: ARDUCOPTER}  # HEARTBEAT.autopilot


class VehicleClock:
    """Vehicle time -> our monotonic time: offset is the smallest (arrival - stamp) of the last two windows."""

    WINDOW_US = 2_000_000

    def __init__(self) -> None:
        self._window_end_us = 0
        self._previous: int | None = None
        self._current: int | None = None
        self._newest_us = 0

    def to_local(self, vehicle_us: int, arrived_us: int) -> int:
        """Our time of a vehicle stamp that arrived at `arrived_us`."""
        offset = arrived_us - vehicle_us
        if vehicle_us < self._newest_us - 1_000_000:  # the vehicle rebooted: its clock began again
            self._previous, self._current, self._window_end_us = None, None, arrived_us
            self._newest_us = vehicle_us
        self._newest_us = max(self._newest_us, vehicle_us)
        if arrived_us >= self._window_end_us:
            self._previous, self._current = self._current, None
            self._window_end_us = arrived_us + self.WINDOW_US
        self._current = offset if self._current is None else min(self._current, offset)
        best = self._current if self._previous is None else min(self._current, self._previous)
        return vehicle_us + best


class Autopilot:
    """The link to one vehicle.

    Args:
        transport: bytes.
        codec: own identity.
        sysid: the vehicle's system id; everything else is ignored.
        shared: origin of the swarm's frame.
        on_frame: told of every frame in and out (recording).
    """

    def __init__(
        self,
        transport: Transport,
        codec: Codec,
        sysid: int,
        shared: GeoOrigin,
        on_frame: Callable[[bytes], None],
    ) -> None:
        self._transport, self._codec, self._sysid, self._shared = transport, codec, sysid, shared
        self._on_frame = on_frame
        self._clock = VehicleClock()
        self._slow: CommandPort | None = None
        self.dialect: Dialect | None = None
        self.offset_ned_m: Array | None = None  # (3,) local origin in the shared frame
        self.armed = False
        self.mode = FlightMode.UNKNOWN
        self.landed = Landed.UNKNOWN
        self.armable = False
        self.failsafe = False
        self.hover_thrust_01: float | None = None  # what the autopilot flies with while it hovers by itself
        self.texts: list[str] = []
        self.refused_setpoints = 0
        self._sample: tuple[int, Array, Array, Array, Array] | None = None
        self._attitude: tuple[int, Array, Array] | None = None
        self._odometry_us = 0
        self._handlers: dict[str, Callable[[Any, int], None]] = {
            "HEARTBEAT": self._heartbeat,
            "CURRENT_MODE": self._current_mode,
            "ODOMETRY": self._odometry,
            "ATTITUDE_QUATERNION": self._attitude_quaternion,
            "LOCAL_POSITION_NED": self._local_position,
            "SYS_STATUS": self._sys_status,
            "EXTENDED_SYS_STATE": self._extended,
            "GPS_GLOBAL_ORIGIN": self._origin,
            "ATTITUDE_TARGET": self._attitude_target,
            "STATUSTEXT": self._statustext,
        }

    def attach(self, slow: CommandPort) -> None:
        """Pass everything but the fast state messages on to the slow path."""
        self._slow = slow

    def send_frame(self, frame: bytes) -> None:
        """For the slow path: its bytes leave by the same link."""
        self._on_frame(frame)
        self._transport.send(frame)

    def poll(self, now_us: int) -> VehicleState | None:
        """Drain the link; the newest state, or None before the first complete one."""
        for datagram in self._transport.receive(now_us):
            for frame in frames(datagram.data):
                self._frame(frame, datagram.t_us)
        if self._sample is None or self.offset_ned_m is None or self.mode is FlightMode.UNKNOWN:
            return None
        t_us, pos, vel, q_nb, rate = self._sample
        return VehicleState(
            t_us, pos + self.offset_ned_m, vel, q_nb, rate, self.armed, self.mode, self.landed, self.failsafe
        )

    def send(self, setpoint: AttitudeSetpoint, now_us: int) -> str:
        """Send one setpoint; returns why it was refused, or "".

        Nothing else in the project sends setpoints.
        """
        refused = setpoint.problem(now_us)
        if refused:
            self.refused_setpoints += 1
            return refused
        q = [float(c) for c in setpoint.q_nb]
        message = dialect.MAVLink_set_attitude_target_message(
            (now_us // 1000) & 0xFFFFFFFF, self._sysid, 1, _ATTITUDE_ONLY, q, 0.0, 0.0, 0.0, setpoint.thrust_01
        )
        self.send_frame(self._codec.encode(message))
        return ""

    def close(self) -> None:
        self._transport.close()

    def _frame(self, frame: bytes, arrived_us: int) -> None:
        if frame[5] != self._sysid or frame[6] != 1:
            return
        message = self._codec.decode(frame)
        if message is None:
            return
        self._on_frame(frame)
        handler = self._handlers.get(message.get_type())
        if handler is not None:
            handler(message, arrived_us)
        if self._slow is not None and message.get_msgId() not in _FAST:
            self._slow.frame(frame, message)

    def _heartbeat(self, message: Any, arrived_us: int) -> None:
        self.dialect = DIALECTS.get(message.autopilot)
        if self.dialect is None:
            return
        self.armed = bool(message.base_mode & _ARMED_FLAG)
        self.failsafe = message.system_status >= _CRITICAL
        self.mode = self.dialect.modes.get(message.custom_mode, FlightMode.MANUAL)

    def _current_mode(self, message: Any, arrived_us: int) -> None:
        """The same as in HEARTBEAT, but fast: a pilot's switch must not stay unseen for a second."""
        if self.dialect is not None:
            self.mode = self.dialect.modes.get(message.custom_mode, FlightMode.MANUAL)

    def _odometry(self, message: Any, arrived_us: int) -> None:
        if message.frame_id != _LOCAL_NED or message.child_frame_id not in (_LOCAL_NED, *_BODY_FRD):
            self._codec.refused["odometry frame"] += 1
            return
        t_us = self._clock.to_local(message.time_usec, arrived_us)
        self._odometry_us = arrived_us
        q_nb = np.array(message.q)
        vel = np.array([message.vx, message.vy, message.vz])
        if message.child_frame_id in _BODY_FRD:
            vel = rotate_to_ned(q_nb, vel)
        rate = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        self._take(t_us, np.array([message.x, message.y, message.z]), vel, q_nb, rate)

    def _attitude_quaternion(self, message: Any, arrived_us: int) -> None:
        q_nb = np.array([message.q1, message.q2, message.q3, message.q4])
        rate = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        self._attitude = (arrived_us, q_nb, rate)

    def _local_position(self, message: Any, arrived_us: int) -> None:
        """Fallback for autopilots without ODOMETRY: position with the newest attitude."""
        if self._attitude is None or (arrived_us - self._odometry_us < 500_000 and self._odometry_us):
            return
        t_us = self._clock.to_local(message.time_boot_ms * 1000, arrived_us)
        pos, vel = np.array([message.x, message.y, message.z]), np.array([message.vx, message.vy, message.vz])
        self._take(t_us, pos, vel, self._attitude[1], self._attitude[2])

    def _take(self, t_us: int, pos: Array, vel: Array, q_nb: Array, rate: Array) -> None:
        norm = float(np.sqrt(q_nb @ q_nb))
        if not (np.isfinite(pos).all() and np.isfinite(vel).all() and np.isfinite(rate).all() and 0.9 < norm < 1.1):
            self._codec.refused["state not finite"] += 1
            return
        if self._sample is None or t_us >= self._sample[0] or self._sample[0] - t_us > 1_000_000:
            self._sample = (t_us, pos, vel, q_nb / norm, rate)

    def _sys_status(self, message: Any, arrived_us: int) -> None:
        self.armable = bool(message.onboard_control_sensors_health & _PREARM)

    def _extended(self, message: Any, arrived_us: int) -> None:
        self.landed = Landed(message.landed_state) if message.landed_state <= Landed.LANDING else Landed.UNKNOWN

    def _origin(self, message: Any, arrived_us: int) -> None:
        north, east, down = pymap3d.geodetic2ned(
            message.latitude * 1e-7,
            message.longitude * 1e-7,
            message.altitude * 1e-3,
            self._shared.lat_deg,
            self._shared.lon_deg,
            self._shared.alt_m,
        )
        self.offset_ned_m = np.array([north, east, down], dtype=float)

    def _attitude_target(self, message: Any, arrived_us: int) -> None:
        if self.mode is FlightMode.HOLD and self.landed is Landed.IN_AIR and 0.05 < message.thrust < 1.0:
            self.hover_thrust_01 = float(message.thrust)

    def _statustext(self, message: Any, arrived_us: int) -> None:
        text = message.text.rstrip("\t\x00") if isinstance(message.text, str) else str(message.text)
        self.texts = [*self.texts[-19:], text]
