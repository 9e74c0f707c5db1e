"""A link of a check whose frames are signed and verified; scans, and MAVSDK behind them, see plain frames.

Frames of all senders are verified, because a vehicle with another system id is a finding. A vehicle that has just
booted may sign with time stamps of long ago: it is greeted, and answers with newer ones.
"""

from __future__ import annotations

from collections.abc import Mapping

from swarmctl.check.scan.listener import Address, Listener, ReceivedDatagram
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.signing.channel import SigningChannel
from swarmctl.mavlink.signing.recognition import SignedRecognition


class SignedListener:
    """Signs and verifies on another listener.

    Args:
        inner: the link.
        channel: holds the key.
        vehicle: greets the vehicle where it sends first.
    """

    def __init__(self, inner: Listener, channel: SigningChannel, vehicle: SignedRecognition) -> None:
        self._inner, self._channel, self._vehicle = inner, channel, vehicle

    @property
    def dropped(self) -> int:
        """Datagrams that reached this computer and found its queue full."""
        return self._inner.dropped

    @property
    def refused(self) -> Mapping[str, int]:
        """Number of frames that were not taken, by reason."""
        return dict(self._channel.refusals.by_reason)

    def receive(self) -> list[ReceivedDatagram]:
        taken = []
        for t_us, data, sender in self._inner.receive():
            plain = b"".join(filter(None, map(self._channel.take, frames(data, version_1=True))))
            if plain:
                taken.append(ReceivedDatagram(t_us, plain, sender))
            elif greeting := self._vehicle.greeting(data):
                self._inner.send(greeting, sender)
        return taken

    def send(self, data: bytes, to: Address) -> None:
        for frame in frames(data, version_1=True):
            self._inner.send(self._channel.sign(frame), to)

    def fd(self) -> int | None:
        return self._inner.fd()

    def close(self) -> None:
        self._inner.close()
