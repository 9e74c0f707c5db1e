"""MAVLink 2 codec that converts bytes and dialect messages, one datagram at a time. It knows no socket and no vehicle.

`parse_buffer` is never used: as a stream parser it loses most good frames after two bytes of junk.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import development as dialect

from swarmctl.mavlink.framing import frames, message_id

_AUTOPILOT_COMPID = 1


def heartbeat_of(sysid: int) -> Callable[[bytes], bool]:
    """Return a predicate: does a datagram hold a valid HEARTBEAT of the autopilot with this system id?

    Ground stations and companions send HEARTBEAT too, some with a vehicle's system id; they name no autopilot type.
    """
    codec = Codec(sysid, _AUTOPILOT_COMPID)

    def beats(datagram: bytes) -> bool:
        for frame in frames(datagram):
            if message_id(frame) != dialect.MAVLINK_MSG_ID_HEARTBEAT or frame[5:7] != bytes([sysid, _AUTOPILOT_COMPID]):
                continue
            message = codec.decode(frame)
            if message is not None and message.autopilot != dialect.MAV_AUTOPILOT_INVALID:
                return True
        return False

    return beats


class Codec:
    """Packs messages as one component, and decodes frames; counts what it refuses."""

    def __init__(self, sysid: int, compid: int) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=sysid, srcComponent=compid)
        self._mav.robust_parsing = False
        self.sysid = sysid
        self.compid = compid
        self.refused: Counter[str] = Counter()

    def encode(self, message: Any) -> bytes:
        """Return the frame of a dialect message, with this component's ids and the next sequence number."""
        frame: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def decode(self, frame: bytes) -> Any | None:
        """Return the message of one frame, or None for a refused one, which is counted."""
        try:
            message = self._mav.decode(bytearray(frame))
        except (dialect.MAVError, IndexError, ValueError, KeyError) as error:
            self.refused[type(error).__name__] += 1
            return None
        if isinstance(message, dialect.MAVLink_unknown):  # its checksum can't be verified
            self.refused["unknown message"] += 1
            return None
        return message
