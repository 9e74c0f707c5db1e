"""Recognises a vehicle with a key: by its signed HEARTBEAT, before anything else is believed or sent to it.

A vehicle that has just booted may sign with time stamps of long ago, until it receives ours. Where it sends first, it
is greeted: to the sender of an authentic HEARTBEAT that is too old to be taken goes a HEARTBEAT of ours, and nothing
else. The real vehicle's next one is newer; who replays an old one gains nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.mavlink_values import ACTIVE, AUTOPILOT_COMPID, NO_AUTOPILOT, ONBOARD_CONTROLLER
from swarmctl.mavlink.codec import Codec, heartbeat_of
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.signing.channel import SigningChannel
from swarmctl.mavlink.signing.refusals import OLD, REPLAYED
from swarmctl.mavlink.signing.signature import strip

_GREETING_PERIOD_US = 200_000


class SignedRecognition:
    """Decides whether a datagram comes from the vehicle, for a port that has no owner yet.

    Args:
        channel: holds the key.
        sysid: system id of the vehicle.
        compid: component id of this program, whose heartbeats greet.
        utc_us: returns the time [us].
    """

    def __init__(self, channel: SigningChannel, sysid: int, compid: int, utc_us: Callable[[], int]) -> None:
        self._channel, self._utc_us = channel, utc_us
        self._ids = bytes((sysid, AUTOPILOT_COMPID))
        self._beats = heartbeat_of(sysid)
        self._codec = Codec(sysid, compid)
        self._greeted_us: int | None = None

    def is_vehicle(self, datagram: bytes) -> bool:
        """Return whether a datagram holds a valid HEARTBEAT of the vehicle's autopilot that the channel would take."""
        for frame in self._claimed(datagram):
            fault = self._channel.fault(frame)
            if not fault and self._beats(strip(frame)):
                return True
            if fault:
                self._channel.refuse(fault)
        return False

    def greeting(self, datagram: bytes) -> bytes:
        """Return what to answer the sender of a datagram that was refused, or b""."""
        now_us = self._utc_us()
        if self._greeted_us is not None and now_us - self._greeted_us < _GREETING_PERIOD_US:
            return b""
        if not any(self._channel.fault(frame) in (OLD, REPLAYED) for frame in self._claimed(datagram)):
            return b""
        self._greeted_us = now_us
        beat = dialect.MAVLink_heartbeat_message(ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, 0, ACTIVE, 3)
        return self._channel.sign(self._codec.encode(beat))

    def _claimed(self, datagram: bytes) -> list[bytes]:
        """Return the frames of a datagram that say to be a HEARTBEAT of the vehicle."""
        beat = dialect.MAVLINK_MSG_ID_HEARTBEAT
        return [frame for frame in frames(datagram) if message_id(frame) == beat and frame[5:7] == self._ids]
