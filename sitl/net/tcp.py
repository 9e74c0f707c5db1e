"""TCP links as in ArduCopter's own simulator: vehicle i serves one client at a time on port 5760 + 10 i.

Nothing here blocks. Frames sent while no client is connected are dropped.
"""

from __future__ import annotations

import socket

from swarmctl.errors import StartError
from swarmctl.mavlink.framing import cut_frames
from swarmctl.mavlink.transport import Datagram

PORT_STEP = 10
_READ = 4096
_READS_A_POLL = 32  # the rest waits for the next, so that a flood can't stop the simulation
_BACKLOG_BYTES = 1 << 16  # a client that does not read loses whole frames beyond this


class TcpServerTransport:
    """A listening socket and its connected client; another client may follow when it leaves."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self._read = bytearray()
        self._unsent = bytearray()

    @property
    def port(self) -> int:
        """The port it listens on."""
        port: int = self._listener.getsockname()[1]
        return port

    def send(self, data: bytes) -> None:
        if self._client is None or len(self._unsent) > _BACKLOG_BYTES:
            return
        self._unsent += data
        try:
            sent = self._client.send(self._unsent)
        except BlockingIOError:
            return
        except OSError:
            self._leave()
            return
        del self._unsent[:sent]

    def receive(self, now_us: int) -> list[Datagram]:
        if self._client is None:
            self._accept()
        for _ in range(_READS_A_POLL):
            if self._client is None:
                break
            try:
                data = self._client.recv(_READ)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._leave()
                break
            self._read += data
        return [Datagram(now_us, frame) for frame in cut_frames(self._read)]

    def close(self) -> None:
        self._leave()
        self._listener.close()

    def _accept(self) -> None:
        try:
            self._client, _ = self._listener.accept()
        except OSError:  # no client waits
            return
        self._client.setblocking(False)
        self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._read.clear()
        self._unsent.clear()

    def _leave(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


def serve_tcp(host: str, first: int, vehicles: int) -> list[TcpServerTransport]:
    """Return a server for each vehicle, on ports `first`, `first` + 10, ...

    Raises:
        StartError: a port is taken or beyond 65535.
    """
    servers: list[TcpServerTransport] = []
    for port in range(first, first + PORT_STEP * vehicles, PORT_STEP):
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # for a port in TIME_WAIT; listeners still clash
        try:
            listener.bind((host, port))
            listener.listen(1)
        except (OSError, OverflowError) as error:
            listener.close()
            for server in servers:
                server.close()
            raise StartError(f"tcp {host}:{port} can't be served: {error}. Choose another --tcp-port") from error
        servers.append(TcpServerTransport(listener))
    return servers
