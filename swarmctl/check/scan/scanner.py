"""Scans one vehicle: sends requests and collects the answers without arming or changing any mode, rate or parameter.

A scan sends its heartbeat, TIMESYNC, PING, requests for single messages and parameter reads.
"""

from __future__ import annotations

import math
import selectors
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.check.scan.link_statistics import Answer, FrameStatistics
from swarmctl.check.scan.listener import NOWHERE, Address, Listener, ReceivedDatagram
from swarmctl.check.scan.parameter_reader import ParameterReader
from swarmctl.core.mavlink_values import (
    ACTIVE,
    ARMED_FLAG,
    AUTOPILOT_COMPID,
    NO_AUTOPILOT,
    ONBOARD_CONTROLLER,
    PREARM_CHECK,
)
from swarmctl.mavlink.codec import Codec, is_intact
from swarmctl.mavlink.dialects.dialect import Dialect
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.wall_clock import monotonic_us

SCANNER_COMPID = 192  # MAV_COMP_ID_ONBOARD_COMPUTER2: keeps sequence numbers apart from those of a flying agent
_HEARTBEAT_US, _TIMESYNC_US, _PING_US, _REQUEST_US = 1_000_000, 50_000, 200_000, 500_000
_REQUESTS = 4  # repetitions without an answer
_STALE_US = 1_000_000
_FRESH_US = 2_500_000  # an older heartbeat does not show the armed state
_POLL_S = 0.005
_ONCE = (mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
_COMPONENT_METADATA = 397  # not in pymavlink's dialect: only that it comes is known
ASKED = (  # messages that are requested when they do not arrive by themselves
    *_ONCE,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
)


class Newest(NamedTuple):
    """A message and its arrival time."""

    t_us: int
    message: Any


class VehicleScan:
    """Scans one vehicle over its link.

    Args:
        listener: link of the vehicle, owned by the scan.
        there: address to send to before any sender was received.
        wanted_sysid: system id in the configuration; another vehicle is scanned when this one is not received.
        names_of: returns the parameters to read, by dialect.
        seconds: time to listen after the first heartbeat.
        patience_s: additional time for a vehicle that is not ready to arm yet.

    Attributes:
        tap: also called with every datagram of the vehicle.
    """

    def __init__(
        self,
        listener: Listener,
        there: Address,
        wanted_sysid: int,
        names_of: Callable[[Dialect], Sequence[str]],
        *,
        seconds: float,
        patience_s: float = 0.0,
    ) -> None:
        self.listener = listener
        self.tap: Callable[[bytes], None] | None = None
        self.sysid = 0  # system id of the scanned vehicle; 0 before its first heartbeat
        self.began_us: int | None = None
        self.mavlink1 = self.mavlink2 = 0
        self._datagrams = 0
        self.senders: set[Address] = set()
        self.has_metadata = False  # it serves component information
        self.newest: dict[tuple[int, str], Newest] = {}
        self.statistics: dict[int, FrameStatistics] = {}
        self.answers: dict[str, list[Answer]] = {"TIMESYNC": [], "PING": []}
        self.parameters: ParameterReader | None = None
        self._there, self._wanted, self._names_of, self._seconds = there, wanted_sysid, names_of, seconds
        self._patience_s = patience_s
        self._codec = Codec(wanted_sysid, SCANNER_COMPID)
        self._due_us: dict[str, int] = {}
        self._asked: dict[int, int] = {}
        self._timesyncs: dict[int, int] = {}  # ts1 [ns] -> sent [us]
        self._pings: dict[int, int] = {}  # seq -> sent [us]

    # --- results ---

    @property
    def found_autopilot(self) -> bool:
        """Whether an autopilot's heartbeat was received."""
        return self.began_us is not None

    def listened_s(self, now_us: int) -> float:
        return 0.0 if self.began_us is None else (now_us - self.began_us) * 1e-6

    def finished(self, now_us: int) -> bool:
        """Whether it has listened for long enough and every parameter is read or given up."""
        least_s = self._seconds if self._ready() else self._seconds + self._patience_s
        if not self.found_autopilot or self.listened_s(now_us) < least_s:
            return False
        return self.parameters is None or self.parameters.settled

    @property
    def dropped_frames(self) -> int:
        """Number of frames that this computer has dropped, at as many in a datagram as in those received."""
        return round(self.listener.dropped * (self.mavlink1 + self.mavlink2) / max(1, self._datagrams))

    def message(self, name: str) -> Any | None:
        """Return the newest message of a type from the vehicle, or None."""
        found = self.newest.get((self.sysid, name))
        return None if found is None else found.message

    def autopilots(self) -> tuple[int, ...]:
        """Return the system ids of the autopilots on this link."""
        return tuple(sorted(sysid for sysid, name in self.newest if name == "HEARTBEAT"))

    def _ready(self) -> bool:
        beat, health = self.message("HEARTBEAT"), self.message("SYS_STATUS")
        if beat is not None and beat.base_mode & ARMED_FLAG:
            return True
        return health is not None and bool(health.onboard_control_sensors_health & PREARM_CHECK)

    def may_change(self, now_us: int) -> bool:
        """Whether a recent heartbeat shows that the vehicle is disarmed."""
        beat = self.newest.get((self.sysid, "HEARTBEAT"))
        if beat is None or now_us - beat.t_us > _FRESH_US or self.sysid != self._wanted:
            return False
        return not beat.message.base_mode & ARMED_FLAG

    # --- requests ---

    def step(self, now_us: int) -> None:
        """Take in what has arrived, and send the requests that are due."""
        for heard in self.listener.receive():
            if self.tap is not None and heard.sender == self._there:
                self.tap(heard.data)
            self._take(heard)
        if self._there == NOWHERE:
            return
        if self._due("heartbeat", now_us, _HEARTBEAT_US):
            self._send(mavlink.MAVLink_heartbeat_message(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, ACTIVE, 3))
        if not self.found_autopilot:
            return
        if self._due("timesync", now_us, _TIMESYNC_US):
            self._timesyncs[now_us * 1000] = monotonic_us()
            self._send(mavlink.MAVLink_timesync_message(0, now_us * 1000))
        if self._due("ping", now_us, _PING_US):
            seq = len(self._pings) + 1
            self._pings[seq] = monotonic_us()
            self._send(mavlink.MAVLink_ping_message(now_us, seq, 0, 0))
        if self._due("requests", now_us, _REQUEST_US):
            self._request_missing(now_us)
        if self.parameters is not None:
            for message in self.parameters.step(now_us):
                self._send(message)

    def forward(self, frame: bytes) -> None:
        """Send a frame of somebody else, who is fed by `tap`, to the vehicle."""
        self.listener.send(frame, self._there)

    def _request_missing(self, now_us: int) -> None:
        if not self.has_metadata:
            self._request(_COMPONENT_METADATA)
        for number in ASKED:
            known = self.newest.get((self.sysid, mavlink.mavlink_map[number].msgname))
            if known is not None and (number in _ONCE or now_us - known.t_us < _STALE_US):
                self._asked.pop(number, None)
            else:
                self._request(number)

    def _request(self, number: int) -> None:
        """Request a message, unless it was requested so often without an answer."""
        if self._asked.get(number, 0) >= _REQUESTS:
            return
        self._asked[number] = self._asked.get(number, 0) + 1
        params, request = (float(number), *[0.0] * 6), mavlink.MAV_CMD_REQUEST_MESSAGE
        self._send(mavlink.MAVLink_command_long_message(self.sysid, AUTOPILOT_COMPID, request, 0, *params))

    def _due(self, what: str, now_us: int, every_us: int) -> bool:
        if now_us < self._due_us.get(what, 0):
            return False
        self._due_us[what] = now_us + every_us
        return True

    def _send(self, message: Any) -> None:
        self.listener.send(self._codec.encode(message), self._there)

    # --- reception ---

    def _take(self, heard: ReceivedDatagram) -> None:
        self._datagrams += 1
        for frame in frames(heard.data, version_1=True):
            if frame[0] == mavlink.PROTOCOL_MARKER_V1:
                sysid, compid, seq = frame[3], frame[4], frame[2]
            else:
                sysid, compid, seq = frame[5], frame[6], frame[4]
            if compid != AUTOPILOT_COMPID:
                continue
            message = self._codec.decode(frame)
            if message is None and (frame[0] == mavlink.PROTOCOL_MARKER_V1 or is_intact(frame) is False):
                continue  # a damaged frame has no sequence number that counts
            self._count(frame, heard.sender)
            statistics = self.statistics.setdefault(sysid, FrameStatistics())
            statistics.frame(seq, len(frame))
            if message is None:
                self.has_metadata |= sysid == self.sysid and message_id(frame) == _COMPONENT_METADATA
            else:
                statistics.message(message.get_type(), heard.t_us)
                self._message(sysid, message, heard)

    def _count(self, frame: bytes, sender: Address) -> None:
        self.senders.add(sender)
        if frame[0] == mavlink.PROTOCOL_MARKER_V1:
            self.mavlink1 += 1
        else:
            self.mavlink2 += 1

    def _message(self, sysid: int, message: Any, heard: ReceivedDatagram) -> None:
        name = message.get_type()
        if name == "HEARTBEAT":
            if message.autopilot == NO_AUTOPILOT:
                return
            self._choose(sysid, message.autopilot, heard)
        self.newest[sysid, name] = Newest(heard.t_us, message)
        if sysid != self.sysid:
            return
        if name == "TIMESYNC":
            self._timesync(message, heard.t_us)
        elif name == "PING":
            sent_us = self._pings.get(message.seq) if message.target_component == SCANNER_COMPID else None
            if sent_us is not None:
                self.answers["PING"].append(Answer(sent_us, heard.t_us, math.nan))
        elif self.parameters is not None:
            self.parameters.receive(message)

    def _choose(self, sysid: int, autopilot: int, heard: ReceivedDatagram) -> None:
        """Select the first autopilot, until the configured one is received."""
        if self.sysid in (sysid, self._wanted):
            return
        if self.sysid and sysid != self._wanted:
            return
        self.sysid = sysid
        self.began_us = heard.t_us if self.began_us is None else self.began_us
        self._there = heard.sender
        self._asked.clear()
        self.answers = {"TIMESYNC": [], "PING": []}
        self.parameters = None
        dialect = DIALECTS.get(autopilot)
        if dialect is not None:
            self.parameters = ParameterReader(sysid, AUTOPILOT_COMPID, self._names_of(dialect), dialect)

    def _timesync(self, message: Any, t_us: int) -> None:
        sent_us = self._timesyncs.pop(message.ts1, None) if message.tc1 else None
        if sent_us is not None:
            self.answers["TIMESYNC"].append(Answer(sent_us, t_us, message.tc1 * 1e-3))


def run_scans(scans: Sequence[VehicleScan], connect_s: float, longest_s: float, ended: Callable[[], bool]) -> None:
    """Run all scans at once until each has finished or has heard nothing for `connect_s`, or until `ended`."""
    began_us = monotonic_us()
    with selectors.DefaultSelector() as selector:
        blind = False
        for scan in scans:
            fd = scan.listener.fd()
            blind = blind or fd is None
            if fd is not None:
                selector.register(fd, selectors.EVENT_READ)
        while not ended():
            now_us = monotonic_us()
            waited_s = (now_us - began_us) * 1e-6
            open_scans = [
                p for p in scans if not (p.finished(now_us) or (not p.found_autopilot and waited_s > connect_s))
            ]
            if not open_scans or waited_s > longest_s:
                return
            for scan in scans:
                scan.step(now_us)
            if blind or not selector.get_map():
                time.sleep(_POLL_S)
            else:
                selector.select(_POLL_S)
