"""MAVLink interface of one ArduCopter: receives commands and setpoints, sends reports; protocol as 4.6.3.

It decides on addressing, on the meaning of commands, and on sending times; `ArduCopter` decides the consequences. It
neither receives nor sends until its boot reaches the first HEARTBEAT.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.arducopter.autopilot import FORCE_ARM, FORCE_DISARM, ArduCopter
from sitl.arducopter.modes import CopterMode
from sitl.arducopter.streams import ALL_GROUPS, STREAMS, CopterReport, Intervals
from sitl.net.mavlink_values import Result, Severity
from sitl.net.wire import KINDS, FrameWriter, Kind
from sitl.parameter_values import UnknownParameterError, WireValue
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.transport import Transport

COMPONENT = 1
CUSTOM_MODE_FLAG = 1
HEARTBEAT_US = 1_000_000
TIMESYNC_US = 10_000_000
PARAMS_PER_S = 1700
REBOOT_AFTER_US = 200_000  # the ack is sent first
TEXT_CHARS = 50
_ACK = KINDS[mav.MAVLINK_MSG_ID_COMMAND_ACK]
_TEXT = KINDS[mav.MAVLINK_MSG_ID_STATUSTEXT]
_TIMESYNC = KINDS[mav.MAVLINK_MSG_ID_TIMESYNC]
_VALUE = KINDS[mav.MAVLINK_MSG_ID_PARAM_VALUE]
Params = tuple[float, float, float, float, float, float, float]


class ArduCopterEndpoint:
    """One vehicle on one link.

    Args:
        sysid: MAVLink system id.
        transport: link to the client.
        pilot: executes commands and setpoints.
        report: makes a `CopterReport` of this instant; called only when something is sent.
        step_us: physics step, the fastest message interval.
    """

    def __init__(
        self, sysid: int, transport: Transport, pilot: ArduCopter, report: Callable[[], CopterReport], *, step_us: int
    ) -> None:
        self.sysid = sysid
        self.transport = transport
        self.ignored: Counter[str] = Counter()
        self._pilot = pilot
        self._report = report
        self._codec = Codec(sysid, COMPONENT)
        self._writer = FrameWriter(sysid, COMPONENT)
        self._step_us = step_us
        self._waited_us = 0  # since the arrival of the current datagram
        self._texts = pilot.outbox()
        self._params_per_step = max(1, round(PARAMS_PER_S * step_us * 1e-6))
        self._sender = (0, 0)
        self._power_up()
        self._handlers: dict[int, Callable[[Any], None]] = {
            mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: self._on_attitude_target,
            mav.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            mav.MAVLINK_MSG_ID_COMMAND_LONG: self._on_command_long,
            mav.MAVLINK_MSG_ID_COMMAND_INT: self._on_command_int,
            mav.MAVLINK_MSG_ID_SET_MODE: self._on_set_mode,
            mav.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            mav.MAVLINK_MSG_ID_REQUEST_DATA_STREAM: self._on_data_stream,
            mav.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: self._on_param_list,
            mav.MAVLINK_MSG_ID_PARAM_REQUEST_READ: self._on_param_read,
            mav.MAVLINK_MSG_ID_PARAM_SET: self._on_param_set,
        }
        self._commands: dict[int, Callable[[Params], Result]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mav.MAV_CMD_DO_SET_MODE: lambda p: self._set_mode(_whole(p[0]), _whole(p[1])),
            mav.MAV_CMD_NAV_TAKEOFF: lambda p: self._pilot.take_off(p[6]),
            mav.MAV_CMD_NAV_LAND: lambda _: self._pilot.set_mode(CopterMode.LAND),
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._pilot.set_mode(CopterMode.RTL),
            mav.MAV_CMD_NAV_LOITER_UNLIM: lambda _: self._pilot.set_mode(CopterMode.LOITER),
            mav.MAV_CMD_DO_FLIGHTTERMINATION: self._terminate,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mav.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_version,
            mav.MAV_CMD_GET_HOME_POSITION: self._get_home,
            mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._request_reboot,
        }

    def _power_up(self) -> None:
        self._intervals = Intervals(self._step_us)
        self._texts.clear()
        self._text_id = 0
        self._params: deque[int] = deque()
        self._beat_us = self._timesync_us = self._pilot.boot_times.heartbeat_us
        self._told_mode, self._told_home = int(self._pilot.mode), self._pilot.home_set
        self._now_us = 0
        self._reboot_us: int | None = None
        self._boot_us = self._pilot.boot.at_us

    def reboot(self, now_us: int) -> None:
        """Restart as after power-up, with every link of the vehicle; `now_us` is on the clock of the simulation."""
        self._pilot.reboot(now_us)

    def _at(self, now_us: int) -> int:
        """Return the time since the autopilot's boot; after a recent boot the link's state is discarded."""
        if self._boot_us != self._pilot.boot.at_us:
            self._power_up()
        self._now_us = self._pilot.boot.since_us(now_us)
        return self._now_us

    @property
    def _up(self) -> bool:
        return self._now_us >= self._pilot.boot_times.heartbeat_us

    def receive(self, now_us: int, transport_now_us: int) -> None:
        """Handle everything that has arrived; `now_us` is the simulation's time, everywhere else it is since boot."""
        self._at(now_us)
        for datagram in self.transport.receive(transport_now_us):
            self._waited_us = max(0, min(self._step_us, transport_now_us - datagram.t_us))
            for frame in frames(datagram.data, version_1=True):
                self._on_frame(frame)

    def send_due(self, now_us: int) -> None:
        """Send heartbeats, news, and what intervals, a parameter list, or texts require."""
        if self._reboot_us is not None and now_us >= self._reboot_us:
            self.reboot(now_us)
        now_us = self._at(now_us)
        if not self._up:
            return
        self._send_heartbeat(now_us)
        if self._told_home != self._pilot.home_set:
            self._told_home = self._pilot.home_set
            self._send_streams([mav.MAVLINK_MSG_ID_HOME_POSITION, mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN])
        if now_us >= self._timesync_us:
            self._timesync_us = now_us + TIMESYNC_US
            self._send(_TIMESYNC, 0, now_us * 1000)
        due = self._intervals.take_due(now_us)
        if due:
            self._send_streams(due)
        for _ in range(min(self._params_per_step, len(self._params))):
            self._send_param(self._pilot.parameters.by_index(self._params.popleft()))
        while self._texts:
            self._send_text(*self._texts.popleft())

    def _send_heartbeat(self, now_us: int) -> None:
        """Send a HEARTBEAT at 1 Hz, and at once when the mode has changed; arming waits for the next one."""
        if now_us >= self._beat_us:
            self._beat_us += HEARTBEAT_US * (1 + (now_us - self._beat_us) // HEARTBEAT_US)
        elif self._told_mode == self._pilot.mode:
            return
        self._told_mode = int(self._pilot.mode)
        self._send_streams([mav.MAVLINK_MSG_ID_HEARTBEAT])

    # --- receiving ---

    def _on_frame(self, frame: bytes) -> None:
        message = self._codec.decode(frame) if self._up else None
        if message is None:
            self.ignored["not_decoded" if self._up else "booting"] += 1
            return
        handler = self._handlers.get(message.get_msgId())
        if handler is None:
            return
        if getattr(message, "target_system", 0) not in (0, self.sysid):  # executed for every component
            self.ignored["not_addressed"] += 1
            return
        self._sender = message.get_srcSystem(), message.get_srcComponent()
        handler(message)

    def _on_heartbeat(self, message: Any) -> None:
        if message.get_srcSystem() == self._pilot.parameters.integer("SYSID_MYGCS"):
            self._pilot.on_gcs_heartbeat(self._now_us)

    def _on_attitude_target(self, m: Any) -> None:
        rates = (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
        self._pilot.on_setpoint(m.type_mask, m.q, rates, m.thrust, now_us=self._now_us)

    def _on_timesync(self, message: Any) -> None:
        if message.tc1 == 0:
            self._send(_TIMESYNC, (self._now_us - self._waited_us) * 1000, message.ts1)

    def _on_data_stream(self, m: Any) -> None:
        rate_hz = m.req_message_rate if m.start_stop else 0
        for message, stream in STREAMS.items():
            if stream.group is not None and m.req_stream_id in (ALL_GROUPS, stream.group):
                self._intervals.set_interval(message, round(1e6 / rate_hz) if rate_hz else -1, self._now_us)

    # --- commands ---

    def _on_command_long(self, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        self._acknowledge(m.command, self._run(m.command, params))

    def _on_command_int(self, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4, m.x / 1e7, m.y / 1e7, m.z)
        above_home = m.frame in (mav.MAV_FRAME_GLOBAL_RELATIVE_ALT, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
        denied = m.command == mav.MAV_CMD_NAV_TAKEOFF and not above_home
        self._acknowledge(m.command, Result.DENIED if denied else self._run(m.command, params))

    def _on_set_mode(self, m: Any) -> None:
        self._acknowledge(mav.MAVLINK_MSG_ID_SET_MODE, self._set_mode(m.base_mode, m.custom_mode))

    def _run(self, command: int, params: Params) -> Result:
        action = self._commands.get(command)
        return Result.UNSUPPORTED if action is None else action(params)

    def _acknowledge(self, command: int, result: Result) -> None:
        self._send(_ACK, command, result, 0, 0, *self._sender)

    def _arm_disarm(self, params: Params) -> Result:
        if params[0] == 1.0:
            return self._pilot.arm(self._now_us, force=params[1] == FORCE_ARM)
        if params[0] == 0.0:
            return self._pilot.disarm(force=params[1] == FORCE_DISARM)
        return Result.UNSUPPORTED

    def _set_mode(self, base: int | None, custom: int | None) -> Result:
        if base is None or custom is None or not base & CUSTOM_MODE_FLAG:
            return Result.DENIED
        return self._pilot.set_mode(custom)

    def _terminate(self, params: Params) -> Result:
        return self._pilot.disarm(force=True) if params[0] > 0.5 else Result.FAILED

    def _set_interval(self, params: Params) -> Result:
        message, interval_us = _whole(params[0]), _whole(params[1])
        if message is None or message not in STREAMS:
            self._pilot.send_text(Severity.INFO, f"No ap_message for mavlink id ({message or 0})")
            return Result.DENIED
        if interval_us is None:
            return Result.DENIED
        if message == mav.MAVLINK_MSG_ID_HEARTBEAT:
            return Result.ACCEPTED  # stays at 1 Hz here
        self._intervals.set_interval(message, interval_us, self._now_us)
        return Result.ACCEPTED

    def _request_message(self, params: Params) -> Result:
        message = _whole(params[0])
        if message is None or message not in STREAMS:
            return Result.FAILED
        self._send_streams([message])
        return Result.ACCEPTED

    def _request_version(self, params: Params) -> Result:
        if params[0] != 1.0:
            return Result.ACCEPTED
        self._send_streams([mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION])
        return Result.ACCEPTED

    def _request_reboot(self, params: Params) -> Result:
        if params[0] != 1.0 or self._pilot.armed:
            return Result.FAILED
        self._reboot_us = self._now_us + self._pilot.boot.at_us + REBOOT_AFTER_US
        return Result.ACCEPTED

    def _get_home(self, _: Params) -> Result:
        if not self._pilot.home_set:
            return Result.FAILED
        self._send_streams([mav.MAVLINK_MSG_ID_HOME_POSITION, mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN])
        return Result.ACCEPTED

    # --- parameters ---

    def _on_param_list(self, _: Any) -> None:
        self._params = deque(range(len(self._pilot.parameters)))

    def _on_param_read(self, message: Any) -> None:
        table = self._pilot.parameters
        try:
            found = table.by_index(message.param_index) if message.param_index >= 0 else table.by_name(message.param_id)
        except UnknownParameterError:
            return  # no answer, as the real one
        self._send_param(found)

    def _on_param_set(self, message: Any) -> None:
        try:
            if math.isfinite(message.param_value):
                self._pilot.parameters.assign(message.param_id, message.param_value)
                self._send_param(self._pilot.parameters.by_name(message.param_id))
        except UnknownParameterError:
            self.ignored["unknown_parameter"] += 1

    def _send_param(self, p: WireValue) -> None:
        count = len(self._pilot.parameters)
        self._send(_VALUE, p.value, count, p.index, p.name.encode(), p.kind)

    # --- sending ---

    def _send(self, kind: Kind, *fields: Any) -> None:
        self.transport.send(self._writer.frame(kind, fields))

    def _send_streams(self, messages: list[int]) -> None:
        report = self._report()
        for message in messages:
            stream = STREAMS[message]
            if self._pilot.has_origin or not stream.needs_position:
                self.transport.send(self._writer.frame(KINDS[message], stream.build(report)))

    def _send_text(self, severity: Severity, text: str) -> None:
        """Queue a text on every link."""
        self._text_id = self._text_id % 65535 + 1
        raw = text.encode("ascii", "replace")
        chunks = [raw[i : i + TEXT_CHARS] for i in range(0, len(raw), TEXT_CHARS)]
        for number, chunk in enumerate(chunks):
            self._send(_TEXT, severity, chunk, self._text_id if len(chunks) > 1 else 0, number)


def _whole(value: float) -> int | None:
    """Return the integer of a command parameter; None for NaN and infinities."""
    return int(value) if math.isfinite(value) else None
