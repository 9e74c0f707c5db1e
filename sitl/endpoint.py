"""MAVLink face of one vehicle: frames in, commands and setpoints out, reports back. PX4's manners on its offboard link.

It decides who is addressed, which command means what, and what is sent when; what happens then is the `Autopilot`'s.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.autopilot import FORCE, Autopilot
from sitl.modes import Px4Mode, Result, Severity
from sitl.parameters import UnknownParameterError, WireValue, WrongTypeError
from sitl.streams import STREAMS, Report, Schedule
from swarmctl.links.mavlink import Codec, frames
from swarmctl.links.transport import Transport

COMPONENT = 1
TYPE_GCS = 6
CUSTOM_MODE_FLAG = 1
PARAMS_PER_STEP = 4
TEXT_CHARS = 50
TEXT_MAX_AGE_US = 5_000_000
TEXT_EVERY_US = 50_000
PARAM_ERROR_UNKNOWN, PARAM_ERROR_TYPE = 1, 7
Params = tuple[float, float, float, float, float, float, float]


class Endpoint:
    """One vehicle on one link.

    Args:
        sysid: MAVLink system id.
        transport: link to the client.
        autopilot: what obeys.
        report: makes a `Report` of this instant; called only when something is sent.
        step_us: physics step, the fastest message interval.
    """

    def __init__(
        self, sysid: int, transport: Transport, autopilot: Autopilot, report: Callable[[], Report], step_us: int
    ) -> None:
        self.sysid = sysid
        self.transport = transport
        self.ignored: Counter[str] = Counter()
        self._autopilot = autopilot
        self._report = report
        self._codec = Codec(sysid, COMPONENT)
        self._schedule = Schedule(step_us)
        self._contacted = self._gcs_heard = self._origin_sent = False
        self._params: deque[int] = deque()
        self._texts: deque[tuple[int, Severity, str]] = deque()
        self._text_id = 0
        self._text_due_us = 0
        self._now_us = 0
        self._sender = (0, 0)
        self._handlers: dict[int, Callable[[Any], None]] = {
            mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: self._on_attitude_target,
            mav.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            mav.MAVLINK_MSG_ID_COMMAND_LONG: self._on_command_long,
            mav.MAVLINK_MSG_ID_COMMAND_INT: self._on_command_int,
            mav.MAVLINK_MSG_ID_SET_MODE: self._on_set_mode,
            mav.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            mav.MAVLINK_MSG_ID_PING: self._on_ping,
            mav.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: self._on_param_list,
            mav.MAVLINK_MSG_ID_PARAM_REQUEST_READ: self._on_param_read,
            mav.MAVLINK_MSG_ID_PARAM_SET: self._on_param_set,
        }
        self._commands: dict[int, Callable[[Params], Result | None]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mav.MAV_CMD_DO_SET_MODE: self._set_mode,
            mav.MAV_CMD_NAV_TAKEOFF: self._takeoff,
            mav.MAV_CMD_NAV_LAND: lambda _: self._autopilot.set_mode(Px4Mode.AUTO_LAND, self._now_us),
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._autopilot.set_mode(Px4Mode.AUTO_RTL, self._now_us),
            mav.MAV_CMD_DO_FLIGHTTERMINATION: self._terminate,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mav.MAV_CMD_REQUEST_MESSAGE: self._request_message,
        }

    def receive(self, now_us: int, transport_now_us: int) -> None:
        """Handle everything that has arrived; `now_us` is time since boot."""
        self._now_us = now_us
        for datagram in self.transport.receive(transport_now_us):
            for frame in frames(datagram.data):
                self._on_frame(frame)

    def send_due(self, now_us: int) -> None:
        """Send what the schedule, a parameter list, or pending texts ask for."""
        self._now_us = now_us
        due = self._schedule.take_due(now_us)
        ready = self._autopilot.ready(now_us)
        if ready and not self._origin_sent:
            self._origin_sent = True
            due.append(mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        if due:
            report = self._report()
            for message in due:
                stream = STREAMS[message]
                if ready or not stream.needs_position:
                    self._send(stream.build(report))
        if self._params:
            for _ in range(min(PARAMS_PER_STEP, len(self._params))):
                self._send_param(self._autopilot.parameters.by_index(self._params.popleft()))
        if self._texts or self._autopilot.texts:
            self._send_texts()

    # --- receiving ---

    def _on_frame(self, frame: bytes) -> None:
        message = self._codec.decode(frame)
        if message is None:
            self.ignored["not_decoded"] += 1
            return
        handler = self._handlers.get(message.get_msgId())
        if handler is None:
            return
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if target[0] not in (0, self.sysid) or target[1] not in (0, COMPONENT):
            if handler != self._on_ping:
                self.ignored["not_addressed"] += 1
            return
        self._sender = message.get_srcSystem(), message.get_srcComponent()
        handler(message)
        if not self._contacted:
            self._contacted = True
            self._send_stream(mav.MAVLINK_MSG_ID_HEARTBEAT)

    def _on_heartbeat(self, message: Any) -> None:
        self._gcs_heard = self._gcs_heard or message.type == TYPE_GCS

    def _on_attitude_target(self, message: Any) -> None:
        self._autopilot.on_setpoint(message.type_mask, message.q, message.thrust, self._now_us)

    def _on_timesync(self, message: Any) -> None:
        if message.tc1 == 0:
            self._send(mav.MAVLink_timesync_message(self._now_us * 1000, message.ts1))

    def _on_ping(self, message: Any) -> None:
        if message.target_system == 0:
            self._send(mav.MAVLink_ping_message(message.time_usec, message.seq, *self._sender))

    # --- commands ---

    def _on_command_long(self, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        self._acknowledge(m.command, self._run(m.command, params))

    def _on_command_int(self, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4, m.x / 1e7, m.y / 1e7, m.z)
        self._acknowledge(m.command, self._run(m.command, params))

    def _on_set_mode(self, m: Any) -> None:
        main, sub = m.custom_mode >> 16 & 0xFF, m.custom_mode >> 24 & 0xFF
        params = (float(m.base_mode), float(main), float(sub), 0.0, 0.0, 0.0, 0.0)
        self._acknowledge(mav.MAV_CMD_DO_SET_MODE, self._run(mav.MAV_CMD_DO_SET_MODE, params))

    def _run(self, command: int, params: Params) -> Result | None:
        action = self._commands.get(command)
        if action is None:
            return Result.UNSUPPORTED
        if self._autopilot.terminated and command not in (
            mav.MAV_CMD_SET_MESSAGE_INTERVAL,
            mav.MAV_CMD_REQUEST_MESSAGE,
        ):
            return Result.TEMPORARILY_REJECTED
        return action(params)

    def _acknowledge(self, command: int, result: Result | None) -> None:
        if result is not None:
            self._send(mav.MAVLink_command_ack_message(command, result, 0, 0, *self._sender))

    def _arm_disarm(self, params: Params) -> Result | None:
        if params[0] == 1.0:
            return self._autopilot.arm(self._now_us)
        if params[0] == 0.0:
            return self._autopilot.disarm(force=params[1] == FORCE)
        self._autopilot.texts.append((Severity.CRITICAL, f"Unsupported ARM_DISARM param: {params[0]:.3f}"))
        return None

    def _set_mode(self, params: Params) -> Result:
        base, main, sub = (_whole(p) for p in params[:3])
        if base is None or main is None or not base & CUSTOM_MODE_FLAG:
            return Result.TEMPORARILY_REJECTED
        try:
            mode = Px4Mode(main << 16 | (sub or 0) << 24 if main == 4 else main << 16)
        except ValueError:
            return Result.TEMPORARILY_REJECTED
        return self._autopilot.set_mode(mode, self._now_us)

    def _takeoff(self, params: Params) -> Result:
        alt_amsl_m = params[6] if math.isfinite(params[6]) else None
        return self._autopilot.set_mode(Px4Mode.AUTO_TAKEOFF, self._now_us, alt_amsl_m)

    def _terminate(self, params: Params) -> Result:
        return self._autopilot.terminate() if params[0] > 0.5 else Result.ACCEPTED

    def _set_interval(self, params: Params) -> Result:
        message, interval_us = _whole(params[0]), _whole(params[1])
        if message not in STREAMS or message is None or interval_us is None:
            return Result.FAILED
        self._schedule.set_interval(message, interval_us, self._now_us)
        return Result.ACCEPTED

    def _request_message(self, params: Params) -> Result:
        message = _whole(params[0])
        if message is None:
            return Result.DENIED
        if message in STREAMS:
            self._send_stream(message)
        return Result.ACCEPTED  # PX4 accepts ids it never sends, too

    # --- parameters ---

    def _on_param_list(self, _: Any) -> None:
        self._params = deque(range(len(self._autopilot.parameters)))

    def _on_param_read(self, message: Any) -> None:
        table = self._autopilot.parameters
        try:
            found = table.by_index(message.param_index) if message.param_index >= 0 else table.by_name(message.param_id)
        except UnknownParameterError:
            self._send_param_error(message.param_id, PARAM_ERROR_UNKNOWN)
        else:
            self._send_param(found)

    def _on_param_set(self, message: Any) -> None:
        try:
            stored = self._autopilot.parameters.set_from_wire(message.param_id, message.param_value, message.param_type)
        except UnknownParameterError:
            self._send_param_error(message.param_id, PARAM_ERROR_UNKNOWN)
        except WrongTypeError:
            self._send_param_error(message.param_id, PARAM_ERROR_TYPE)
        else:
            self._send_param(stored)

    def _send_param(self, p: WireValue) -> None:
        count = len(self._autopilot.parameters)
        self._send(mav.MAVLink_param_value_message(p.name.encode(), p.value, p.kind, count, p.index))

    def _send_param_error(self, name: str, error: int) -> None:
        raw = name.encode("ascii", "replace")[:16]
        self._send(mav.MAVLink_param_error_message(*self._sender, raw, -1, error))

    # --- sending ---

    def _send(self, message: Any) -> None:
        self.transport.send(self._codec.encode(message))

    def _send_stream(self, message: int) -> None:
        stream = STREAMS[message]
        if self._autopilot.ready(self._now_us) or not stream.needs_position:
            self._send(stream.build(self._report()))

    def _send_texts(self) -> None:
        """PX4 tells only links with a ground station (HEARTBEAT type 6), at most 20/s, nothing older than 5 s."""
        for severity, text in self._autopilot.texts:
            self._texts.append((self._now_us, severity, text))
        self._autopilot.texts.clear()
        while self._texts and self._now_us - self._texts[0][0] > TEXT_MAX_AGE_US:
            self._texts.popleft()
        if not (self._texts and self._gcs_heard and self._now_us >= self._text_due_us):
            return
        _, severity, text = self._texts.popleft()
        self._text_due_us = self._now_us + TEXT_EVERY_US
        self._text_id = self._text_id % 65535 + 1
        raw = text.encode("ascii", "replace")
        chunks = [raw[i : i + TEXT_CHARS] for i in range(0, len(raw), TEXT_CHARS)]
        for number, chunk in enumerate(chunks):
            self._send(mav.MAVLink_statustext_message(severity, chunk, self._text_id if len(chunks) > 1 else 0, number))


def _whole(value: float) -> int | None:
    """Integer of a command parameter; None for NaN and infinities."""
    return int(value) if math.isfinite(value) else None
