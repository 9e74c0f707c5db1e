"""A vehicle's UDP port as in PX4: it receives from every sender, and sends to the first one."""

from __future__ import annotations

import socket

from swarmctl.mavlink.transport import Datagram

_MAX_DATAGRAM = 2048
_DATAGRAMS_A_POLL = 600  # the rest waits for the next, so that a flood can't stop the simulation


class OpenPort:
    """Sends to `remote` until the first datagram arrives, from then on to its sender for good.

    Datagrams of all senders are passed on: PX4 obeys them too, and answers the first.
    """

    def __init__(self, sock: socket.socket, remote: tuple[str, int]) -> None:
        self._sock = sock
        self._sock.setblocking(False)
        self._remote = remote
        self._latched = False

    @property
    def fd(self) -> int:
        """Return the file descriptor, for a selector."""
        return self._sock.fileno()

    def send(self, data: bytes) -> None:
        """Send one frame; it is dropped when the socket can't take it."""
        try:
            self._sock.sendto(data, self._remote)
        except OSError:
            return

    def receive(self, now_us: int) -> list[Datagram]:
        """Return what has arrived since the last call, up to a limit."""
        arrived: list[Datagram] = []
        for _ in range(_DATAGRAMS_A_POLL):
            try:
                data, sender = self._sock.recvfrom(_MAX_DATAGRAM)
            except OSError:
                break
            if not self._latched:
                self._remote, self._latched = sender, True
            arrived.append(Datagram(now_us, data))
        return arrived

    def close(self) -> None:
        """Release the port."""
        self._sock.close()
