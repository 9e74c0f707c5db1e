"""TCP ports that the live view may serve on."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

HOST = "127.0.0.1"
PORTS_TRIED = 50


@contextmanager
def held_view_port(first: int, count: int = PORTS_TRIED) -> Iterator[int]:
    """Hold one of `count` ports from `first` on without a listener that nobody else holds; 0: there is none.

    It is held until the block ends.

    Who is to listen on it is another process, which binds it later: two that only look would both find the same port.
    What is bound here is the UDP port of the same number. The system gives it to one process, and frees it however
    that ends. It comes first, as looking binds the TCP port for a moment, in which its holder's server may want it.
    """
    for port in range(first, min(first + count, 65536)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as claim:
            try:
                claim.bind((HOST, port))
            except OSError:
                continue
            if not _is_free(port):
                continue
            yield port
            return
    yield 0


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
            probe.listen(1)
        except OSError:
            return False
    return True
