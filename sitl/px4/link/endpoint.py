"""MAVLink interface of one vehicle on one link: receives setpoints and commands, sends reports; protocol as PX4.

It decides on addressing and on sending times. The meaning of commands is in `commands`; parameters and missions have
modules of their own; the `Autopilot` decides the consequences.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.net.mavlink_values import Result, Severity
from sitl.net.wire import KINDS, FrameWriter, Kind
from sitl.px4.autopilot import Autopilot
from sitl.px4.link.commands import Commands, Params
from sitl.px4.link.missions import MissionLink
from sitl.px4.link.parameters import ParameterLink
from sitl.px4.link.schedule import OFFBOARD_HZ, Schedule
from sitl.px4.link.streams import Fields, LinkCounts, Report
from sitl.px4.link.streams_health import STREAMS
from sitl.px4.modes import MODE_NAMES, STANDARD_MODES, Px4Mode
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.transport import Transport

COMPONENT = 1
TYPE_GCS = 6
TEXT_CHARS = 50
TEXT_MAX_AGE_US = 5_000_000
TEXT_EVERY_US = 50_000
GCS_GONE_US = 2_500_000  # timeout of a ground station's heartbeat
BOOT_COMMAND = 211  # PX4 acknowledges it unasked at start
_ACK = KINDS[mav.MAVLINK_MSG_ID_COMMAND_ACK]
_TEXT = KINDS[mav.MAVLINK_MSG_ID_STATUSTEXT]
_TIMESYNC = KINDS[mav.MAVLINK_MSG_ID_TIMESYNC]
_PING = KINDS[mav.MAVLINK_MSG_ID_PING]
_INTERVAL = KINDS[mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL]
_AVAILABLE = KINDS[mav.MAVLINK_MSG_ID_AVAILABLE_MODES]
_CURRENT_MODE = mav.MAVLINK_MSG_ID_CURRENT_MODE
_ORIGIN = mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
_UNKNOWN_PLACE = 2**31 - 1  # value of COMMAND_INT for no place


class Endpoint:
    """One vehicle on one link.

    Args:
        sysid: MAVLink system id.
        transport: link to the client.
        autopilot: executes commands and setpoints.
        report: makes a `Report` of this instant; called only when something is sent.
        step_us: physics step, the fastest message interval.
        default_hz: default rates of the link.
    """

    def __init__(
        self,
        sysid: int,
        transport: Transport,
        autopilot: Autopilot,
        report: Callable[[], Report],
        *,
        step_us: int,
        default_hz: dict[int, float] | None = None,
    ) -> None:
        self.sysid = sysid
        self.transport = transport
        self.ignored: Counter[str] = Counter()
        self.sender = (0, 0)  # system and component of the message being handled
        self._autopilot = autopilot
        self._report = report
        self._step_us = step_us
        self._waited_us = 0  # since the arrival of the current datagram
        self._default_hz = OFFBOARD_HZ if default_hz is None else default_hz
        self._codec = Codec(sysid, COMPONENT)
        self._writer = FrameWriter(sysid, COMPONENT)
        self._others: list[Endpoint] = []  # links of the same vehicle
        self._handlers = self._handler_table()
        self._begin()

    def _begin(self) -> None:
        """Reset to the state after boot."""
        self._schedule = Schedule(self._step_us, self._default_hz, self._autopilot.boot.quiet_us)
        self._counts = LinkCounts()
        self._greeted = False
        self._gcs_us: int | None = None  # last heartbeat of a ground station
        self._origin_sent: object = None
        self._target_us: int | None = None  # when the setpoint came that ATTITUDE_TARGET has told last
        self._status_sent: tuple[object, ...] = ()
        self._seen: set[tuple[int, int]] = set()
        self._texts: deque[tuple[int, Severity, str]] = deque()
        self._text_id = self._text_due_us = self._now_us = 0
        self._placed = False  # it has had a position since its boot
        self._commands = Commands(self._autopilot, self)
        self._parameters = ParameterLink(self._autopilot.parameters, self, self._tell_parameter)
        self._missions = MissionLink(self._autopilot.store, self)

    def join(self, other: Endpoint) -> None:
        """Join two links of one vehicle."""
        self._others.append(other)
        other._others.append(self)

    def reboot(self, now_us: int) -> None:
        """Restart the autopilot, on all its links; `now_us` is on the simulation's clock."""
        self._autopilot.reboot(now_us)
        for endpoint in (self, *self._others):
            endpoint._begin()

    def receive(self, now_us: int, transport_now_us: int) -> None:
        """Handle everything that has arrived; `now_us` is on the simulation's clock."""
        arrived = self.transport.receive(transport_now_us)
        if not arrived:
            return
        self._now_us = self._autopilot.boot.since_us(now_us)
        if self._now_us < self._autopilot.boot.quiet_us:
            return  # it is starting and does not receive
        for datagram in arrived:
            self._waited_us = max(0, min(self._step_us, transport_now_us - datagram.t_us))
            self._counts.received_bytes += len(datagram.data)
            for frame in frames(datagram.data, version_1=True):
                self._on_frame(frame)
        self._autopilot.stream.flown()

    def send_due(self, now_us: int) -> None:
        """Send what the schedule, running transfers, or pending texts require; `now_us` as in `receive`."""
        pilot = self._autopilot
        self._now_us = pilot.boot.since_us(now_us)
        if self._now_us < pilot.boot.quiet_us:
            return
        if pilot.reboot_at_us is not None and self._now_us >= pilot.reboot_at_us:
            self.reboot(now_us)
            return
        if not self._greeted:
            self._greeted = True
            self.send(_ACK, BOOT_COMMAND, Result.ACCEPTED, 0, 0, 0, 1)
        due = self._schedule.take_due(self._now_us)
        if self._origin_sent is not pilot.boot.origin and pilot.ready(self._now_us):
            self._origin_sent = pilot.boot.origin
            due.append(_ORIGIN)
        if due:
            self._send_streams(due)
        self._parameters.send_due(self._now_us)
        self._missions.send_due(self._now_us)
        if pilot.flight.reached:
            self._send_reached()
        if self._texts or pilot.texts:
            self._send_texts()

    # --- receiving ---

    def _handler_table(self) -> dict[int, Callable[[Any], None]]:
        return {
            mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: self._on_attitude_target,
            mav.MAVLINK_MSG_ID_COMMAND_LONG: self._on_command_long,
            mav.MAVLINK_MSG_ID_COMMAND_INT: self._on_command_int,
            mav.MAVLINK_MSG_ID_SET_MODE: self._on_set_mode,
            mav.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            mav.MAVLINK_MSG_ID_PING: self._on_ping,
            mav.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: lambda m: self._parameters.list(self._now_us),
            mav.MAVLINK_MSG_ID_PARAM_REQUEST_READ: lambda m: self._parameters.read(m),
            mav.MAVLINK_MSG_ID_PARAM_SET: lambda m: self._parameters.write(m),
            mav.MAVLINK_MSG_ID_MISSION_COUNT: lambda m: self._missions.count(m, self._now_us),
            mav.MAVLINK_MSG_ID_MISSION_ITEM_INT: lambda m: self._missions.item(m, self._now_us),
            mav.MAVLINK_MSG_ID_MISSION_ITEM: lambda m: self._missions.item(m, self._now_us),
            mav.MAVLINK_MSG_ID_MISSION_REQUEST_LIST: lambda m: self._missions.list(m),
            mav.MAVLINK_MSG_ID_MISSION_REQUEST_INT: lambda m: self._missions.request(m),
            mav.MAVLINK_MSG_ID_MISSION_REQUEST: lambda m: self._missions.request(m),
            mav.MAVLINK_MSG_ID_MISSION_CLEAR_ALL: lambda m: self._missions.clear(m),
            mav.MAVLINK_MSG_ID_MISSION_SET_CURRENT: lambda m: self._missions.set_current(m),
        }

    def _on_frame(self, frame: bytes) -> None:
        message = self._codec.decode(frame)
        if message is None:
            self.ignored["not_decoded"] += 1
            self._counts.not_decoded += 1
            return
        self._counts.received += 1
        self.sender = message.get_srcSystem(), message.get_srcComponent()
        if message.get_msgId() == mav.MAVLINK_MSG_ID_HEARTBEAT:
            self._on_heartbeat(message, frame)
            return
        handler = self._handlers.get(message.get_msgId())
        if handler is None:
            return
        if message.get_msgId() != mav.MAVLINK_MSG_ID_PING:
            system, component = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
            if system not in (0, self.sysid) or component not in (0, COMPONENT):
                self.ignored["not_addressed"] += 1
                return
        self._seen.add(self.sender)
        handler(message)

    def _on_heartbeat(self, message: Any, frame: bytes) -> None:
        if self.sender == (self.sysid, COMPONENT):
            return  # our own, echoed
        self._seen.add(self.sender)
        if message.type == TYPE_GCS:
            self._gcs_us = self._now_us
            self._autopilot.watch.on_gcs_heartbeat(self._now_us)
        for other in self._others:
            other.transport.send(frame)

    def _on_attitude_target(self, m: Any) -> None:
        rates = m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate
        self._autopilot.on_setpoint(m.type_mask, m.q, rates, m.thrust, now_us=self._now_us)

    def _on_timesync(self, message: Any) -> None:
        if message.tc1 == 0:
            self.send(_TIMESYNC, (self._now_us - self._waited_us) * 1000, message.ts1)  # time of arrival

    def _on_ping(self, message: Any) -> None:
        if message.target_system == 0 and message.target_component == 0:
            self.send(_PING, message.time_usec, message.seq, *self.sender)

    # --- commands ---

    def _on_command_long(self, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        self._acknowledge(m.command, self._commands.run(m.command, params, self._now_us))

    def _on_command_int(self, m: Any) -> None:
        known = not (m.x == _UNKNOWN_PLACE and m.y == _UNKNOWN_PLACE)
        place = (m.x / 1e7, m.y / 1e7) if known else (float("nan"), float("nan"))
        params: Params = (m.param1, m.param2, m.param3, m.param4, *place, m.z)
        self._acknowledge(m.command, self._commands.run(m.command, params, self._now_us))

    def _on_set_mode(self, m: Any) -> None:
        result = self._commands.set_mode(m.base_mode, m.custom_mode, self._now_us)
        self._acknowledge(mav.MAV_CMD_DO_SET_MODE, result)

    def _acknowledge(self, command: int, result: Result | None) -> None:
        """Send an acknowledgement to the sender, on every link it was received on."""
        if result is None:
            return
        for link in (self, *(o for o in self._others if self.sender in o._seen)):
            link.send(_ACK, command, result, 0, 0, *self.sender)

    def set_interval(self, message: int, interval_us: int) -> bool:
        """Execute SET_MESSAGE_INTERVAL; return False when there is no such message."""
        if message not in STREAMS:
            return False
        self._schedule.set_interval(message, interval_us, self._now_us)
        return True

    def request(self, message: int, argument: float) -> bool:
        """Execute REQUEST_MESSAGE; return False when nothing was sent."""
        if message in STREAMS:
            return self._send_streams([message]) == 1
        if message == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL and 0 <= argument <= 0xFFFF:
            wanted = int(argument)
            self.send(_INTERVAL, self._schedule.interval_us(wanted) if wanted in STREAMS else 0, wanted)
        elif message == mav.MAVLINK_MSG_ID_AVAILABLE_MODES:
            self._send_available_modes(argument)
        else:
            return False
        return True

    def _send_available_modes(self, argument: float) -> None:
        """Send all modes, or the one with that index, from 1 on."""
        for index, (mode, name) in enumerate(MODE_NAMES.items(), 1):
            if argument in (0.0, float(index)):
                standard = STANDARD_MODES.get(mode, 0)
                self.send(_AVAILABLE, mode, 0, len(MODE_NAMES), index, standard, name.encode())

    # --- sending ---

    def send(self, kind: Kind, *fields: Any) -> None:
        """Send one message from its fields in wire order."""
        self._send_fields(kind, fields)

    def _send_fields(self, kind: Kind, fields: Fields) -> None:
        try:
            frame = self._writer.frame(kind, fields)
        except struct.error:
            self.ignored[f"not_sent {kind.name}"] += 1  # a number that no field can hold must not stop the flight
            return
        self._counts.sent += 1
        self._counts.sent_bytes += len(frame)
        self.transport.send(frame)

    def _send_streams(self, messages: list[int]) -> int:
        """Send the streams that are due; return how many had content."""
        pilot = self._autopilot  # one that has lost its position goes on with what it dead-reckons
        self._placed = pilot.ready(self._now_us) and (self._placed or pilot.has_position)
        told = [message for message in messages if self._has_content(message, self._placed)]
        if told:
            report = self._report()
            report.counts = self._counts
            for message in told:
                self._send_fields(KINDS[message], STREAMS[message].build(report))
        return len(told)

    def _has_content(self, message: int, placed: bool) -> bool:
        if message == _CURRENT_MODE:
            return self._status_is_new()
        if message == mav.MAVLINK_MSG_ID_ATTITUDE_TARGET:
            return self._target_is_new()
        return placed or not STREAMS[message].needs_position

    def _target_is_new(self) -> bool:
        """Return whether there is another target than was told last: in OFFBOARD each setpoint is one, told once."""
        told_us, pilot = self._target_us, self._autopilot
        self._target_us = pilot.stream.newest_us
        return pilot.mode != Px4Mode.OFFBOARD or self._target_us != told_us

    def _status_is_new(self) -> bool:
        """Return whether PX4 has published its status anew: twice a second and on change, whatever the requests."""
        before, self._status_sent = self._status_sent, self._autopilot.status(self._now_us)
        return before != self._status_sent

    def _send_reached(self) -> None:
        reached = self._autopilot.flight.reached
        for seq in reached:
            for link in (self, *self._others):
                link._missions.reached(seq)
        reached.clear()

    def _tell_parameter(self, value: Any) -> None:
        for other in self._others:
            other._parameters.send(value)

    def _send_texts(self) -> None:
        """Send texts: only to links with a ground station (HEARTBEAT type 6), at most 20/s, none older than 5 s."""
        for severity, text in self._autopilot.texts:
            for link in (self, *self._others):
                link._texts.append((self._now_us, severity, text))
        self._autopilot.texts.clear()
        while self._texts and self._now_us - self._texts[0][0] > TEXT_MAX_AGE_US:
            self._texts.popleft()
        told = self._gcs_us is not None and self._now_us - self._gcs_us <= GCS_GONE_US
        if not (self._texts and told and self._now_us >= self._text_due_us):
            return
        _, severity, text = self._texts.popleft()
        self._text_due_us = self._now_us + TEXT_EVERY_US
        self._text_id = self._text_id % 65535 + 1
        raw = text.encode("ascii", "replace")
        chunks = [raw[i : i + TEXT_CHARS] for i in range(0, len(raw), TEXT_CHARS)]
        for number, chunk in enumerate(chunks):
            self.send(_TEXT, severity, chunk, self._text_id, number)
