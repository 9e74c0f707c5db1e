"""TCP ports that the live view may serve on."""

from __future__ import annotations

import socket
from collections.abc import Iterator

HOST = "127.0.0.1"
PORTS_TRIED = 50


def free_view_ports(first: int) -> Iterator[int]:
    """Yield the ports without a listener among the `PORTS_TRIED` from `first` on."""
    for port in range(first, min(first + PORTS_TRIED, 65536)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
                probe.listen(1)
            except OSError:
                continue
        yield port
