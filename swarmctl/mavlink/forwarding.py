"""Forwards everything that a vehicle sends to ground stations, and what these may ask of it to the vehicle.

Stations may read: parameters, missions, logs, single messages. Where they are allowed to command, orders pass too, but
never setpoints, positions, heartbeats or keys: setpoints leave from the tick only, and the autopilot's failsafe for a
lost data link listens for our heartbeats, which a station's would replace.
"""

from __future__ import annotations

import contextlib
import socket
from collections import Counter
from collections.abc import Callable, Sequence

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.latch import Address
from swarmctl.mavlink.transport import MAX_DATAGRAM, Datagram, Transport

_DATAGRAMS_A_POLL = 20  # from each station; the rest waits for the next tick
_HEADER_BYTES, _COMMAND_AT = 10, 28  # where a payload begins, and the number of the command in it
_ANY_COMMAND = (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT)
_READING = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ,
        mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST,
        mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_LIST,
        mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_INT,
        mavlink.MAVLINK_MSG_ID_MISSION_ACK,
        mavlink.MAVLINK_MSG_ID_LOG_REQUEST_LIST,
        mavlink.MAVLINK_MSG_ID_LOG_REQUEST_DATA,
        mavlink.MAVLINK_MSG_ID_LOG_REQUEST_END,
    }
)
_READING_COMMANDS = frozenset({mavlink.MAV_CMD_REQUEST_MESSAGE})
_COMMANDING = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
        mavlink.MAVLINK_MSG_ID_COMMAND_INT,
        mavlink.MAVLINK_MSG_ID_SET_MODE,
        mavlink.MAVLINK_MSG_ID_PARAM_SET,
        mavlink.MAVLINK_MSG_ID_MISSION_COUNT,
        mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT,
        mavlink.MAVLINK_MSG_ID_MISSION_CLEAR_ALL,
        mavlink.MAVLINK_MSG_ID_MISSION_SET_CURRENT,
    }
)


class Forwarding:
    """A link to a vehicle that ground stations listen to.

    Args:
        inner: the link.
        stations: where each listens; only what comes from there is heard.
        sysid: of the vehicle; nobody else may use it.
        commands: whether stations may command the vehicle.
        sign: makes a frame one that the vehicle takes.

    Attributes:
        dropped: frames of stations that were not passed on, by reason.
    """

    def __init__(
        self,
        inner: Transport,
        stations: Sequence[Address],
        sysid: int,
        *,
        commands: bool = False,
        sign: Callable[[bytes], bytes] = bytes,
    ) -> None:
        self._inner, self._sysid, self._commands, self._sign = inner, sysid, commands, sign
        self._sockets = [_towards(station) for station in stations]
        self.dropped: Counter[str] = Counter()

    def send(self, data: bytes) -> None:
        self._inner.send(data)

    def receive(self, now_us: int) -> list[Datagram]:
        arrived = self._inner.receive(now_us)
        for sock in self._sockets:
            for datagram in arrived:
                with contextlib.suppress(OSError):  # nobody listens there now, or the system has no room
                    sock.send(datagram.data)
            self._relay(sock)
        return arrived

    def close(self) -> None:
        for sock in self._sockets:
            sock.close()
        self._inner.close()

    def _relay(self, sock: socket.socket) -> None:
        """Pass on what a station asks, a bounded number of datagrams at once."""
        for _ in range(_DATAGRAMS_A_POLL):
            try:
                data = sock.recv(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError:  # what was sent to nobody comes back as an error
                continue
            for frame in frames(data):
                if reason := self._refusal(frame):
                    self.dropped[reason] += 1
                else:
                    self._inner.send(self._sign(frame))

    def _refusal(self, frame: bytes) -> str:
        """Return why a station's frame is not passed on, or ""."""
        number = message_id(frame)
        if frame[5] == self._sysid:
            return "in the vehicle's name"
        if number in _READING or _command(frame, number) in _READING_COMMANDS:
            return ""
        if number not in _COMMANDING:
            return "not for stations"
        return "" if self._commands else "read only"


def _command(frame: bytes, number: int) -> int | None:
    """Return the MAV_CMD of a frame; None of one that is no command. Zeros at the end of a payload are not sent."""
    if number not in _ANY_COMMAND:
        return None
    payload = frame[_HEADER_BYTES : _HEADER_BYTES + frame[1]]
    return int.from_bytes(payload[_COMMAND_AT : _COMMAND_AT + 2], "little")


def _towards(station: Address) -> socket.socket:
    """Return a socket that sends to a station, and hears nobody else."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    sock.connect(station)
    return sock
