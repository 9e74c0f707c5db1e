"""UDP ports of loopback for processes that are started here."""

from __future__ import annotations

import contextlib
import random
import socket

_BELOW_EPHEMERAL = range(20_000, 32_000)  # the system gives none of them to sockets that ask for any port


def free_ports(count: int) -> list[int]:
    """Return ports that were free a moment ago, as their next ones."""
    with contextlib.ExitStack() as stack:
        found: list[int] = []
        while len(found) < count:
            sock, beside = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
            port = random.choice(_BELOW_EPHEMERAL)
            with contextlib.suppress(OSError):
                sock.bind(("127.0.0.1", port))
                beside.bind(("127.0.0.1", port + 1))
                found.append(port)
        return found
