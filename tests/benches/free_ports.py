"""UDP ports of loopback for processes that tests start."""

from __future__ import annotations

import contextlib
import socket


def free_ports(count: int) -> list[int]:
    """Return ports that were free a moment ago, as their next ones; nothing else here asks for them by number."""
    with contextlib.ExitStack() as stack:
        found: list[int] = []
        while len(found) < count:
            sock, beside = (stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2))
            sock.bind(("127.0.0.1", 0))
            port = int(sock.getsockname()[1])
            with contextlib.suppress(OSError, OverflowError):
                beside.bind(("127.0.0.1", port + 1))
                found.append(port)
        return found
