"""A byte link that signs what is sent and passes only verified frames on, without their signatures.

Everything behind it, recordings included, therefore sees plain frames.
"""

from __future__ import annotations

from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.signing.channel import SigningChannel
from swarmctl.mavlink.transport import Datagram, Transport


class SignedTransport:
    """Signs and verifies the frames of one vehicle's autopilot over another transport.

    Args:
        inner: link to the vehicle.
        channel: holds the key.
        sysid, compid: ids of the autopilot; frames of other senders are dropped unseen, because nobody here uses them.
    """

    def __init__(self, inner: Transport, channel: SigningChannel, sysid: int, compid: int) -> None:
        self._inner, self._channel = inner, channel
        self._sender = bytes((sysid, compid))

    def send(self, data: bytes) -> None:
        self._inner.send(self._channel.sign(data))

    def receive(self, now_us: int) -> list[Datagram]:
        return [
            Datagram(datagram.t_us, plain)
            for datagram in self._inner.receive(now_us)
            for frame in frames(datagram.data)
            if frame[5:7] == self._sender and (plain := self._channel.take(frame)) is not None
        ]

    def close(self) -> None:
        self._inner.close()
